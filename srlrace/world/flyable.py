"""Clear paths: a way from the start through all waypoints that keeps away from every obstacle, found on a grid.

A path says that a ball can travel through a map, however slowly. Whether the quadrotor can fly along it is tried by
`srlrace.task.certificate`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from srlrace.config import TrackConfig
from srlrace.world.field import ObstacleField
from srlrace.world.obstacles import Obstacle
from srlrace.world.track import target_sequence

Array = NDArray[np.float64]

FLAT_STEP = 0.2  # m, edge of the squares that a wood of trees is divided into
STEP = 0.4  # m, edge of the cubes where obstacles differ with height: eight times fewer than of half the edge
ROOM = 0.4  # m beyond the clearance: paths keep this much more where they can
CROWDED = 4.0  # times longer than in the open counts a way without any of that room
GUIDANCE = 1.0  # m from the guide, where a way counts as twice as long
SAMPLE = 0.05  # m, distance of the points at which a shortcut is tested


def clear_path(
    track: TrackConfig, obstacles: Sequence[Obstacle], clearance: float, guide: Array | None = None
) -> list[Array] | None:
    """Return one polyline (k, 3), m, for each leg of the flight, or None where the grid knows no way.

    With a ``guide``, points (g, 3), m, the ways that stay near it count as shorter.

    A cell can be entered if the gap from its centre to the nearest surface is `clearance` m and half its diagonal.
    Trees that span the whole height are avoided in the plane. The gap along the polylines is not less than in the
    cells; sufficient, not necessary.
    """
    flat = all(_spans(o, track.bounds_low[2], track.bounds_high[2]) for o in obstacles)
    grid = _Grid(track, obstacles, clearance, flat)
    stops = np.array([track.start, *(track.waypoints[i] for i in target_sequence(track))])
    cells = [grid.cell(stop) for stop in stops]
    if not all(grid.free.ravel()[cell] for cell in cells):
        return None
    direct = guide is None
    straight = [direct and _is_clear(grid, a, b, clearance + ROOM) for a, b in itertools.pairwise(stops)]
    origins = sorted({cell for cell, clear in zip(cells, straight, strict=False) if not clear})
    if origins:
        distance, before = dijkstra(grid.graph(guide), directed=False, indices=origins, return_predecessors=True)
    legs = []
    for k, (a, b) in enumerate(itertools.pairwise(stops)):
        inner = np.empty((0, 3))
        if not straight[k]:
            row = origins.index(cells[k])
            if not np.isfinite(distance[row, cells[k + 1]]):
                return None
            inner = grid.centres(_trace(before[row], cells[k], cells[k + 1]))[1:-1]
        if flat:
            inner[:, 2] = np.linspace(a[2], b[2], len(inner) + 2)[1:-1]
        legs.append(_shorten(grid, np.vstack([a, inner, b])))
    return legs


class _Grid:
    """Free cells of a world, and the gap from each one's centre to the nearest surface."""

    def __init__(self, track: TrackConfig, obstacles: Sequence[Obstacle], clearance: float, flat: bool) -> None:
        self.step, self.flat, self.clearance = (FLAT_STEP if flat else STEP), flat, clearance
        solid = [replace(o, origin=(*o.origin[:2], 0.0), count=(*o.count[:2], 1)) if flat else o for o in obstacles]
        self.field = ObstacleField.of_maps([tuple(solid)], track.bounds_low, track.bounds_high, 1, 1.0)
        self.low, high = np.array(track.bounds_low), np.array(track.bounds_high)
        self.shape = np.maximum(1, np.floor((high - self.low) / self.step + 1e-9).astype(int))
        if flat:
            self.shape[2] = 1
        self.gap = self.gaps(self.centres(np.arange(self.shape.prod()))).reshape(self.shape)
        self.free = self.gap >= clearance + self.step * math.sqrt(2 if flat else 3) / 2

    def gaps(self, places: Array) -> Array:
        """Distance to the nearest surface (n,), m."""
        at = places * [1.0, 1.0, 0.0] if self.flat else places
        return np.asarray(self.field.gaps(at), np.float64)

    def cell(self, place: Array) -> int:
        """Number of the cell that a place lies in."""
        index = np.clip(((place - self.low) / self.step).astype(int), 0, self.shape - 1)
        return int(np.ravel_multi_index(tuple(index), tuple(self.shape)))

    def centres(self, cells: Any) -> Array:
        """Centres (n, 3) of numbered cells, m."""
        return self.low + self.step * (np.stack(np.unravel_index(cells, tuple(self.shape)), axis=-1) + 0.5)

    def graph(self, guide: Array | None) -> csr_array:
        """Lengths of the steps between free neighbours, stretched where there is little room or the guide is far."""
        stretch = 1 + (CROWDED - 1) * np.clip((self.clearance + ROOM - self.gap) / ROOM, 0.0, 1.0)
        if guide is not None:
            plane = [1.0, 1.0, 0.0 if self.flat else 1.0]
            centres = self.centres(np.arange(self.gap.size)) * plane
            stretch *= 1 + (cKDTree(guide * plane).query(centres)[0] / GUIDANCE).reshape(self.gap.shape)
        number = np.arange(self.gap.size).reshape(self.shape)
        rows, columns, lengths = [], [], []
        for offset, here, there in _neighbours():
            both = self.free[here] & self.free[there]
            length = self.step * math.hypot(*offset)
            rows.append(number[here][both])
            columns.append(number[there][both])
            lengths.append((length * 0.5 * (stretch[here] + stretch[there]))[both])
        size = self.gap.size
        joined = (np.concatenate(part) for part in (rows, columns))
        return csr_array((np.concatenate(lengths), tuple(joined)), shape=(size, size))


def _neighbours() -> Iterator[tuple[tuple[int, ...], tuple[slice, ...], tuple[slice, ...]]]:
    """Offsets to half of a cell's 26 neighbours, and the slices of an array that each one pairs."""
    for offset in itertools.product((-1, 0, 1), repeat=3):
        if offset > (0, 0, 0):
            yield (
                offset,
                tuple(slice(max(0, -d), -d if d > 0 else None) for d in offset),
                tuple(slice(max(0, d), d if d < 0 else None) for d in offset),
            )


def _trace(before: NDArray[np.int32], start: int, goal: int) -> list[int]:
    cells = [goal]
    while cells[-1] != start:
        cells.append(int(before[cells[-1]]))
    return cells[::-1]


def _shorten(grid: _Grid, path: Array) -> Array:
    """Pull a polyline straight wherever that brings it no closer to an obstacle than it was, or than there is room."""
    gaps, kept, here = grid.gaps(path), [0], 0
    enough = grid.clearance + ROOM
    while here < len(path) - 1:
        there = len(path) - 1
        while there > here + 1 and not _is_clear(
            grid, path[here], path[there], min(enough, gaps[here : there + 1].min())
        ):
            there = here + max(1, (there - here) * 3 // 4)
        kept.append(there)
        here = there
    return path[kept]


def _is_clear(grid: _Grid, a: Array, b: Array, gap: float) -> bool:
    count = 2 + int(np.linalg.norm(b - a) / SAMPLE)
    return bool(grid.gaps(np.linspace(a, b, count)).min() >= gap)


def _spans(obstacle: Obstacle, floor: float, ceiling: float) -> bool:
    """Whether an obstacle bars its place in the plane at all heights."""
    low, height = obstacle.center[2] - obstacle.size[2] / 2, obstacle.size[2]
    return obstacle.kind == "cylinder" and low <= floor + 1e-6 and low + height >= ceiling - 1e-6
