"""Keeping the complete episodes of interrupted recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from mcap.reader import make_reader

from srlrace.recording import (
    CorruptRecording,
    Flight,
    RecordingWriter,
    read_config,
    read_episodes,
    read_metadata,
    read_states,
    recover,
)
from srlrace.recording import writer as writer_module


def open_writer(path: Path) -> RecordingWriter:
    terms = ("progress", "safety", "collision")
    return RecordingWriter(path, metadata={"run": "r"}, reward_terms=terms, horizon=10.0, config_json=b"{}")


def interrupted(path: Path, flights: Sequence[Flight], lose: int = 0) -> Path:
    """The .part file of a recording that was killed after these flights, without its last bytes."""
    with open_writer(path) as writer:
        for flight in flights:
            writer.write(flight)
        part = writer.part
    data = part.read_bytes()
    part.write_bytes(data[: len(data) - lose])
    return part


def test_complete_episodes_are_kept(tmp_path: Path, flights: Sequence[Flight]) -> None:
    part = interrupted(tmp_path / "t.mcap", flights, lose=8000)  # the last chunk is cut
    before = part.read_bytes()
    path = recover(part)
    assert path == tmp_path / "t.mcap"
    assert part.read_bytes() == before
    assert read_states(path)["episode"].unique().tolist() == [0, 1]
    assert read_metadata(path) == {"run": "r"}
    assert read_config(path) == b"{}"
    table = read_episodes(path)
    assert table["outcome"].tolist() == ["finished", "crashed"]
    assert table["time_s"].fillna(-1).tolist() == [0.78, -1]
    assert table["map"].tolist() == [flight.map_seed for flight in flights[:2]]
    with path.open("rb") as stream:  # an independent reader takes it, checksums and all
        assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == 2 * 65 + 4


@pytest.mark.parametrize("lose", [0, 1, 50, 2000, 10_000])
def test_recovered_equals_written(tmp_path: Path, flights: Sequence[Flight], lose: int) -> None:
    """Recovering k episodes gives the bytes of a recording that only ever had these k."""
    path = recover(interrupted(tmp_path / "t.mcap", flights, lose))
    kept = read_states(path)["episode"].unique().tolist()
    assert len(kept) >= 2
    rows = ["episode,seed,map,outcome,time_s"]
    for flight in flights[: len(kept)]:
        time = "" if flight.finish_time is None else f"{flight.finish_time:.6f}"
        rows.append(f"{flight.episode},{flight.seed},{flight.map_seed},{flight.outcome},{time}")
    other = tmp_path / "other.mcap"
    with open_writer(other) as writer:
        for flight in flights[: len(kept)]:
            writer.write(flight)
        writer.finish("\n".join([*rows, ""]).encode())
    assert path.read_bytes() == other.read_bytes()


def test_interrupted_before_the_rename_loses_nothing(tmp_path: Path, recording: Path) -> None:
    part = tmp_path / "t.mcap.part"
    part.write_bytes(recording.read_bytes())
    assert recover(part).read_bytes() == recording.read_bytes()


def test_episode_of_several_chunks_is_kept_whole_or_not_at_all(
    tmp_path: Path, make_flight: Callable[..., Flight], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "ROWS_PER_CHUNK", 16)
    path = recover(interrupted(tmp_path / "t.mcap", [make_flight(0), make_flight(1)], lose=1500))
    assert read_states(path)["episode"].tolist() == [0] * 40


def test_nothing_to_recover(tmp_path: Path, flights: Sequence[Flight]) -> None:
    part = interrupted(tmp_path / "t.mcap", [])
    for content in (part.read_bytes(), b"", b"no recording"):
        part.write_bytes(content)
        with pytest.raises(CorruptRecording, match=r"t\.mcap\.part"):
            recover(part)
        assert [file.name for file in tmp_path.iterdir()] == ["t.mcap.part"]


def test_complete_recording_is_not_replaced(tmp_path: Path, flights: Sequence[Flight]) -> None:
    part = interrupted(tmp_path / "t.mcap", flights)
    recover(part)
    with pytest.raises(FileExistsError, match=r"t\.mcap exists"):
        recover(part)
    with pytest.raises(ValueError, match=r"\.part"):
        recover(tmp_path / "t.mcap")
