"""The time-optimal reference of a track, flown beside the policies as a ghost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from srlrace.config import Config
from srlrace.recording import Flight, read_flight, recorded_episodes
from srlrace.runs import RunError

PLACE = 1.5  # m that a gate of the reference may lie from the track's: episodes displace gates by up to 1 m


@dataclass(frozen=True)
class Reference:
    """A request for the ghost: a recording of it, or, without one, the solved reference of the run's track."""

    file: Path | None = None

    def flight(self, config: Config) -> Flight:
        """The ghost's flight; raises `RunError` when there is none for this track, CorruptRecording for a bad file."""
        path = self.file or solved(config)
        flight = read_flight(path, recorded_episodes(path)[0])
        gates = np.array(config.env.waypoints)
        if flight.waypoints.shape != gates.shape or (np.linalg.norm(flight.waypoints - gates, axis=1) > PLACE).any():
            raise RunError(f"{path} is a reference for another track than {config.env.name}")
        return flight


def solved(config: Config) -> Path:
    """The recording of the track's solved reference."""
    name = config.env.name
    raise RunError(f"no time-optimal reference of {name} at hand; solve it with: srlrace bound env={name} "
                   f"--out {name}.mcap, and pass --reference-file {name}.mcap")  # fmt: skip
