"""Independent answers in numpy: every sphere of a map by enumeration, chords by dense sampling."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from srlrace.config import Config, ObstacleConfig
from srlrace.task.race import Race


class Spheres:
    """All spheres of one map, in float64."""

    def __init__(self, race: Race, map_index: int) -> None:
        obstacles = race.field.obstacles(map_index)
        parts = [obstacle.spheres() for obstacle in obstacles]
        self.centres = np.concatenate(parts)
        self.radii = np.repeat([obstacle.sphere_radius for obstacle in obstacles], [len(part) for part in parts])
        self.first = np.cumsum([0] + [len(part) for part in parts[:-1]])

    def distances(self, point: Any) -> Any:
        """From a point to the nearest centre of each obstacle."""
        return np.minimum.reduceat(np.linalg.norm(self.centres - point, axis=1), self.first)

    def gap(self, points: Any) -> float:
        """Smallest distance from any of the points to any surface."""
        points = np.atleast_2d(points)
        near = np.linalg.norm(self.centres - points[0], axis=1) < 12  # m, and no point is far from the first
        between = np.linalg.norm(points[:, None] - self.centres[near], axis=2) - self.radii[near]
        return float(between.min(initial=np.inf))

    def ray(self, point: Any, direction: Any, inflation: float, reach: float) -> float:
        """Distance to the first inflated sphere along a direction."""
        m, radii = self.centres - point, self.radii + inflation
        along, squared = m @ direction, (m * m).sum(axis=1)
        if (squared <= radii**2).any():
            return 0.0
        inside = along**2 - squared + radii**2
        hit = (inside > 0) & (along > 0)
        return float(min([reach, *(along[hit] - np.sqrt(inside[hit]))]))


@pytest.fixture(scope="session")
def spheres() -> Any:
    return Spheres


@pytest.fixture(scope="session")
def with_obstacles(config: Any) -> Any:
    """The Forest with these obstacles alone, and a start that is always the same."""

    def build(*obstacles: ObstacleConfig, **level: Any) -> Config:
        plain = config("level=none", "randomization=none")
        return dataclasses.replace(plain, level=dataclasses.replace(plain.level, obstacles=obstacles, **level))

    return build
