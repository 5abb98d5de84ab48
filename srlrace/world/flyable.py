"""Which maps can be flown: a geometric certificate, and the unseen maps of the evaluation.

The certificate says that a ball around the drone can travel from the start through all waypoints, however
slowly. How fast the map can be flown is a stronger, later question for a time-optimal solver.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from srlrace.config import LevelConfig, TrackConfig, Vec3
from srlrace.world.field import ObstacleField
from srlrace.world.levels import generate_map
from srlrace.world.obstacles import Obstacle

STEP = 0.2  # m, edge of the cells that free space is divided into
FIRST_UNSEEN_SEED = 1_000_000  # training draws its maps far below
TRIES = 50  # draws per wanted map before giving up


def is_flyable(track: TrackConfig, obstacles: Sequence[Obstacle], clearance: float) -> bool:
    """Whether the start and all waypoints lie in one connected part of the free space; sufficient, not necessary.

    Free is what is `clearance` m or more away from all surfaces. A cell counts as free only if its whole volume
    is: the gap changes by no more than the distance moved, so it is enough that the gap at the cell's centre
    exceeds the clearance by half the cell's diagonal. Trees that span the whole height are tested in the plane.
    """
    floor, ceiling = track.bounds_low[2], track.bounds_high[2]
    flat = all(_spans(o, floor, ceiling) for o in obstacles)
    solid = [replace(o, origin=(*o.origin[:2], 0.0), count=(*o.count[:2], 1)) for o in obstacles] if flat else obstacles
    low = np.array([*track.bounds_low[:2], 0.0 if flat else floor])
    high = np.array([*track.bounds_high[:2], STEP if flat else ceiling])
    shape = np.maximum(1, np.floor((high - low) / STEP + 1e-9).astype(int))
    centres = [a + STEP * (np.arange(n) + 0.5) for a, n in zip(low, shape, strict=True)]
    centres[2] = np.zeros(1) if flat else centres[2]
    points = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1).reshape(-1, 3)
    field = ObstacleField.of_maps([tuple(solid)], track.bounds_low, track.bounds_high, 1, 1.0)
    free = field.gaps(points).reshape(shape) >= clearance + STEP * math.sqrt(3) / 2
    parts, _ = ndimage.label(free)
    stops = {int(parts[_cell(point, low, shape, flat)]) for point in (track.start, *track.waypoints)}
    return len(stops) == 1 and 0 not in stops


def unseen_maps(track: TrackConfig, level: LevelConfig, count: int, drone_radius: float) -> tuple[int, ...]:
    """Seeds of the first `count` flyable maps of a level that no training draws, in the order of their seeds.

    `drone_radius` (m) and the level's safety margin keep the ball from the trees. Raises ValueError where
    hardly any draw is flyable.
    """
    first = max(FIRST_UNSEEN_SEED, level.map_seed + FIRST_UNSEEN_SEED)
    seeds: list[int] = []
    for seed in range(first, first + TRIES * count):
        if len(seeds) == count:
            break
        if is_flyable(track, generate_map(track, level, seed - level.map_seed), drone_radius + level.safety_margin):
            seeds.append(seed)
    if len(seeds) < count:
        raise ValueError(f"only {len(seeds)} of {TRIES * count} maps of level {level.name} on {track.name} are flyable")
    return tuple(seeds)


def _spans(obstacle: Obstacle, floor: float, ceiling: float) -> bool:
    """Whether an obstacle bars its place in the plane at all heights."""
    low, height = obstacle.center[2] - obstacle.size[2] / 2, obstacle.size[2]
    return obstacle.kind == "cylinder" and low <= floor + 1e-6 and low + height >= ceiling - 1e-6


def _cell(point: Vec3, low: NDArray[np.float64], shape: NDArray[np.int64], flat: bool) -> tuple[int, int, int]:
    """Indices of the cell a point lies in."""
    index = np.clip(((np.array(point) - low) / STEP).astype(int), 0, shape - 1)
    return int(index[0]), int(index[1]), 0 if flat else int(index[2])
