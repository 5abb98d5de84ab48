"""Reading and writing small files: whole or not at all, and never more than expected."""

from __future__ import annotations

import json
import os
import secrets
import stat
from pathlib import Path
from typing import Any

JSON_LIMIT = 4 * 2**20  # bytes: a config with ten thousand obstacles is 1 MiB


class FileError(ValueError):
    """A file that is missing, too large, malformed, or not a plain file; the message names it."""


def atomic_write(path: Path, content: bytes | str) -> None:
    """Replace a file so that a reader, or a crash, sees the old content or the new and nothing between."""
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames inside a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_limited(path: Path, limit: int = JSON_LIMIT) -> bytes:
    """Read a plain file of at most ``limit`` bytes; links, pipes and devices are refused with `FileError`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise FileError(f"cannot read {path}: not a plain file")
        with os.fdopen(descriptor, "rb", closefd=False) as stream:
            data = stream.read(limit + 1)
    finally:
        os.close(descriptor)
    if len(data) > limit:
        raise FileError(f"cannot read {path}: larger than {limit} bytes")
    return data


def read_json(path: Path, limit: int = JSON_LIMIT) -> dict[str, Any]:
    """Read a JSON object; NaN, infinities, other top-level values and bottomless nesting are refused."""
    try:
        data = json.loads(read_limited(path, limit).decode(), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        if isinstance(error, FileError):
            raise
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        raise FileError(f"cannot read {path}: not valid JSON ({reason})") from None
    if not isinstance(data, dict):
        raise FileError(f"cannot read {path}: not a JSON object")
    return data


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")
