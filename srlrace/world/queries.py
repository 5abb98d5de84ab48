"""Queries on an obstacle field, for use inside kernels: one drone a call, the field as three flat arrays.

`lattices`, `grid` and `geometry` are those of `srlrace.world.field.ObstacleField`; lengths in m, world frame. Answers
are exact inside the world's bounds and `srlrace.world.grid.OUTSIDE` around them. A position that is not
finite gets an answer without meaning, but a harmless one: test for it separately.
"""

from __future__ import annotations

import numpy as np

from srlrace.sim.compile import inline
from srlrace.world.grid import HEADER, INV, MARGIN, TILE
from srlrace.world.lattice import (
    HALF,
    LAST,
    ONE,
    ORIGIN,
    PITCH,
    RADIUS,
    TINY,
    ZERO,
    Floats,
    Ints,
    Real,
    axis_centre,
    segment_squared_distance,
    squared_distance,
)

FAR = np.float32(1000.0)  # m, the gap reported where a map has no obstacle
PIECE = np.float32(2 * MARGIN)  # m, longest piece of a chord that one cell's list covers
MAX_CHORD = np.float32(1000.0)  # m, longer chords are no flight: a diverged state


@inline
def grid_index(value: Real, axis: int, grid: Ints, geometry: Floats) -> int:
    """Cell of a coordinate; clamped as a float, which takes NaN and infinity as well."""
    position = (value - geometry[axis]) * geometry[INV + axis]
    last = np.float32(grid[axis] - 1)
    position = position if position > ZERO else ZERO
    return int(position if position < last else last)


@inline
def cell_record(x: Real, y: Real, z: Real, map_index: int, grid: Ints, geometry: Floats) -> int:
    """Where the record of the point's cell starts in `grid`."""
    ix, iy = grid_index(x, 0, grid, geometry), grid_index(y, 1, grid, geometry)
    iz = grid_index(z, 2, grid, geometry)
    return grid[HEADER + ((map_index * grid[2] + iz) * grid[1] + iy) * grid[0] + ix]


@inline
def nearest(
    x: Real,
    y: Real,
    z: Real,
    map_index: int,
    lattices: Floats,
    grid: Ints,
    geometry: Floats,
    reach: Real,
    distance_out: Floats,
    index_out: Ints,
) -> tuple[int, Real]:
    """Distances (to centres) and lattice rows of the nearest obstacles, closest first.

    Fills `distance_out` (N,) and `index_out` (N,), padded with `reach` and -1. Returns how many were within
    reach, and the smallest distance to any obstacle's surface (negative inside one, `FAR` without any).
    """
    record = cell_record(x, y, z, map_index, grid, geometry)
    n = distance_out.shape[0]
    count = 0
    limit = reach * reach
    gap = FAR
    for k in range(record + 2, record + 2 + grid[record]):
        i = grid[k]
        d2 = squared_distance(x, y, z, lattices, i)
        bound = gap + lattices[i, RADIUS]
        if d2 < bound * bound:
            gap = min(gap, np.sqrt(d2) - lattices[i, RADIUS])
        if d2 < limit:
            slot = min(count, n - 1)
            while slot > 0 and distance_out[slot - 1] > d2:
                distance_out[slot] = distance_out[slot - 1]
                index_out[slot] = index_out[slot - 1]
                slot -= 1
            distance_out[slot] = d2
            index_out[slot] = i
            count = min(count + 1, n)
            if count == n:
                limit = distance_out[n - 1]
    for slot in range(count):
        distance_out[slot] = np.sqrt(distance_out[slot])
    for slot in range(count, n):
        distance_out[slot] = reach
        index_out[slot] = -1
    return count, gap


@inline
def nearest_centre(i: int, x: Real, y: Real, z: Real, lattices: Floats) -> tuple[Real, Real, Real]:
    """Centre of the sphere of obstacle `i` nearest to a point."""
    return axis_centre(x, lattices, i, 0), axis_centre(y, lattices, i, 1), axis_centre(z, lattices, i, 2)


@inline
def swept_gap(
    x0: Real,
    y0: Real,
    z0: Real,
    x1: Real,
    y1: Real,
    z1: Real,
    map_index: int,
    lattices: Floats,
    grid: Ints,
    geometry: Floats,
) -> Real:
    """Smallest distance from a chord to any obstacle's surface (negative: the chord cuts it), exact.

    The chord is cut in pieces of at most `PIECE`; the swept list of the cell of a piece's middle covers it. The
    gap is 1-Lipschitz, so a caller that needs it only below some bound can skip the call wherever the gap at
    one end minus the length of the chord is above that bound.
    """
    ux, uy, uz = x1 - x0, y1 - y0, z1 - z0
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    gap = FAR
    if not length < MAX_CHORD:
        return gap
    pieces = int(length / PIECE) + 1
    share = ONE / np.float32(pieces)
    half = HALF * length * share
    for piece in range(pieces):
        a, b = np.float32(piece) * share, np.float32(piece + 1) * share
        xa, ya, za = x0 + a * ux, y0 + a * uy, z0 + a * uz
        xb, yb, zb = x0 + b * ux, y0 + b * uy, z0 + b * uz
        xm, ym, zm = HALF * (xa + xb), HALF * (ya + yb), HALF * (za + zb)
        record = cell_record(xm, ym, zm, map_index, grid, geometry)
        begin = record + 2 + grid[record]
        for k in range(begin, begin + grid[record + 1]):
            i = grid[k]
            bound = gap + lattices[i, RADIUS]
            outer = bound + half
            # bound < 0: the chord is already deeper in another obstacle than this one's radius
            if bound > ZERO and squared_distance(xm, ym, zm, lattices, i) < outer * outer:
                d2 = segment_squared_distance(xa, ya, za, xb, yb, zb, lattices, i)
                if d2 < bound * bound:
                    gap = np.sqrt(d2) - lattices[i, RADIUS]
    return gap


@inline
def cast_rays(
    x: Real,
    y: Real,
    z: Real,
    map_index: int,
    lattices: Floats,
    grid: Ints,
    geometry: Floats,
    inflation: Real,
    reach: Real,
    cos: Real,
    sin: Real,
    directions: Floats,
    out: Floats,
) -> None:
    """Horizontal distances along `directions` (2, R), unit vectors, to obstacles inflated by `inflation`.

    The directions are given in axes turned about z by the angle of this cosine and sine. Fills `out` (R,) with
    distances, `reach` where free, 0 everywhere inside an inflated obstacle. Of a lattice only the layer nearest in z
    matters: all layers share their x and y, and a horizontal plane cuts equal spheres in concentric circles, the
    largest of which belongs to the nearest layer.
    """
    rays = out.shape[0]
    for ray in range(rays):
        out[ray] = reach
    ix, iy = grid_index(x, 0, grid, geometry) // TILE, grid_index(y, 1, grid, geometry) // TILE
    record = grid[grid[5] + (map_index * grid[4] + iy) * grid[3] + ix]
    for k in range(record + 1, record + 1 + grid[record]):
        i = grid[k]
        radius = lattices[i, RADIUS] + inflation
        dz = z - axis_centre(z, lattices, i, 2)
        circle = radius * radius - dz * dz
        if circle <= ZERO:
            continue
        for jx in range(int(lattices[i, LAST]) + 1):
            east = lattices[i, ORIGIN] + lattices[i, PITCH] * np.float32(jx) - x
            for jy in range(int(lattices[i, LAST + 1]) + 1):
                north = lattices[i, ORIGIN + 1] + lattices[i, PITCH + 1] * np.float32(jy) - y
                dx, dy = cos * east + sin * north, cos * north - sin * east
                d2 = dx * dx + dy * dy
                if d2 <= circle:
                    for ray in range(rays):
                        out[ray] = ZERO
                    return
                outer = reach + radius
                if d2 < outer * outer:
                    for ray in range(rays):
                        along = dx * directions[0, ray] + dy * directions[1, ray]
                        inside = circle - d2 + along * along
                        hit = along - np.sqrt(inside if inside > ZERO else ZERO)
                        value = hit if (inside > ZERO and along > ZERO) else reach
                        out[ray] = value if value < out[ray] else out[ray]


@inline
def pass_waypoint(
    x0: Real, y0: Real, z0: Real, x1: Real, y1: Real, z1: Real, wx: Real, wy: Real, wz: Real, radius: Real
) -> Real:
    """Share of the chord, 0 to 1, after which it first enters the ball around a waypoint; -1 if it never does."""
    ux, uy, uz = x1 - x0, y1 - y0, z1 - z0
    px, py, pz = x0 - wx, y0 - wy, z0 - wz
    outside = px * px + py * py + pz * pz - radius * radius
    if outside <= ZERO:
        return ZERO
    a = ux * ux + uy * uy + uz * uz
    b = px * ux + py * uy + pz * uz
    disc = b * b - a * outside
    if not (b < ZERO and disc >= ZERO):  # moving away, missing it, or not finite
        return -ONE
    # Citardauq form of the smaller root: no cancellation where the chord is short
    share = outside / (np.sqrt(disc) - b + TINY)
    return share if share <= ONE else -ONE
