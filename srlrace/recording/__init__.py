"""Recordings of flights: MCAP files that Foxglove, Rerun and pandas read."""

from srlrace.recording.flight import Flight, SceneObstacle
from srlrace.recording.writer import RecordingWriter

__all__ = ["Flight", "RecordingWriter", "SceneObstacle"]
