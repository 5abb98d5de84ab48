"""Keeping the complete episodes of a recording that was interrupted."""

from __future__ import annotations

import csv
import io
import math
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema

from srlrace.recording.archive import (
    MAX_ATTACHMENT,
    MAX_UNPACKED,
    RECORD_HEAD,
    CorruptRecording,
    messages,
    open_plain,
    parse,
    places,
    refusing,
    unpack_chunk,
)
from srlrace.recording.container import MAGIC, MESSAGE_HEADER, McapStream
from srlrace.recording.schema import episode_class
from srlrace.recording.topics import EPISODES_NAME, EPOCH, LIBRARY, Topics
from srlrace.recording.writer import create, publish

SUFFIX = ".part"
_COLUMNS = ("episode", "seed", "map", "outcome", "time_s")
"""The columns of episodes.csv that the recording itself knows."""


_KINDS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.CHUNK: Chunk.read,
}


def recover(part: Path) -> Path:
    """Write the complete episodes of an interrupted ``FILE.mcap.part`` to ``FILE.mcap``; returns its path.

    The ``.part`` file stays as it is. Raises ValueError for another name, FileExistsError when ``FILE.mcap``
    exists, CorruptRecording when there is no complete episode.
    """
    part = Path(part)
    path = part.with_suffix("")
    if part.suffix != SUFFIX:
        raise ValueError(f"{part}: the name of an interrupted recording ends in {SUFFIX}")
    if path.exists():
        raise FileExistsError(f"{path} exists: a complete recording is not replaced by a recovered one")
    unfinished = path.with_name(path.name + ".recovered")
    try:
        with open_plain(part) as source, create(unfinished) as target:
            with refusing(part):
                _copy(source, target)
            publish(target, unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def _copy(source: IO[bytes], target: IO[bytes]) -> None:
    """Copy everything up to the end of the last complete episode, and complete the file."""
    rescue = _Rescue(McapStream(target, LIBRARY))
    for record in _records(source):
        rescue.take(record)
    rescue.finish()


class _Rescue:
    """Rewrites the records of an interrupted file, an episode only once all of its states are there."""

    def __init__(self, out: McapStream) -> None:
        self._out = out
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._topics: Topics | None = None
        self._table = b""
        self._episodes: list[Any] = []  # srlrace.Episode of each complete one
        self._blocks: list[bytes] = []  # records of the episode that is being read
        self._missing = 0  # states that it still lacks

    def take(self, record: McapRecord) -> None:
        """Copy or keep one record of the data section."""
        if isinstance(record, Schema):
            self._schemas.append(record)
            self._out.schema(record.name, record.data)
        elif isinstance(record, Channel):
            self._channels.append(record)
            self._out.channel(record.topic, record.schema_id, record.metadata)
        elif isinstance(record, Metadata):
            self._out.metadata(record.name, record.metadata)
        elif isinstance(record, Attachment) and record.name == EPISODES_NAME:
            self._table = record.data  # it was interrupted at the very end
        elif isinstance(record, Attachment):
            self._out.attachment(record.name, record.media_type, record.data, record.log_time)
        elif isinstance(record, Chunk):
            self._take_block(unpack_chunk(record))

    def _take_block(self, block: bytes) -> None:
        self._topics = self._topics or Topics.check(self._schemas, self._channels)
        found = messages(block)
        for head in found.get(self._topics.episode, []):
            self._episode = episode_class().FromString(head)
            self._missing, self._blocks = self._episode.steps, []
        self._missing -= len(found.get(self._topics.state, []))
        self._blocks.append(block)
        if sum(map(len, self._blocks)) > MAX_UNPACKED:
            raise CorruptRecording(f"an episode has more than {MAX_UNPACKED} bytes")
        if self._missing == 0:
            for done in self._blocks:
                self._out.chunk(done, _index(done))
            self._episodes.append(self._episode)
            self._blocks = []

    def finish(self) -> None:
        """Add the table of the complete episodes and end the file."""
        if self._topics is None or not self._episodes:
            raise CorruptRecording("it holds no complete episode")
        end = EPOCH + (self._episodes[-1].episode + 1) * self._topics.period
        self._out.attachment(EPISODES_NAME, "text/csv", self._table or _table(self._episodes), end)
        self._out.finish()


def _records(source: IO[bytes]) -> Iterator[McapRecord]:
    """The records of a data section that are whole; ends silently where the interrupted file does."""
    size = os.fstat(source.fileno()).st_size
    if source.read(len(MAGIC)) != MAGIC:
        raise CorruptRecording("this is no MCAP file")
    while source.tell() + RECORD_HEAD.size <= size:
        opcode, length = RECORD_HEAD.unpack(source.read(RECORD_HEAD.size))
        if opcode == Opcode.DATA_END or length > min(size - source.tell(), MAX_ATTACHMENT):
            return
        body = source.read(length)
        if opcode in _KINDS:
            record = parse(_KINDS[opcode], body)
            if _damaged(record, body):
                return
            yield record


def _damaged(record: McapRecord, body: bytes) -> bool:
    """Whether a record's checksum is wrong, as in blocks that a crashed machine never wrote."""
    if isinstance(record, Attachment):
        return zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little")
    if isinstance(record, Chunk):
        try:
            unpack_chunk(record)
        except (CorruptRecording, zstandard.ZstdError):
            return True
    return False


def _index(block: bytes) -> dict[int, np.ndarray]:
    """Log time and offset of each message among a chunk's records, by channel id."""
    index: dict[int, list[tuple[int, int]]] = {}
    for channel, start, _ in places(block):
        header = np.frombuffer(block, MESSAGE_HEADER, 1, start)
        index.setdefault(channel, []).append((int(header["log_time"][0]), start))
    return {channel: np.array(entries, np.uint64) for channel, entries in index.items()}


def _table(episodes: list[Any]) -> bytes:
    """episodes.csv with the columns that the recording knows."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for episode in episodes:
        time = "" if math.isnan(episode.time) else f"{episode.time:.6f}"
        writer.writerow((episode.episode, episode.seed, episode.map, episode.outcome, time))
    return text.getvalue().encode()
