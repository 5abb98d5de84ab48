"""Tracks and levels as shipped, and an independent answer to every query: enumerate all spheres in float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from srlrace.config import LevelConfig, ObstacleConfig, SpacingConfig, TrackConfig
from srlrace.world.obstacles import Obstacle

CONF = Path(__file__).parents[3] / "conf"


def read_track(name: str) -> TrackConfig:
    data = yaml.safe_load((CONF / "env" / f"{name}.yaml").read_text())
    del data["defaults"]
    return TrackConfig(**{k: tuple(map(tuple, v)) if k == "waypoints" else _tuple(v) for k, v in data.items()})


def read_level(name: str, **changes: Any) -> LevelConfig:
    data = yaml.safe_load((CONF / "level" / f"{name}.yaml").read_text()) | changes
    spacings = tuple(SpacingConfig(**s) for s in data.pop("spacings"))
    obstacles = tuple(ObstacleConfig(**{k: _tuple(v) for k, v in o.items()}) for o in data.pop("obstacles"))
    return LevelConfig(**data, spacings=spacings, obstacles=obstacles)


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


class Enumeration:
    """Brute force over all spheres of a map."""

    def __init__(self, obstacles: tuple[Obstacle, ...]) -> None:
        parts = [obstacle.spheres() for obstacle in obstacles]
        self.spheres = np.concatenate(parts)
        self.first = np.cumsum([0] + [len(part) for part in parts[:-1]])
        self.radii = np.array([obstacle.sphere_radius for obstacle in obstacles])
        self.sphere_radii = np.repeat(self.radii, [len(part) for part in parts])

    def distances(self, point: Any) -> Any:
        """Distance to the nearest centre of each obstacle."""
        return np.minimum.reduceat(np.linalg.norm(self.spheres - point, axis=1), self.first)

    def gap(self, point: Any) -> float:
        return float((self.distances(point) - self.radii).min())

    def swept_gap(self, start: Any, end: Any) -> float:
        start = np.asarray(start, float)
        u = end - start
        t = np.clip((self.spheres - start) @ u / max(u @ u, 1e-300), 0, 1)
        return float((np.linalg.norm(start + t[:, None] * u - self.spheres, axis=1) - self.sphere_radii).min())

    def ray(self, point: Any, direction: Any, inflation: float, reach: float) -> float:
        """Distance along a 3-D direction to the first inflated sphere: one quadratic equation per sphere."""
        m, radii = self.spheres - point, self.sphere_radii + inflation
        along, d2 = m @ direction, (m * m).sum(axis=1)
        if (d2 <= radii**2).any():
            return 0.0
        disc = along**2 - d2 + radii**2
        hit = (disc > 0) & (along > 0)
        return float(min([reach, *(along[hit] - np.sqrt(disc[hit]))]))


@pytest.fixture(scope="session")
def forest() -> TrackConfig:
    return read_track("forest")


@pytest.fixture(scope="session")
def split_s() -> TrackConfig:
    return read_track("split_s")


@pytest.fixture(scope="session")
def level() -> Any:
    return read_level


@pytest.fixture(scope="session")
def enumeration() -> Any:
    return Enumeration
