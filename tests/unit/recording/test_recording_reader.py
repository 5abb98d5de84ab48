"""Reading recordings back, damaged ones included."""

from __future__ import annotations

import dataclasses
import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import zstandard
from mcap.writer import Writer

from srlrace.recording import (
    CorruptRecording,
    Flight,
    read_config,
    read_episodes,
    read_flight,
    read_metadata,
    read_states,
    recover,
)
from srlrace.recording import archive as archive_module
from srlrace.recording import writer as writer_module
from srlrace.recording.container import McapStream
from srlrace.recording.schema import STATE_TYPE, episode_schema, state_layout, state_schema
from srlrace.recording.topics import PERIOD_KEY


def assert_same_flight(found: Flight, expected: Flight) -> None:
    for field in dataclasses.fields(Flight):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), err_msg=field.name)


def test_flights_come_back_as_they_were(recording: Path, flights: Sequence[Flight]) -> None:
    for flight in flights:
        assert_same_flight(read_flight(recording, flight.episode), flight)


def test_states_are_one_table(recording: Path, flights: Sequence[Flight]) -> None:
    states = read_states(recording)
    assert len(states) == sum(len(flight.time) for flight in flights)
    assert states["episode"].tolist() == [flight.episode for flight in flights for _ in flight.time]
    speeds = np.concatenate([flight.velocity_w for flight in flights])
    np.testing.assert_array_equal(states[["velocity_x", "velocity_y", "velocity_z"]], speeds)
    np.testing.assert_array_equal(states["reward_safety"], np.concatenate([f.reward_terms[:, 1] for f in flights]))
    assert states["target"].dtype == np.int64


def test_some_episodes_only(recording: Path) -> None:
    states = read_states(recording, [2, 0])
    pd.testing.assert_frame_equal(states, read_states(recording).query("episode != 1").reset_index(drop=True))
    assert read_states(recording, []).empty


def test_split_episode_is_read_as_one(
    make_flight: Callable[..., Flight],
    make_recording: Callable[[Sequence[Flight]], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writer_module, "ROWS_PER_CHUNK", 16)
    path = make_recording([make_flight(3), make_flight(7)])
    assert_same_flight(read_flight(path, 7), make_flight(7))


def test_unknown_episode(recording: Path) -> None:
    with pytest.raises(KeyError, match="99"):
        read_states(recording, [0, 99])
    with pytest.raises(KeyError, match="99"):
        read_flight(recording, 99)


def test_attachments_and_metadata(recording: Path) -> None:
    assert read_episodes(recording)["outcome"].tolist() == ["finished", "crashed", "finished"]
    assert read_config(recording) == b'{"seed": 1}\n'
    assert read_metadata(recording) == {"run": "forest-srl-s1", "seed": "1"}


def everything(path: Path) -> list[Any]:
    """All that can be read from a recording of three episodes."""
    tables = [read_states(path), read_episodes(path)]
    scenes = [(f.seed, f.outcome, f.waypoints.tobytes(), f.scene) for f in (read_flight(path, k) for k in range(3))]
    return [*(table.to_json() for table in tables), scenes, read_config(path), read_metadata(path)]


def mutants(data: bytes, count: int) -> list[bytes]:
    """Damaged copies of a file: bits, bytes, lengths, blocks, ends."""
    rng = np.random.default_rng(7)
    found = []
    for index in range(count):
        place = int(rng.integers(len(data)))
        copy = bytearray(data)
        match index % 6:
            case 0:
                copy[place] ^= 1 << int(rng.integers(8))
            case 1:
                copy[place : place + 8] = b"\xff" * 8
            case 2:
                del copy[place:]
            case 3:
                del copy[place : place + int(rng.integers(1, 64))]
            case 4:
                copy[place : place + 16] = bytes(16)
            case _:
                copy[-int(rng.integers(1, 600))] ^= 0xFF
        found.append(bytes(copy))
    return found


def test_damage_never_gives_wrong_data(recording: Path, tmp_path: Path) -> None:
    truth = everything(recording)
    path = tmp_path / "mutant.mcap"
    refused = 0
    for mutant in mutants(recording.read_bytes(), 600):
        path.write_bytes(mutant)
        try:
            assert everything(path) == truth
        except CorruptRecording:
            refused += 1
    assert refused > 500


def test_damage_never_breaks_recovery(recording: Path, tmp_path: Path, flights: Sequence[Flight]) -> None:
    part, path = tmp_path / "m.mcap.part", tmp_path / "m.mcap"
    recovered = 0
    for mutant in mutants(recording.read_bytes(), 300):
        part.write_bytes(mutant)
        try:
            recover(part)
        except CorruptRecording:
            assert not path.exists()
            continue
        recovered += 1
        for episode in read_states(path)["episode"].unique().tolist():
            np.testing.assert_array_equal(read_flight(path, episode).position_w, flights[episode].position_w)
        path.unlink()
    assert recovered > 100


@contextmanager
def forged(path: Path, schema: bytes = state_schema(["a"]), name: str = STATE_TYPE) -> Iterator[McapStream]:
    """A file that takes any chunks and has valid checksums."""
    with path.open("wb") as stream:
        out = McapStream(stream, "forger")
        topics = (
            ("/state", name, schema),
            ("/scene", "foxglove.SceneUpdate", b""),
            ("/episode", "srlrace.Episode", episode_schema()),
        )
        for topic, kind, data in topics:
            out.channel(topic, out.schema(kind, data), {PERIOD_KEY: "1000"})
        yield out
        out.finish()


class Packed:
    """A compressor that has only one answer."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def compress(self, records: bytes) -> bytes:
        return self.data


ONE_MESSAGE = {1: np.zeros((1, 2), np.uint64)}


@contextmanager
def little_memory() -> Iterator[None]:
    """At most 8 MiB are allocated at any moment inside."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 2**20


def test_zstd_bomb_is_refused_before_it_unpacks(tmp_path: Path) -> None:
    size = archive_module.MAX_CHUNK + 1
    path = tmp_path / "bomb.mcap"
    with forged(path) as out:
        out.chunk(bytes(size), ONE_MESSAGE)
    assert path.stat().st_size < 20_000
    with little_memory(), pytest.raises(CorruptRecording, match="limit"):
        read_states(path)


@pytest.mark.parametrize("claimed", [None, 1000])
def test_bomb_that_hides_its_size_is_refused(tmp_path: Path, claimed: int | None) -> None:
    """The frame gives no size, or a smaller one than it unpacks to."""
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(2**28))
    if claimed:
        frame = zstandard.compress(bytes(claimed)) + frame  # a second frame behind an honest one
    path = tmp_path / "bomb.mcap"
    with forged(path) as out:
        out._compressor = Packed(frame)  # type: ignore[assignment]
        out.chunk(bytes(1000), ONE_MESSAGE)
    with little_memory(), pytest.raises(CorruptRecording):
        read_states(path)


def test_many_chunks_are_limited_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recording: Path) -> None:
    monkeypatch.setattr(archive_module, "MAX_UNPACKED", 20_000)
    assert len(read_states(recording, [1])) == 25
    with pytest.raises(CorruptRecording, match="fewer episodes"):
        read_states(recording)


@pytest.mark.parametrize(
    ("schema", "name"),
    [
        (state_schema(["a"]), "other.State"),
        (state_schema(["a"])[:-1], STATE_TYPE),
        (b"\xff" * 40, STATE_TYPE),
        (b"", STATE_TYPE),
        (episode_schema(), STATE_TYPE),
    ],
)
def test_other_schemas_are_refused(tmp_path: Path, schema: bytes, name: str) -> None:
    path = tmp_path / "other.mcap"
    with forged(path, schema, name):
        pass
    with pytest.raises(CorruptRecording):
        read_states(path)


def state_message(payload: bytes) -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + len(payload), 1, 0, 0, 0) + payload


def test_messages_that_are_not_their_schema_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "wrong.mcap"
    good = state_layout(["a"]).template.tobytes()
    for payload in (good[:-1], b"\x12" + good[1:], good + b"\x00", b""):
        with forged(path) as out:
            out.chunk(state_message(payload), ONE_MESSAGE)
        with pytest.raises(CorruptRecording, match="state message"):
            read_states(path)
    with forged(path) as out:
        out.chunk(state_message(good), ONE_MESSAGE)
    assert len(read_states(path)) == 1


@pytest.mark.parametrize("tail", [b"\x05", struct.pack("<BQH", 5, 2**63, 1), struct.pack("<BQH", 5, 4, 1) + bytes(2)])
def test_records_that_leave_their_chunk_are_refused(tmp_path: Path, tail: bytes) -> None:
    path = tmp_path / "wrong.mcap"
    with forged(path) as out:
        out.chunk(state_message(state_layout(["a"]).template.tobytes()) + tail, ONE_MESSAGE)
    with pytest.raises(CorruptRecording):
        read_states(path)


def test_index_that_repeats_a_chunk_is_refused(tmp_path: Path) -> None:
    """Else a small file could ask for the same bomb a million times."""
    path = tmp_path / "again.mcap"
    with forged(path) as out:
        for _ in range(2):
            out.chunk(state_message(state_layout(["a"]).template.tobytes()), ONE_MESSAGE)
        out._chunks[1] = out._chunks[0]
    with pytest.raises(CorruptRecording, match="overlap"):
        read_states(path)


@pytest.mark.parametrize("field", ["chunk_start_offset", "chunk_length"])
@pytest.mark.parametrize("value", [0, 1, 2**31, 2**63, 2**64 - 1])
def test_index_that_points_elsewhere_is_refused(tmp_path: Path, field: str, value: int) -> None:
    path = tmp_path / "lie.mcap"
    with forged(path) as out:
        out.chunk(state_message(state_layout(["a"]).template.tobytes()), ONE_MESSAGE)
        setattr(out._chunks[0], field, value)
    with pytest.raises(CorruptRecording):
        read_states(path)


def test_forged_summaries_are_refused_or_read(recording: Path, tmp_path: Path) -> None:
    """Damage whose checksum was put right again may change the data but raises nothing else."""
    data = recording.read_bytes()
    start = struct.unpack_from("<Q", data, len(data) - 28)[0]
    path = tmp_path / "forged.mcap"
    rng = np.random.default_rng(3)
    for _ in range(400):
        summary = bytearray(data[start:-8])
        place = int(rng.integers(len(summary) - 4))
        summary[place : place + int(rng.integers(1, 9))] = rng.bytes(int(rng.integers(1, 9)))
        summary[-4:] = struct.pack("<I", zlib.crc32(summary[:-4]))
        path.write_bytes(data[:start] + bytes(summary) + data[-8:])
        with suppress(CorruptRecording, KeyError):  # KeyError: the episode was moved elsewhere in time
            everything(path)


def test_foreign_mcap_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/chatter", "json", writer.register_schema("s", "jsonschema", b"{}"))
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    with pytest.raises(CorruptRecording, match="/state"):
        read_states(path)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 2, b"PK\x03\x04" + bytes(100)])
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(CorruptRecording, match=r"x\.mcap"):
        read_metadata(path)


def test_pipe_is_refused_and_missing_file_is_missing(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CorruptRecording, match="plain file"):
        read_states(tmp_path / "pipe")
    with pytest.raises(FileNotFoundError):
        read_states(tmp_path / "missing.mcap")
