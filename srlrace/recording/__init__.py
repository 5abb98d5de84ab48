"""Recordings of flights: MCAP files that Foxglove, Rerun and pandas read."""

from srlrace.recording.archive import CorruptRecording
from srlrace.recording.flight import Flight, SceneObstacle
from srlrace.recording.reader import (
    read_config,
    read_episodes,
    read_flight,
    read_metadata,
    read_states,
    recorded_episodes,
)
from srlrace.recording.recover import recover
from srlrace.recording.writer import RecordingWriter

__all__ = [
    "CorruptRecording",
    "Flight",
    "RecordingWriter",
    "SceneObstacle",
    "read_config",
    "read_episodes",
    "read_flight",
    "read_metadata",
    "read_states",
    "recorded_episodes",
    "recover",
]
