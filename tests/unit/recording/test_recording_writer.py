"""What the writer puts on disk, seen through the MCAP library's own reader and protobuf's own decoder."""

from __future__ import annotations

import dataclasses
import resource
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_protobuf.decoder import DecoderFactory

from srlrace.recording import Flight, RecordingWriter
from srlrace.recording import writer as writer_module

VECTORS = {
    "position": ("position_w", "xyz"),
    "velocity": ("velocity_w", "xyz"),
    "quaternion": ("quaternion_wb", "wxyz"),
    "body_rate": ("body_rate_b", "xyz"),
    "rotor_thrust": ("rotor_thrust", "0123"),
}


def decoded(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Log times and messages of a topic, every checksum verified."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(raw.log_time, message) for _, _, raw, message in reader.iter_decoded_messages(topics=[topic])]


def test_every_number_of_every_state_arrives(recording: Path, flights: Sequence[Flight]) -> None:
    messages = iter(decoded(recording, "/state"))
    for flight in flights:
        for row in range(len(flight.time)):
            _, state = next(messages)
            assert (state.episode, state.time) == (flight.episode, flight.time[row])
            for prefix, (array, axes) in VECTORS.items():
                found = [getattr(state, f"{prefix}_{axis}") for axis in axes]
                np.testing.assert_array_equal(found, getattr(flight, array)[row])
            action = [state.action_thrust, state.action_rate_x, state.action_rate_y, state.action_rate_z]
            np.testing.assert_array_equal(action, flight.action[row])
            rewards = [state.reward_progress, state.reward_safety, state.reward_collision]
            np.testing.assert_array_equal(rewards, flight.reward_terms[row])
            assert state.speed == pytest.approx(np.linalg.norm(flight.velocity_w[row]), rel=1e-15)
            assert (state.clearance, state.target) == (flight.clearance[row], flight.target[row])
    assert next(messages, None) is None


def test_poses_carry_position_attitude_and_their_own_time(recording: Path, flights: Sequence[Flight]) -> None:
    messages = iter(decoded(recording, "/drone/pose"))
    for flight in flights:
        for row in range(len(flight.time)):
            log_time, pose = next(messages)
            position, orientation = pose.pose.position, pose.pose.orientation
            assert pose.frame_id == "world"
            assert pose.timestamp.seconds * 10**9 + pose.timestamp.nanos == log_time
            np.testing.assert_array_equal([position.x, position.y, position.z], flight.position_w[row])
            wxyz = [orientation.w, orientation.x, orientation.y, orientation.z]
            np.testing.assert_array_equal(wxyz, flight.quaternion_wb[row])


def test_episodes_say_how_they_ended(recording: Path, flights: Sequence[Flight]) -> None:
    for flight, (_, episode) in zip(flights, decoded(recording, "/episode"), strict=True):
        assert (episode.episode, episode.seed, episode.map) == (flight.episode, flight.seed, flight.map_seed)
        assert (episode.outcome, episode.steps) == (flight.outcome, len(flight.time))
        assert np.isnan(episode.time) if flight.finish_time is None else episode.time == flight.finish_time


def test_scene_draws_obstacles_at_the_size_they_collide_with(recording: Path, flights: Sequence[Flight]) -> None:
    scenes = decoded(recording, "/scene")
    assert len(scenes) == len(flights)
    for flight, (_, scene) in zip(flights, scenes, strict=True):
        obstacles, gates, path = scene.entities
        sphere, cylinder, box = flight.scene
        assert [obstacles.spheres[0].size.x, obstacles.spheres[0].size.z] == [2 * sphere.radius] * 2
        size = obstacles.cylinders[0].size
        assert (size.x, size.y, size.z) == (2 * cylinder.radius, 2 * cylinder.radius, cylinder.height)
        assert [obstacles.cubes[0].size.x, obstacles.cubes[0].size.y] == [box.edge] * 2
        assert [gate.pose.position.x for gate in gates.spheres] == flight.waypoints[:, 0].tolist()
        assert [point.z for point in path.lines[0].points] == flight.position_w[:, 2].tolist()


def test_episodes_follow_each_other_on_a_fixed_timeline(recording: Path, flights: Sequence[Flight]) -> None:
    epoch = 946_684_800 * 10**9  # 2000-01-01
    times = [time for time, _ in decoded(recording, "/episode")]
    assert times == [epoch + k * 11 * 10**9 for k in range(3)]
    first = [time for time, state in decoded(recording, "/state") if state.episode == 1]
    assert first == [times[1] + k * 20_000_000 for k in range(25)]


def test_index_leads_to_every_message(recording: Path) -> None:
    with recording.open("rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
    chunks = [record for record in records if isinstance(record, Chunk)]
    indexes = [record for record in records if isinstance(record, MessageIndex)]
    assert len(chunks) == 3
    assert len(indexes) == 12
    with recording.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    total = sum(len(breakup_chunk(chunk)) for chunk in chunks)
    assert total == sum(len(index.records) for index in indexes) == summary.statistics.message_count == 2 * 105 + 6
    assert list(summary.statistics.channel_message_counts.values()) == [3, 3, 105, 105]


def test_same_flights_give_the_same_bytes(
    recording: Path, flights: Sequence[Flight], make_recording: Callable[[Sequence[Flight]], Path]
) -> None:
    assert make_recording(flights).read_bytes() == recording.read_bytes()


def test_arrays_of_the_simulator_are_taken_as_they_are(
    flights: Sequence[Flight], make_recording: Callable[[Sequence[Flight]], Path]
) -> None:
    """Single precision, and columns of a larger array."""
    narrow = np.asfortranarray(flights[0].position_w.astype(np.float32))
    path = make_recording([dataclasses.replace(flights[0], position_w=narrow)])
    found = [state.position_y for _, state in decoded(path, "/state")]
    assert found == narrow[:, 1].astype(float).tolist()


def test_long_episode_takes_several_chunks(
    make_flight: Callable[..., Flight],
    make_recording: Callable[[Sequence[Flight]], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writer_module, "ROWS_PER_CHUNK", 16)
    path = make_recording([make_flight(0, steps=40)])
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 3
    assert [state.time for _, state in decoded(path, "/state")] == (np.arange(40) * 0.02).tolist()


def open_writer(path: Path) -> RecordingWriter:
    return RecordingWriter(path, metadata={}, reward_terms=("a", "b", "c"), horizon=1.0, config_json=b"{}")


def test_nothing_has_the_final_name_before_it_is_complete(tmp_path: Path, make_flight: Callable[..., Flight]) -> None:
    path = tmp_path / "t.mcap"
    with open_writer(path) as writer:
        writer.write(make_flight(0))
        assert not path.exists()
    assert not path.exists()
    assert path.with_name("t.mcap.part").exists()


def test_disk_without_room_is_an_error_and_leaves_the_part(tmp_path: Path, make_flight: Callable[..., Flight]) -> None:
    """The kernel refuses to let the file grow, as on a full disk."""
    path = tmp_path / "t.mcap"

    def write() -> None:
        with open_writer(path) as writer:
            writer.write(make_flight(0))
            writer.finish(b"")

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [file.name for file in tmp_path.iterdir()] == ["t.mcap.part"]


def test_link_in_place_of_the_part_is_not_followed(tmp_path: Path, make_flight: Callable[..., Flight]) -> None:
    """A run folder from a stranger must not decide which file is written."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    path = tmp_path / "t.mcap"
    path.with_name("t.mcap.part").symlink_to(victim)
    with open_writer(path) as writer:
        writer.write(make_flight(0))
        writer.finish(b"")
    assert victim.read_text() == "precious"
    assert not path.is_symlink()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.zeros(40)}, "increasing"),
        ({"time": np.full(40, np.nan)}, "finite"),
        ({"position_w": np.zeros((39, 3))}, "position_w"),
        ({"waypoints": np.zeros(3)}, "waypoints"),
        ({"reward_terms": np.zeros((40, 2))}, "3 reward terms"),
        ({"time": np.arange(1.0, 41.0)}, "horizon"),
        ({"episode": 0}, "must increase"),
    ],
)
def test_flights_that_do_not_fit_are_refused(
    tmp_path: Path, make_flight: Callable[..., Flight], change: dict[str, Any], message: str
) -> None:
    with open_writer(tmp_path / "t.mcap") as writer:
        writer.write(make_flight(0))
        with pytest.raises(ValueError, match=message):
            writer.write(dataclasses.replace(make_flight(1), **change))


@pytest.mark.parametrize("terms", [("Bad Name",), ("same", "same"), ("",)])
def test_reward_terms_must_be_names(tmp_path: Path, terms: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="reward term"):
        RecordingWriter(tmp_path / "t.mcap", metadata={}, reward_terms=terms, horizon=1.0, config_json=b"")
