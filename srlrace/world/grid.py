"""Candidate grid: for each cell of the world, the few obstacles that a query from inside it can need.

Per map and cell two lists are kept, both exact supersets:

* near: obstacles that can be among the N nearest (by centre, within reach) or the nearest by surface, for some
  point of the cell;
* swept: obstacles that can be the nearest by surface for some point of the cell inflated by `MARGIN`.

An obstacle leaves the near list only if N others are strictly closer from everywhere in the cell, the swept
list only if one other has a strictly nearer surface everywhere. Squared distance to a lattice is a sum of one
function per axis, so the largest value of the difference of two of them over a box is the sum of the largest
values per axis: exact where an axis holds one layer in both lattices (the difference is linear there) or the
same layers (zero), bounded by intervals otherwise.

Flat layout, int32: ``[nx, ny, nz, tiles_x, tiles_y, first tile entry, 0, 0]``, then one offset per (map, z, y, x)
cell, one per (map, y, x) tile, then the records: cell ``[near count, swept count, near..., swept...]``, tile
``[count, ids...]``. Tiles serve the rays: obstacles within reach of any point of the tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from srlrace.sim.compile import builder, inline
from srlrace.world.lattice import LAST, ORIGIN, PITCH, RADIUS, Floats, Ints, Real, axis_centre, squared_distance

CELL = 1.0  # m, edge of a cell in x and y, and in z where the obstacles are not all trees
TILE = 4  # cells along the edge of a tile
MARGIN = 0.6  # m, inflation for the swept list: a chord of twice this fits around its middle
OUTSIDE = 2.0  # m, the grid goes on beyond the world's bounds: a drone leaving it is still served exactly
ROUNDING = 1e-3  # m, inflation of the near list against float32 rounding of positions
RAY_INFLATION = 1.0  # m, largest inflation of obstacles that tiles are good for
Offsets = NDArray[np.int64]

HEADER = 8
INV = 3  # geometry: [low x y z, 1 / cell x y z]


def grid_shape(bounds_low: Sequence[float], bounds_high: Sequence[float], flat: bool) -> tuple[int, int, int]:
    """Cells along x, y, z of a grid over the world and `OUTSIDE` around it; one layer if `flat`."""
    nx, ny, nz = (
        int(np.ceil((high - low + 2 * OUTSIDE) / CELL)) for low, high in zip(bounds_low, bounds_high, strict=True)
    )
    return nx, ny, 1 if flat else nz


def is_flat(lattices: NDArray[np.float64]) -> bool:
    """Whether all obstacles are stacks with the same layers, so that height does not change their order."""
    stacked = (lattices[:, LAST] == 0).all() and (lattices[:, LAST + 1] == 0).all()
    layers = lattices[:, [ORIGIN + 2, PITCH + 2, LAST + 2]]
    return bool(stacked and (layers == layers[:1]).all())


@inline
def axis_bounds(lattices: Floats, i: int, axis: int, centre: Floats, half: Floats) -> tuple[Real, Real]:
    """Smallest and largest squared distance along one axis, over an interval, to the nearest layer."""
    low, high = centre - half, centre + half
    a, b = low - axis_centre(low, lattices, i, axis), high - axis_centre(high, lattices, i, axis)
    first = lattices[i, ORIGIN + axis]
    last = first + lattices[i, PITCH + axis] * lattices[i, LAST + axis]
    largest = max(abs(a), abs(b))
    if lattices[i, LAST + axis] > 0 and high > first and low < last:
        largest = max(largest, 0.5 * lattices[i, PITCH + axis])
    # The interval holds a layer if rounding differs at its ends or the distance changes sign.
    layer = axis_centre(low, lattices, i, axis) != axis_centre(high, lattices, i, axis) or a * b <= 0
    smallest = 0.0 if layer else min(abs(a), abs(b))
    return smallest * smallest, largest * largest


@inline
def bounds(lattices: Floats, i: int, centre: Floats, half: Floats) -> tuple[Real, Real]:
    """Smallest and largest distance to lattice `i` over a box."""
    low = high = 0.0
    for axis in range(3):
        smallest, largest = axis_bounds(lattices, i, axis, centre[axis], half[axis])
        low += smallest
        high += largest
    return np.sqrt(low), np.sqrt(high)


@inline
def largest_difference(lattices: Floats, j: int, i: int, centre: Floats, half: Floats) -> Real:
    """Upper bound over a box of (squared distance to `j` - squared distance to `i`)."""
    total = 0.0
    for axis in range(3):
        step = lattices[i, ORIGIN + axis] - lattices[j, ORIGIN + axis]
        last_i, last_j = lattices[i, LAST + axis], lattices[j, LAST + axis]
        if last_i == 0 and last_j == 0:
            middle = 0.5 * (lattices[i, ORIGIN + axis] + lattices[j, ORIGIN + axis])
            total += 2 * step * (centre[axis] - middle) + 2 * abs(step) * half[axis]
        elif step != 0 or last_i != last_j or lattices[i, PITCH + axis] != lattices[j, PITCH + axis]:
            total += axis_bounds(lattices, j, axis, centre[axis], half[axis])[1]
            total -= axis_bounds(lattices, i, axis, centre[axis], half[axis])[0]
    return total


@builder
def select(lattices: Floats, pool: Ints, nearest: int, reach: Real, centre: Floats, half: Floats, prune: bool) -> Ints:
    """Obstacles of `pool` a box needs: among the `nearest` within `reach`, or nearest by surface; sorted."""
    m = len(pool)
    low, high, key = np.empty(m), np.empty(m), np.empty(m)
    surface = np.inf
    for k in range(m):
        i = pool[k]
        low[k], high[k] = bounds(lattices, i, centre, half)
        key[k] = squared_distance(centre[0], centre[1], centre[2], lattices, i)
        surface = min(surface, high[k] - lattices[i, RADIUS])
    ceiling = reach if m <= nearest else min(reach, np.sort(high)[nearest - 1])
    order = np.argsort(key)
    near, touch = np.empty(m, np.bool_), np.empty(m, np.bool_)
    kept = np.empty(m, np.int64)
    n = 0
    for k in order:
        near[n] = nearest > 0 and low[k] <= ceiling
        touch[n] = low[k] - lattices[pool[k], RADIUS] <= surface
        if near[n] or touch[n]:
            kept[n] = k
            n += 1
    result = np.empty(n, np.int32)
    count = 0
    for a in range(n):
        i = pool[kept[a]]
        wanted, closer, touching = near[a], 0, touch[a]
        for b in range(n):
            if not prune or a == b or not (touching or (wanted and closer < nearest)):
                continue
            j = pool[kept[b]]
            if largest_difference(lattices, j, i, centre, half) < 0:
                closer += 1
                touching = touching and lattices[j, RADIUS] < lattices[i, RADIUS]
            elif high[kept[b]] - lattices[j, RADIUS] < low[kept[a]] - lattices[i, RADIUS]:
                touching = False
        if touching or (wanted and closer < nearest):
            result[count] = i
            count += 1
    return result[:count]


@builder
def within(lattices: Floats, pool: Ints, reach: Real, centre: Floats, half: Floats) -> Ints:
    """Obstacles with a surface within `reach` of a box, nearest first."""
    result, key = np.empty(len(pool), np.int32), np.empty(len(pool))
    count = 0
    for i in pool:
        if bounds(lattices, i, centre, half)[0] - lattices[i, RADIUS] <= reach:
            result[count], key[count] = i, squared_distance(centre[0], centre[1], centre[2], lattices, i)
            count += 1
    return result[:count][np.argsort(key[:count])]


@builder
def map_records(
    lattices: Floats,
    first: int,
    last: int,
    low: Floats,
    size: Floats,
    shape: tuple[int, int, int],
    nearest: int,
    reach: Real,
) -> tuple[Offsets, Offsets, Ints]:
    """Records of one map, whose obstacles are rows `first` to `last`: (cell offsets, tile offsets, records)."""
    nx, ny, nz = shape
    tiles_x, tiles_y = (nx + TILE - 1) // TILE, (ny + TILE - 1) // TILE
    everything = np.arange(first, last)
    cells, tiles = np.zeros((nz, ny, nx), np.int64), np.zeros((tiles_y, tiles_x), np.int64)
    records = np.empty(1 << 14, np.int32)
    used = 0
    spare = 4 + 3 * len(everything)
    for ty, tx in np.ndindex(tiles_y, tiles_x):
        column = np.array([tx * TILE, ty * TILE, 0]) * size
        half = np.array([TILE * size[0], TILE * size[1], nz * size[2]]) / 2
        ids = within(lattices, everything, reach + RAY_INFLATION, low + column + half, half + ROUNDING)
        if used + spare > len(records):
            records = np.concatenate((records, np.empty(len(records) + spare, np.int32)))
        tiles[ty, tx] = used
        records[used] = len(ids)
        records[used + 1 : used + 1 + len(ids)] = ids
        used += 1 + len(ids)
        for iz in range(nz):
            slab_half = np.array([half[0], half[1], size[2] / 2])
            slab_centre = low + np.array([column[0], column[1], iz * size[2]]) + slab_half
            pool = select(lattices, everything, nearest, reach, slab_centre, slab_half + MARGIN + ROUNDING, False)
            for iy in range(ty * TILE, min(ny, (ty + 1) * TILE)):
                for ix in range(tx * TILE, min(nx, (tx + 1) * TILE)):
                    centre = low + (np.array([ix, iy, iz]) + 0.5) * size
                    near = select(lattices, pool, nearest, reach, centre, size / 2 + ROUNDING, True)
                    swept = select(lattices, pool, 0, reach, centre, size / 2 + MARGIN + ROUNDING, True)
                    if used + spare > len(records):
                        records = np.concatenate((records, np.empty(len(records) + spare, np.int32)))
                    cells[iz, iy, ix] = used
                    records[used], records[used + 1] = len(near), len(swept)
                    records[used + 2 : used + 2 + len(near)] = near
                    records[used + 2 + len(near) : used + 2 + len(near) + len(swept)] = swept
                    used += 2 + len(near) + len(swept)
    return cells, tiles, records[:used]


def build_grid(
    lattices: NDArray[np.float64],
    first: NDArray[np.int64],
    bounds_low: Sequence[float],
    bounds_high: Sequence[float],
    nearest: int,
    reach: float,
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Build the grid of all maps; map m owns rows ``first[m]:first[m + 1]`` of `lattices`.

    Returns the flat grid and its geometry. Raises ValueError where the grid outgrows its 32-bit offsets.
    """
    shape = grid_shape(bounds_low, bounds_high, is_flat(lattices))
    low = np.array(bounds_low) - OUTSIDE
    size = np.array([CELL, CELL, bounds_high[2] + OUTSIDE - low[2] if shape[2] == 1 else CELL])
    parts = [
        map_records(lattices, a, b, low, size, shape, nearest, float(reach))
        for a, b in pairwise(first)
    ]
    n_cells, n_tiles = (sum(part[k].size for part in parts) for k in (0, 1))
    start = HEADER + n_cells + n_tiles + np.cumsum([0] + [len(part[2]) for part in parts])
    if start[-1] > np.iinfo(np.int32).max:
        raise ValueError(f"{len(parts)} maps of this size do not fit the obstacle grid: use fewer maps")
    tiles_y, tiles_x = parts[0][1].shape
    header = np.array([*shape, tiles_x, tiles_y, HEADER + n_cells, 0, 0])
    offsets = [(part[k] + s).ravel() for k in (0, 1) for part, s in zip(parts, start[:-1], strict=True)]
    grid = np.concatenate([header, *offsets, *(part[2] for part in parts)]).astype(np.int32)
    return grid, np.concatenate([low, 1 / size])
