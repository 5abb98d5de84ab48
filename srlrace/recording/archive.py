"""Reading the MCAP container without trusting it.

Every length is checked against the file and a limit before memory is reserved, and every byte that is used is
covered by a checksum: the summary's, a chunk's, an attachment's, or the one of the whole data section. Files
without these checksums are refused, whatever the format allows.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Self, TypeVar

import numpy as np
import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, Metadata, MetadataIndex, Schema

from srlrace.recording.container import FOOTER_LENGTH, MAGIC, MESSAGE_HEADER

MAX_CHUNK = 32 * 2**20
"""Largest chunk that is unpacked, bytes; the writer's stay below a sixth of it."""
MAX_SUMMARY = 64 * 2**20
"""Largest summary section that is read, bytes; a million episodes' chunk indexes."""
MAX_ATTACHMENT = 64 * 2**20
MAX_UNPACKED = 2 * 2**30
"""Most bytes unpacked in one reading: ten thousand episodes of 7 s."""

RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQH")
_MESSAGE_HEAD = MESSAGE_HEADER.itemsize - RECORD_HEAD.size
_FOOTER = struct.Struct("<BQQQI")
_TAIL = _FOOTER.size + len(MAGIC)
_BLOCK = 2**20

T = TypeVar("T")


class CorruptRecording(ValueError):
    """The file is no complete, undamaged recording of srlrace; the message says what is wrong with it."""


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong with a file's contents into one `CorruptRecording` that names the file."""
    try:
        yield
    except CorruptRecording as error:
        raise CorruptRecording(f"{path}: {error}") from None
    except (McapError, DecodeError, zstandard.ZstdError, struct.error) as error:
        raise CorruptRecording(f"{path}: damaged ({type(error).__name__}: {error})") from error
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, MemoryError) as error:
        raise CorruptRecording(f"{path}: damaged ({type(error).__name__}: {error})") from error


def open_plain(path: Path) -> IO[bytes]:
    """Open a file for reading; a pipe or device, which could block for ever, is refused."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    stream = os.fdopen(descriptor, "rb")
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        stream.close()
        raise CorruptRecording(f"{path}: this is no plain file")
    return stream


def parse(read: Callable[[ReadDataStream], T], body: bytes) -> T:
    """One record from its bytes; lengths inside that reach beyond them raise."""
    stream = ReadDataStream(BytesIO(body))
    record = read(stream)
    if stream.count > len(body):
        raise CorruptRecording("a record is longer than it says")
    return record


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of each record in ``data``, which must end where a record ends."""
    place = 0
    while place < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, place)
        place += RECORD_HEAD.size
        if length > len(data) - place:
            raise CorruptRecording("a record reaches beyond its section")
        yield opcode, data[place : place + length]
        place += length


def unpack_chunk(chunk: Chunk) -> bytes:
    """The records of a chunk, with its size limited and its checksum verified."""
    if chunk.compression != "zstd":
        raise CorruptRecording(f"a chunk is packed with {chunk.compression[:16]!r}, expected 'zstd'")
    size = zstandard.get_frame_parameters(chunk.data).content_size
    if size != chunk.uncompressed_size or size > MAX_CHUNK:
        raise CorruptRecording(f"a chunk claims {size} bytes unpacked; the limit is {MAX_CHUNK}")
    data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=MAX_CHUNK, allow_extra_data=False)
    if zlib.crc32(data) != chunk.uncompressed_crc:
        raise CorruptRecording("the checksum of a chunk is wrong")
    return data


def places(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Channel, offset and end of each message record among a chunk's records."""
    place = 0
    while place < len(data):
        opcode, length, channel = _MESSAGE.unpack_from(data, place)
        end = place + RECORD_HEAD.size + length
        if end > len(data):
            raise CorruptRecording("a message reaches beyond its chunk")
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE_HEAD:
                raise CorruptRecording("a message is shorter than its header")
            yield channel, place, end
        place = end


def messages(data: bytes) -> dict[int, list[bytes]]:
    """Payloads of the messages among a chunk's records, by channel id, in the order of the file."""
    found: dict[int, list[bytes]] = {}
    for channel, start, end in places(data):
        found.setdefault(channel, []).append(data[start + MESSAGE_HEADER.itemsize : end])
    return found


class Archive:
    """An open recording whose summary has been verified; use as a context manager.

    ``chunks`` holds one row (first time ns, last time ns, offset, length) of uint64 per chunk. Raises
    CorruptRecording for damaged files, OSError for unreadable ones.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._unpacked = 0
        self._file = open_plain(self.path)
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            with refusing(self.path):
                self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        if self._size < len(MAGIC) or self._at(0, len(MAGIC)) != MAGIC:
            raise CorruptRecording("this is no MCAP file")
        if self._size < len(MAGIC) + _TAIL or self._at(self._size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise CorruptRecording("the end is missing; `srlrace recover` keeps the complete episodes of a .part file")
        footer = self._at(self._size - _TAIL, _FOOTER.size)
        opcode, length, self._summary, _, crc = _FOOTER.unpack(footer)
        if (opcode, length) != (Opcode.FOOTER, FOOTER_LENGTH):
            raise CorruptRecording("the footer is damaged")
        data = self._at(self._summary, self._size - _TAIL - self._summary, MAX_SUMMARY)
        if zlib.crc32(footer[:-4], zlib.crc32(data)) != crc:
            raise CorruptRecording("the checksum of the summary is wrong")
        self._read_summary(data)

    def _read_summary(self, data: bytes) -> None:
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        chunks: list[tuple[int, int, int, int]] = []
        self._attachments: dict[str, AttachmentIndex] = {}
        self._metadata: dict[str, MetadataIndex] = {}
        for opcode, body in records(data):
            if opcode == Opcode.CHUNK_INDEX:
                chunks.append(struct.unpack_from("<4Q", body))
            elif opcode == Opcode.SCHEMA:
                self.schemas.append(parse(Schema.read, body))
            elif opcode == Opcode.CHANNEL:
                self.channels.append(parse(Channel.read, body))
            elif opcode == Opcode.ATTACHMENT_INDEX:
                attachment = parse(AttachmentIndex.read, body)
                self._attachments[attachment.name] = attachment
            elif opcode == Opcode.METADATA_INDEX:
                metadata = parse(MetadataIndex.read, body)
                self._metadata[metadata.name] = metadata
        self.chunks = np.array(chunks, np.uint64).reshape(-1, 4)
        ends = self.chunks[:-1, 2] + self.chunks[:-1, 3]
        if (self.chunks[1:, 2] < ends).any():
            raise CorruptRecording("its chunks overlap")

    def _at(self, offset: int, length: int, limit: int = MAX_CHUNK) -> bytes:
        """Bytes of the file."""
        if not 0 <= length <= limit:
            raise CorruptRecording(f"a part of it claims {length} bytes; the limit is {limit}")
        if offset + length > self._size:
            raise CorruptRecording("a part of it lies beyond its end")
        self._file.seek(offset)
        data = self._file.read(length)
        if len(data) != length:
            raise CorruptRecording("it shrank while being read")
        return data

    def _record(self, opcode: Opcode, offset: int, length: int, limit: int = MAX_CHUNK) -> bytes:
        """Body of the one record at a place."""
        data = self._at(offset, length, limit)
        found, size = RECORD_HEAD.unpack_from(data)
        if (found, size) != (opcode, length - RECORD_HEAD.size):
            raise CorruptRecording(f"there is no {opcode.name.lower()} where its index says")
        return data[RECORD_HEAD.size :]

    def unpack(self, index: int) -> dict[int, list[bytes]]:
        """The messages of one chunk, by channel id."""
        _, _, offset, length = self.chunks[index].tolist()
        chunk = parse(Chunk.read, self._record(Opcode.CHUNK, offset, length))
        self._unpacked += chunk.uncompressed_size
        if self._unpacked > MAX_UNPACKED:
            raise CorruptRecording(f"more than {MAX_UNPACKED} bytes unpacked; read fewer episodes at a time")
        return messages(unpack_chunk(chunk))

    def attachment(self, name: str) -> bytes:
        """The contents of an attached file."""
        if name not in self._attachments:
            raise CorruptRecording(f"it has no attachment {name}")
        place = self._attachments[name]
        body = self._record(Opcode.ATTACHMENT, place.offset, place.length, MAX_ATTACHMENT)
        if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            raise CorruptRecording(f"the checksum of {name} is wrong")
        return parse(Attachment.read, body).data

    def metadata(self, name: str) -> dict[str, str]:
        """A metadata record; as it has no checksum of its own, the one of the whole file is verified."""
        if name not in self._metadata:
            raise CorruptRecording(f"it has no metadata {name}")
        self.verify()
        place = self._metadata[name]
        return parse(Metadata.read, self._record(Opcode.METADATA, place.offset, place.length)).metadata

    def verify(self) -> None:
        """Check the checksum of everything before the summary."""
        end = self._summary - RECORD_HEAD.size - 4
        expected = int.from_bytes(self._record(Opcode.DATA_END, end, RECORD_HEAD.size + 4), "little")
        crc = 0
        for offset in range(0, end, _BLOCK):
            crc = zlib.crc32(self._at(offset, min(_BLOCK, end - offset)), crc)
        if crc != expected:
            raise CorruptRecording("the checksum of the data is wrong")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
