"""Geometry of one lattice of spheres: its packed row, and distances to it in closed form.

All lengths in m, world frame. The functions run in the float width of the packed array.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srlrace.sim.compile import inline
from srlrace.world.obstacles import Obstacle

Real = Any  # one number of the width of the field's arrays
Floats = NDArray[Any]  # float32 or float64
Ints = NDArray[np.int32]

# A packed lattice, 16 floats and so one cache line in float32. Three entries each (x, y, z):
ORIGIN, PITCH, INVERSE_PITCH, LAST = 0, 3, 6, 9  # LAST: highest index, count - 1
RADIUS = 12  # of each sphere
STACKED = 13  # 1 where only the z axis has more than one sphere
ROW = 16

# Exact in both widths, and narrow enough not to turn float32 arithmetic into float64.
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
TINY, HUGE = np.float32(1e-30), np.float32(1e30)


def pack(obstacles: Sequence[Obstacle]) -> NDArray[np.float64]:
    """Pack obstacles, one row each, shape (n, ROW)."""
    rows = np.zeros((len(obstacles), ROW))
    for row, obstacle in zip(rows, obstacles, strict=True):
        row[ORIGIN : ORIGIN + 3] = obstacle.origin
        row[PITCH : PITCH + 3] = obstacle.pitch
        row[INVERSE_PITCH : INVERSE_PITCH + 3] = [1 / p for p in obstacle.pitch]
        row[LAST : LAST + 3] = [n - 1 for n in obstacle.count]
        row[RADIUS] = obstacle.sphere_radius
        row[STACKED] = obstacle.count[0] == obstacle.count[1] == 1
    return rows


@inline
def axis_index(value: Real, lattices: Floats, i: int, axis: int) -> Real:
    """Index of the lattice layer nearest to a coordinate, as a float."""
    index = np.floor((value - lattices[i, ORIGIN + axis]) * lattices[i, INVERSE_PITCH + axis] + HALF)
    index = index if index > ZERO else ZERO
    return index if index < lattices[i, LAST + axis] else lattices[i, LAST + axis]


@inline
def axis_centre(value: Real, lattices: Floats, i: int, axis: int) -> Real:
    """Coordinate of the lattice layer nearest to a coordinate."""
    return lattices[i, ORIGIN + axis] + lattices[i, PITCH + axis] * axis_index(value, lattices, i, axis)


@inline
def squared_distance(x: Real, y: Real, z: Real, lattices: Floats, i: int) -> Real:
    """Squared distance from a point to the nearest sphere centre of lattice `i`."""
    dz = z - axis_centre(z, lattices, i, 2)
    if lattices[i, STACKED] > ZERO:
        dx, dy = x - lattices[i, ORIGIN], y - lattices[i, ORIGIN + 1]
    else:
        dx, dy = x - axis_centre(x, lattices, i, 0), y - axis_centre(y, lattices, i, 1)
    return dx * dx + dy * dy + dz * dz


@inline
def segment_squared_distance(
    x0: Real, y0: Real, z0: Real, x1: Real, y1: Real, z1: Real, lattices: Floats, i: int
) -> Real:
    """Squared distance from a segment to the nearest sphere centre of lattice `i`, exact.

    Rounding to the nearest layer is monotone, so the sphere nearest to any point of the segment has indices
    between those of the spheres nearest to its ends: only this small block is searched.
    """
    ux, uy, uz = x1 - x0, y1 - y0, z1 - z0
    inverse = ONE / (ux * ux + uy * uy + uz * uz + TINY)
    ax, bx = axis_index(x0, lattices, i, 0), axis_index(x1, lattices, i, 0)
    ay, by = axis_index(y0, lattices, i, 1), axis_index(y1, lattices, i, 1)
    az, bz = axis_index(z0, lattices, i, 2), axis_index(z1, lattices, i, 2)
    best = HUGE
    for ix in range(int(min(ax, bx)), int(max(ax, bx)) + 1):
        cx = lattices[i, ORIGIN] + lattices[i, PITCH] * np.float32(ix) - x0
        for iy in range(int(min(ay, by)), int(max(ay, by)) + 1):
            cy = lattices[i, ORIGIN + 1] + lattices[i, PITCH + 1] * np.float32(iy) - y0
            for iz in range(int(min(az, bz)), int(max(az, bz)) + 1):
                cz = lattices[i, ORIGIN + 2] + lattices[i, PITCH + 2] * np.float32(iz) - z0
                t = (cx * ux + cy * uy + cz * uz) * inverse
                t = min(max(t, ZERO), ONE)
                dx, dy, dz = cx - t * ux, cy - t * uy, cz - t * uz
                best = min(best, dx * dx + dy * dy + dz * dz)
    return best
