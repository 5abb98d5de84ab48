"""Tracks: the order in which waypoints are passed, and tracks that users bring as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from srlrace.config import TrackConfig

MAX_TRACK_BYTES = 1_000_000  # a hand-written track is a few kB
TRACK_DEFAULTS: dict[str, Any] = {"laps": 0, "horizon": 20.0}  # s; the paper's tasks take 20 s as well


def target_sequence(track: TrackConfig) -> tuple[int, ...]:
    """Indices of the waypoints in the order of passing.

    A course (``laps`` = 0) passes each once. With k laps all are passed k times and the first once more; a lap
    is the time from one crossing of the first waypoint to the next, so the run-up from the start is not timed.
    """
    once = tuple(range(len(track.waypoints)))
    return once if track.laps == 0 else once * track.laps + once[:1]


def load_track(path: str | Path) -> dict[str, Any]:
    """Read a user's track file: one YAML mapping with the fields of `TrackConfig`.

    ``name`` defaults to the file's stem, ``laps`` to 0, ``horizon`` to 20 s. Values are checked where the Config
    is built. Hydra's ``defaults`` list is dropped, so that a preset of ours can be copied and loaded by path.

    Raises ValueError with a message to the user: no such file, too large, not YAML, not a mapping.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_TRACK_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot read the track {path}: {error.strerror or error}") from error
    if len(raw) > MAX_TRACK_BYTES:
        raise ValueError(f"the track {path} is larger than {MAX_TRACK_BYTES} bytes")
    try:
        data = yaml.safe_load(raw)
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise ValueError(f"the track {path} is not valid YAML: {error}") from error
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise ValueError(f"the track {path} must be a mapping such as 'waypoints: [[0, 0, 1], ...]'")
    data.pop("defaults", None)
    return {"name": path.stem, **TRACK_DEFAULTS, **data}
