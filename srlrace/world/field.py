"""The obstacle field: every map of a level, packed for the kernels, with its candidate grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srlrace.config import LevelConfig, TrackConfig
from srlrace.sim.compile import builder
from srlrace.world.grid import build_grid
from srlrace.world.lattice import ROW, ZERO, Floats, Ints, pack
from srlrace.world.levels import generate_map
from srlrace.world.obstacles import Obstacle
from srlrace.world.queries import cast_rays, nearest, nearest_centre, pass_waypoint, swept_gap

__all__ = ["ObstacleField", "cast_rays", "nearest", "nearest_centre", "pass_waypoint", "ray_directions", "swept_gap"]


@dataclass(frozen=True, eq=False)
class ObstacleField:
    """All maps of a level. `arrays` is what the queries take; their answers hold for this N and reach only."""

    map_obstacles: tuple[tuple[Obstacle, ...], ...]  # per map; row first[m] + k of lattices is obstacle k of map m
    first: NDArray[np.int64]  # (maps + 1,) first row of each map in lattices
    lattices: NDArray[Any]  # (obstacles of all maps, 16), m, world; layout in srlrace.world.lattice
    grid: NDArray[np.int32]  # flat candidate grid; layout in srlrace.world.grid
    geometry: NDArray[Any]  # (6,) lower corner of the grid in m, cells per m
    nearest: int  # N, the most nearest obstacles a query may ask for
    reach: float  # m, range of nearest obstacles and rays

    @property
    def maps(self) -> int:
        """Number of maps."""
        return len(self.map_obstacles)

    @property
    def slots(self) -> int:
        """Places for maps, as many as there are maps."""
        return self.maps

    @property
    def arrays(self) -> tuple[NDArray[Any], NDArray[np.int32], NDArray[Any]]:
        """The field as the kernels take it: ``(lattices, grid, geometry)``."""
        return self.lattices, self.grid, self.geometry

    def obstacles(self, map_index: int) -> tuple[Obstacle, ...]:
        """Obstacles of one map, for drawing and for other solvers."""
        return self.map_obstacles[map_index]

    @classmethod
    def build(
        cls, track: TrackConfig, level: LevelConfig, maps: int, nearest: int, reach: float, dtype: Any = np.float32
    ) -> ObstacleField:
        """Generate the first `maps` maps of a level and pack them."""
        seeds = range(level.map_seed, level.map_seed + maps)
        return cls.of_seeds(track, level, seeds, nearest, reach, dtype)

    @classmethod
    def of_seeds(
        cls,
        track: TrackConfig,
        level: LevelConfig,
        seeds: Sequence[int],
        nearest: int,
        reach: float,
        dtype: Any = np.float32,
    ) -> ObstacleField:
        """Generate the maps with these seeds (`level.map_seed` + map index) and pack them."""
        drawn = [generate_map(track, level, seed - level.map_seed) for seed in seeds]
        return cls.of_maps(drawn, track.bounds_low, track.bounds_high, nearest, reach, dtype)

    @classmethod
    def of_maps(
        cls,
        maps: Sequence[tuple[Obstacle, ...]],
        bounds_low: Sequence[float],
        bounds_high: Sequence[float],
        nearest: int,
        reach: float,
        dtype: Any = np.float32,
    ) -> ObstacleField:
        """Pack given maps, which need not come from a generator.

        Raises ValueError for no map, no nearest obstacle, or more maps than the grid can address.
        """
        if not maps or nearest < 1:
            raise ValueError("an obstacle field needs at least one map and one nearest obstacle")
        rows = pack([obstacle for drawn in maps for obstacle in drawn])
        first = np.cumsum([0] + [len(drawn) for drawn in maps])
        grid, geometry = build_grid(rows, first, bounds_low, bounds_high, nearest, reach)
        lattices = aligned(rows if len(rows) else np.zeros((1, ROW)), dtype)
        return cls(tuple(maps), first, lattices, grid, geometry.astype(dtype), nearest, float(reach))

    def gaps(self, points: NDArray[Any], map_index: int = 0) -> NDArray[Any]:
        """Distance from points (n, 3), m, to the nearest surface of a map, negative inside; shape (n,)."""
        return _gaps(np.asarray(points, self.lattices.dtype), map_index, *self.arrays)


def aligned(rows: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """Copy an array to memory that starts at a cache line, so that no packed lattice of float32 straddles two."""
    line = 64  # bytes
    buffer = np.empty(rows.size * np.dtype(dtype).itemsize + line, np.uint8)
    start = -buffer.ctypes.data % line
    out = buffer[start : start + rows.size * np.dtype(dtype).itemsize].view(dtype).reshape(rows.shape)
    out[:] = rows
    return out


def ray_directions(rays: int, dtype: Any = np.float32, focus: float = 1.0) -> NDArray[Any]:
    """Unit vectors (2, `rays`) in a horizontal plane, ray i at the angle 2 pi i / `rays` from x.

    With a `focus` f above 1 they crowd around x: an angle of pi u, -1 < u <= 1, becomes pi sign(u) abs(u)^f.
    """
    angle = 2 * np.pi * np.arange(rays) / rays
    if focus != 1.0:
        turn = np.where(angle > np.pi, angle - 2 * np.pi, angle) / np.pi
        angle = np.pi * np.sign(turn) * np.abs(turn) ** focus
    return np.ascontiguousarray([np.cos(angle), np.sin(angle)], dtype)


@builder
def _gaps(points: Floats, map_index: int, lattices: Floats, grid: Ints, geometry: Floats) -> Floats:
    out = np.empty(len(points), lattices.dtype)
    distance, index = np.empty(1, lattices.dtype), np.empty(1, np.int32)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        out[k] = nearest(x, y, z, map_index, lattices, grid, geometry, ZERO, distance, index)[1]
    return out
