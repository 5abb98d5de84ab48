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

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from srlrace.sim.compile import builder
from srlrace.world.lattice import LAST, ORIGIN, PITCH, RADIUS, Floats, Ints, Real, axis_centre, squared_distance

CELL = 1.0  # m, edge of a cell in x and y, and in z where the obstacles are not all trees
TILE = 4  # cells along the edge of a tile
MARGIN = 0.6  # m, inflation for the swept list: a chord of twice this fits around its middle
OUTSIDE = 2.0  # m, the grid goes on beyond the world's bounds: a drone leaving it is still served exactly
ROUNDING = 1e-3  # m, inflation of the near list against float32 rounding of positions
RAY_INFLATION = 1.0  # m, largest inflation of obstacles that tiles are good for
Offsets = NDArray[np.int64]
Vector = tuple[float, float, float]
Indices = tuple[int, int, int]

HEADER = 8
INV = 3  # geometry: [low x y z, 1 / cell x y z]


def grid_shape(bounds_low: Sequence[float], bounds_high: Sequence[float], flat: bool) -> tuple[int, int, int]:
    """Cells along x, y, z of a grid over the world and `OUTSIDE` around it; one layer if `flat`."""
    nx, ny, nz = (
        int(np.ceil((high - low + 2 * OUTSIDE) / CELL)) for low, high in zip(bounds_low, bounds_high, strict=True)
    )
    return nx, ny, 1 if flat else nz


def grid_cells(bounds_low: Sequence[float], bounds_high: Sequence[float], shape: Indices) -> tuple[Vector, Vector]:
    """Lower corner of the grid over a world, m, and the edges of a cell, m."""
    x, y, z = bounds_low
    low = (x - OUTSIDE, y - OUTSIDE, z - OUTSIDE)
    return low, (CELL, CELL, bounds_high[2] + OUTSIDE - low[2] if shape[2] == 1 else CELL)


def tile_counts(shape: Indices) -> tuple[int, int]:
    """Tiles along y and x."""
    return (shape[1] + TILE - 1) // TILE, (shape[0] + TILE - 1) // TILE


def is_flat(lattices: NDArray[np.float64]) -> bool:
    """Whether all obstacles are stacks with the same layers, so that height does not change their order."""
    stacked = (lattices[:, LAST] == 0).all() and (lattices[:, LAST + 1] == 0).all()
    layers = lattices[:, [ORIGIN + 2, PITCH + 2, LAST + 2]]
    return bool(stacked and (layers == layers[:1]).all())


@builder
def axis_bounds(lattices: Floats, i: int, axis: int, centre: Real, half: Real) -> tuple[Real, Real]:
    """Smallest and largest squared distance along one axis, over an interval, to the nearest layer."""
    low, high = centre - half, centre + half
    a, b = axis_centre(low, lattices, i, axis), axis_centre(high, lattices, i, axis)
    first = lattices[i, ORIGIN + axis]
    last = first + lattices[i, PITCH + axis] * lattices[i, LAST + axis]
    largest = max(abs(low - a), abs(high - b))
    if lattices[i, LAST + axis] > 0 and high > first and low < last:
        largest = max(largest, 0.5 * lattices[i, PITCH + axis])
    # The interval holds a layer if the nearest one differs at its ends, or lies between them.
    smallest = 0.0 if a != b or low <= a <= high else min(abs(low - a), abs(high - b))
    return smallest * smallest, largest * largest


@builder
def bounds(lattices: Floats, i: int, centre: Vector, half: Vector) -> tuple[Real, Real]:
    """Smallest and largest distance to lattice `i` over a box."""
    low = high = 0.0
    for axis in range(3):
        smallest, largest = axis_bounds(lattices, i, axis, centre[axis], half[axis])
        low += smallest
        high += largest
    return math.sqrt(low), math.sqrt(high)


@builder
def largest_difference(lattices: Floats, j: int, i: int, centre: Vector, half: Vector) -> Real:
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
def keep_reachable(
    lattices: Floats, pool: Ints, nearest: int, reach: Real, centre: Vector, half: Vector, out: Ints
) -> int:
    """Write to `out` the obstacles of `pool` that distance bounds over the box cannot rule out; return how many."""
    low, high, best = np.empty(len(pool)), np.empty(len(pool)), np.full(nearest, reach)
    surface = np.inf
    for k in range(len(pool)):
        low[k], high[k] = bounds(lattices, pool[k], centre, half)
        surface = min(surface, high[k] - lattices[pool[k], RADIUS])
        if nearest > 0 and high[k] < best[nearest - 1]:
            slot = nearest - 1
            while slot > 0 and best[slot - 1] > high[k]:
                best[slot] = best[slot - 1]
                slot -= 1
            best[slot] = high[k]
    count = 0
    for k in range(len(pool)):
        if (nearest > 0 and low[k] <= best[nearest - 1]) or low[k] - lattices[pool[k], RADIUS] <= surface:
            out[count] = pool[k]
            count += 1
    return count


@builder
def is_candidate(
    lattices: Floats, rivals: Ints, i: int, nearest: int, reach: Real, centre: Vector, half: Vector
) -> bool:
    """Whether obstacle `i` can be among the `nearest` within `reach`, or nearest by surface, somewhere in the box."""
    low, _ = bounds(lattices, i, centre, half)
    closer, touching = 0, True
    for j in rivals:
        if largest_difference(lattices, j, i, centre, half) < 0:
            closer += 1
            touching = touching and lattices[j, RADIUS] < lattices[i, RADIUS]
        if touching and lattices[j, RADIUS] != lattices[i, RADIUS]:
            high = bounds(lattices, j, centre, half)[1]
            touching = not high - lattices[j, RADIUS] < low - lattices[i, RADIUS]
        if closer >= nearest and not touching:
            return False
    return touching or low <= reach


@builder
def sort_by_distance(lattices: Floats, ids: Ints, centre: Vector) -> None:
    """Sort obstacles in place, the nearest to a point first."""
    key = np.empty(len(ids))
    for k in range(len(ids)):
        i, distance = ids[k], squared_distance(centre[0], centre[1], centre[2], lattices, ids[k])
        slot = k
        while slot > 0 and key[slot - 1] > distance:
            key[slot], ids[slot] = key[slot - 1], ids[slot - 1]
            slot -= 1
        key[slot], ids[slot] = distance, i


@builder
def candidates(lattices: Floats, pool: Ints, nearest: int, reach: Real, centre: Vector, half: Vector, out: Ints) -> int:
    """Write to `out` the obstacles of `pool` that the box needs, nearest to its centre first; return how many."""
    rivals = np.empty_like(pool)
    rivals = rivals[: keep_reachable(lattices, pool, nearest, reach, centre, half, rivals)]
    sort_by_distance(lattices, rivals, centre)  # the nearest rule out the rest soonest
    count = 0
    for i in rivals:
        if is_candidate(lattices, rivals, i, nearest, reach, centre, half):
            out[count] = i
            count += 1
    return count


@builder
def box(low: Vector, size: Vector, first: Indices, count: Indices, inflation: Real) -> tuple[Vector, Vector]:
    """Centre and half extents of a block of cells, inflated."""
    x, y, z = 0.5 * size[0] * count[0], 0.5 * size[1] * count[1], 0.5 * size[2] * count[2]
    centre = (low[0] + first[0] * size[0] + x, low[1] + first[1] * size[1] + y, low[2] + first[2] * size[2] + z)
    return centre, (x + inflation, y + inflation, z + inflation)


@builder
def cell_records(
    lattices: Floats, pool: Ints, low: Vector, size: Vector, cell: Indices, nearest: int, reach: Real, out: Ints
) -> int:
    """Write the record of one cell to `out`, the candidates being in `pool`; return its length."""
    centre, half = box(low, size, cell, (1, 1, 1), ROUNDING)
    out[0] = candidates(lattices, pool, nearest, reach, centre, half, out[2:])
    centre, half = box(low, size, cell, (1, 1, 1), MARGIN + ROUNDING)
    out[1] = candidates(lattices, pool, 0, 0.0, centre, half, out[2 + out[0] :])
    return 2 + out[0] + out[1]


@builder
def tile_records(
    lattices: Floats, everything: Ints, low: Vector, size: Vector, first: Indices, count: Indices, nearest: int,
    reach: Real, cells: Offsets, out: Ints,
) -> int:  # fmt: skip
    """Write the records of a tile to `out` and where its cells' start to `cells`; return their length."""
    centre, half = box(low, size, first, count, ROUNDING)
    used = 1
    for i in everything:
        if bounds(lattices, i, centre, half)[0] - lattices[i, RADIUS] <= reach + RAY_INFLATION:
            out[used] = i
            used += 1
    out[0] = used - 1
    sort_by_distance(lattices, out[1:used], centre)
    pool = np.empty_like(everything)
    for iz in range(first[2], first[2] + count[2]):
        centre, half = box(low, size, (first[0], first[1], iz), (count[0], count[1], 1), MARGIN + ROUNDING)
        kept = pool[: keep_reachable(lattices, everything, nearest, reach, centre, half, pool)]
        for iy in range(first[1], first[1] + count[1]):
            for ix in range(first[0], first[0] + count[0]):
                cells[iz, iy, ix] = used
                used += cell_records(lattices, kept, low, size, (ix, iy, iz), nearest, reach, out[used:])
    return used


@builder
def map_records(
    lattices: Floats, everything: Ints, low: Vector, size: Vector, shape: Indices, nearest: int, reach: Real
) -> tuple[Offsets, Offsets, Ints]:
    """Records of the map that owns the rows `everything`: (cell offsets, tile offsets, records)."""
    nx, ny, nz = shape
    cells = np.zeros((nz, ny, nx), np.int64)
    tiles = np.zeros(((ny + TILE - 1) // TILE, (nx + TILE - 1) // TILE), np.int64)
    spare = (1 + TILE * TILE * nz * 2) * (2 + len(everything))  # the longest records a tile can have
    records = np.empty(spare, np.int32)
    used = 0
    for ty in range(tiles.shape[0]):
        for tx in range(tiles.shape[1]):
            if used + spare > len(records):
                grown = np.empty(2 * len(records) + spare, np.int32)
                grown[:used] = records[:used]
                records = grown
            first = (tx * TILE, ty * TILE, 0)
            count = (min(TILE, nx - first[0]), min(TILE, ny - first[1]), nz)
            tiles[ty, tx] = used
            block = cells[:, first[1] : first[1] + count[1], first[0] : first[0] + count[0]]
            used += tile_records(lattices, everything, low, size, first, count, nearest, reach, cells, records[used:])
            block += tiles[ty, tx]
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
    low, size = grid_cells(bounds_low, bounds_high, shape)
    parts = [
        map_records(lattices, np.arange(a, b, dtype=np.int32), low, size, shape, nearest, float(reach))
        for a, b in pairwise(first)
    ]
    n_cells, n_tiles = (sum(part[k].size for part in parts) for k in (0, 1))
    start = HEADER + n_cells + n_tiles + np.cumsum([0] + [len(part[2]) for part in parts])
    if start[-1] > np.iinfo(np.int32).max:
        raise ValueError(f"{len(parts)} maps of this size do not fit the obstacle grid: use fewer maps")
    tiles_y, tiles_x = tile_counts(shape)
    header = np.array([*shape, tiles_x, tiles_y, HEADER + n_cells, 0, 0])
    offsets = [(part[k] + s).ravel() for k in (0, 1) for part, s in zip(parts, start[:-1], strict=True)]
    grid = np.concatenate([header, *offsets, *(part[2] for part in parts)]).astype(np.int32)
    return grid, np.array([*low, *(1 / edge for edge in size)])
