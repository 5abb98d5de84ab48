"""A user's own track file, written out as overrides of ``env``: every launcher can carry those."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from srlrace.config import to_dict
from srlrace.parse import ConfigError, parse
from srlrace.schema import TrackConfig
from srlrace.world.track import load_track

MARGIN = 6.0  # m around the waypoints and the start, where the file gives no bounds; ours


def track_overrides(path: str) -> Iterator[str]:
    """Read and check a track file; yields the overrides that describe it. Raises `ConfigError`."""
    if not Path(path).is_file():
        raise ConfigError(f"env: got {path!r}, and there is no such file; takes a track file or the name of a track")
    try:
        track = parse(TrackConfig, with_bounds(load_track(path)), "env")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except ValueError as error:
        raise ConfigError(f"env: {' '.join(str(error).split())}") from None
    yield "env='forest'"
    for key, value in to_dict(track).items():
        yield f"++env.{key}={_literal(value)}"


def with_bounds(data: dict[str, Any]) -> dict[str, Any]:
    """Accept ``bounds: [[low], [high]]``; without bounds, leave a margin around the track, and the floor at 0."""
    data = dict(data)
    bounds = data.pop("bounds", None)
    if bounds is not None:
        if not isinstance(bounds, list) or len(bounds) != 2:
            raise ConfigError(
                f"env.bounds: got {bounds!r:.60}; takes [[x, y, z], [x, y, z]], low corner and high corner"
            )
        data |= {"bounds_low": bounds[0], "bounds_high": bounds[1]}
    elif "bounds_low" not in data and "bounds_high" not in data:
        data |= _around(data)
    return data


def _around(data: dict[str, Any]) -> dict[str, Any]:
    try:
        x, y, z = zip(*data["waypoints"], data["start"], strict=True)
        low, high = [min(x) - MARGIN, min(y) - MARGIN, 0.0], [max(x) + MARGIN, max(y) + MARGIN, max(z) + MARGIN]
    except (KeyError, TypeError, ValueError):
        return {}  # what is wrong with the points is said where they are checked
    return {"bounds_low": low, "bounds_high": high}


def _literal(value: Any) -> str:
    """A checked value in Hydra's notation: JSON, with the keys of objects bare."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_literal(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_literal, value)) + "]"
    return f"'{value}'" if isinstance(value, str) else json.dumps(value)
