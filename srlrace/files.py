"""Reading and writing small files: whole or not at all, and never more than expected."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import secrets
import stat
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import IO, Any

JSON_LIMIT = 4 * 2**20  # bytes: a config with ten thousand obstacles is 1 MiB
LEFTOVER = re.compile(r"\..+\.\d+-[0-9a-f]{8}\.tmp")  # what a kill in the midst of `atomic_write` leaves
SEAL = "seal"  # key of a JSON file's checksum over all the rest of it
DIGEST = "_sha256"  # how keys of other files' checksums end: whoever writes those, seals


class FileError(ValueError):
    """A file that is missing, too large, malformed, or not a plain file; the message names it."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an `OSError` of the block name ``path``: a full disk says no name, a temporary file's says little."""
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = os.fspath(path), None
        raise


def atomic_write(path: Path, content: bytes | str, durable: bool = True) -> None:
    """Replace a file so that a reader, or a crash, sees the old content or the new and nothing between.

    Not ``durable``: a power cut may still bring back the old content, until the folder is next synced.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    with naming(path):
        try:
            with temporary.open("xb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        if durable:
            sync_folder(path.parent)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes left of their writing; the caller holds the lock of ``folder``."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if LEFTOVER.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                Path(entry.path).unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make renames inside a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def open_plain(path: Path) -> IO[bytes]:
    """Open a plain file for reading; links, and pipes and devices, which may block, are refused with `FileError`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise FileError(f"cannot read {path}: not a plain file")
    return os.fdopen(descriptor, "rb")


def read_limited(path: Path, limit: int = JSON_LIMIT) -> bytes:
    """Read a plain file of at most ``limit`` bytes; links, pipes and devices are refused with `FileError`."""
    with open_plain(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(min(size, limit) + 1)  # a buffer of the limit's size would cost more than the reading
        if size < len(data) <= limit:  # it has grown meanwhile
            data += stream.read(limit + 1 - len(data))
    if len(data) > limit:
        raise FileError(f"cannot read {path}: larger than {limit} bytes")
    return data


def read_packed(path: Path, limit: int) -> bytes:
    """Read a gzip file whose content has at most ``limit`` bytes; raises `FileError` as `read_limited` does."""
    packed = read_limited(path, limit)
    try:
        with gzip.GzipFile(fileobj=BytesIO(packed)) as stream:
            data = stream.read(limit + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise FileError(f"cannot read {path}: not a whole gzip file ({error})") from None
    if len(data) > limit:
        raise FileError(f"cannot read {path}: larger than {limit} bytes when unpacked")
    return data


def write_sealed(path: Path, data: Mapping[str, Any], durable: bool = True) -> dict[str, Any]:
    """Write a JSON object together with its checksum, as `atomic_write` does; returns what was written."""
    content = {key: value for key, value in data.items() if key != SEAL}
    content[SEAL] = _digest(content)
    atomic_write(path, json.dumps(content, indent=1) + "\n", durable)
    return content


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_json(path: Path, limit: int = JSON_LIMIT) -> dict[str, Any]:
    """Read a JSON object; NaN, infinities, bottomless nesting, other values and broken seals are refused."""
    return parse_json(read_limited(path, limit), path)


def parse_json(content: bytes, path: Path) -> dict[str, Any]:
    """The JSON object that was read from ``path``, as `read_json` returns it; raises `FileError` as that does."""
    try:
        data = json.loads(content.decode(), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        raise FileError(f"cannot read {path}: not valid JSON ({reason})") from None
    if not isinstance(data, dict):
        raise FileError(f"cannot read {path}: not a JSON object")
    sealed = SEAL in data or any(key.endswith(DIGEST) for key in data)  # else damage to the word would undo it
    if sealed and data.get(SEAL) != _digest({key: value for key, value in data.items() if key != SEAL}):
        raise FileError(f"cannot read {path}: the checksum does not match, the file is damaged")
    return data


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")
