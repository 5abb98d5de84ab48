"""Fresh maps during a training: a ring of slots, one of which is drawn anew now and then.

The maps of a level are numbered without end; map i lies in slot i % slots. After c of them have been replaced, the maps
c, c + 1, ... are offered to new episodes, as many as the level has; the few before them stay for the flights that
began there. Which maps lie where is a function of c alone. The packed arrays are those of an `ObstacleField`, with a
fixed share for each slot, so that a map is exchanged in its place while the kernels keep the arrays.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srlrace.config import LevelConfig, TrackConfig
from srlrace.world.field import aligned
from srlrace.world.grid import HEADER, grid_cells, grid_shape, is_flat, map_records, tile_counts
from srlrace.world.lattice import ROW, pack
from srlrace.world.levels import FIRST_UNSEEN_SEED, generate_map
from srlrace.world.obstacles import Obstacle

ROOM = 1.25  # times the largest map so far: a larger one still makes everything be packed anew


class RollingField:
    """The maps offered at one time of a training, uncertified; `arrays` is what the queries take."""

    def __init__(
        self, track: TrackConfig, level: LevelConfig, maps: int, spare: int, nearest: int, reach: float,
        dtype: Any = np.float32,
    ) -> None:  # fmt: skip
        """Offer the first ``maps`` maps of a level; ``spare`` more slots keep those that were offered before."""
        self.maps, self.slots = maps, maps + spare
        self.nearest, self.reach = nearest, float(reach)
        self._track, self._level, self._dtype = track, level, dtype
        self._held: list[int | None] = [None] * self.slots  # number of the map in each slot
        self._obstacles: list[tuple[Obstacle, ...]] = [()] * self.slots
        self._shape = grid_shape(track.bounds_low, track.bounds_high, is_flat(pack(self._draw(0))))
        self._low_and_size = low, size = grid_cells(track.bounds_low, track.bounds_high, self._shape)
        self.geometry = np.array([*low, *(1 / edge for edge in size)]).astype(dtype)
        self._rows, self._room = 1, 1  # of a slot: obstacles, and numbers in the grid
        self._allocate()
        self.offer(0)

    @property
    def arrays(self) -> tuple[NDArray[Any], NDArray[np.int32], NDArray[Any]]:
        """The field as the kernels take it: ``(lattices, grid, geometry)``."""
        return self.lattices, self.grid, self.geometry

    def obstacles(self, slot: int) -> tuple[Obstacle, ...]:
        """Obstacles of the map in a slot."""
        return self._obstacles[slot]

    def offer(self, replaced: int) -> int:
        """Hold the maps of a training that has replaced so many; return the slot of the first that is offered."""
        for number in range(max(0, replaced - (self.slots - self.maps)), replaced + self.maps):
            if self._held[number % self.slots] != number:
                self._hold(number)
        return replaced % self.slots

    def _draw(self, number: int) -> tuple[Obstacle, ...]:
        # Numbers so large that they would reach the seeds of the maps for evaluation start again.
        return generate_map(self._track, self._level, number % FIRST_UNSEEN_SEED)

    def _hold(self, number: int) -> None:
        slot = number % self.slots
        self._held[slot], self._obstacles[slot] = number, self._draw(number)
        if self._place(slot):
            return
        taken = [other for other, held in enumerate(self._held) if held is not None]
        self._allocate()
        while not all(map(self._place, taken)):
            self._allocate()

    def _allocate(self) -> None:
        """Make the arrays, with as much room for each slot as was asked for, and every slot empty."""
        shape, (tiles_y, tiles_x) = self._shape, tile_counts(self._shape)
        self._cells, self._tiles = shape[0] * shape[1] * shape[2], tiles_y * tiles_x
        self._start = HEADER + self.slots * (self._cells + self._tiles)  # of the records
        size = self._start + self.slots * self._room + 2
        if size > np.iinfo(np.int32).max:
            raise ValueError(f"{self.slots} maps of this size do not fit the obstacle grid: use fewer maps")
        self.grid = np.zeros(size, np.int32)
        self.grid[:HEADER] = [*shape, tiles_x, tiles_y, HEADER + self.slots * self._cells, 0, 0]
        self.grid[HEADER : self._start] = size - 2  # two zeros at the end: the record of a place without obstacles
        self._packed = np.zeros((self.slots * self._rows, ROW))
        self.lattices = aligned(self._packed, self._dtype)

    def _place(self, slot: int) -> bool:
        """Pack the map of a slot in its place; False, with more room asked for, where it does not fit."""
        rows, first = pack(self._obstacles[slot]), slot * self._rows
        if len(rows) > self._rows:
            self._rows = math.ceil(ROOM * len(rows))
            return False
        ids = np.arange(first, first + len(rows), dtype=np.int32)
        self._packed[ids], self.lattices[ids] = rows, rows
        low, size = self._low_and_size
        cells, tiles, records = map_records(self._packed, ids, low, size, self._shape, self.nearest, self.reach)
        if len(records) > self._room:
            self._room = math.ceil(ROOM * len(records))
            return False
        start = self._start + slot * self._room
        self.grid[start : start + len(records)] = records
        for offsets, at in ((cells, HEADER + slot * self._cells), (tiles, int(self.grid[5]) + slot * self._tiles)):
            self.grid[at : at + offsets.size] = offsets.ravel() + start
        return True
