"""The candidate grid never misses an obstacle, and stays short however many obstacles there are."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srlrace.config import SpacingConfig
from srlrace.world import grid as g
from srlrace.world.field import ObstacleField
from srlrace.world.lattice import pack
from srlrace.world.obstacles import box, cylinder, sphere

LOW, HIGH = (-3.0, -3.0, 0.0), (3.0, 3.0, 4.0)


def lists(field, map_index, x, y, z):
    """Near and swept list of a cell, read from the documented layout."""
    nx, ny, nz = field.grid[:3]
    start = field.grid[g.HEADER + ((map_index * nz + z) * ny + y) * nx + x]
    near, swept = field.grid[start : start + 2]
    ids = field.grid[start + 2 : start + 2 + near + swept] - field.first[map_index]
    return ids[:near], ids[near:]


place = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 4))
shape = st.one_of(
    st.builds(sphere, place, st.floats(0.05, 1.5)),
    st.builds(cylinder, place, st.floats(0.1, 0.6), st.floats(0.2, 4)),
    st.builds(box, place, st.floats(0.1, 1.5)),
    st.builds(lambda c: cylinder((c[0], c[1], 2.0), 0.3, 4.0), place),
)


@settings(deadline=None, max_examples=60)
@given(shapes=st.lists(shape, min_size=1, max_size=25), n=st.integers(1, 12), reach=st.floats(0.5, 8), data=st.data())
def test_lists_hold_all_that_any_point_needs(enumeration, shapes, n, reach, data) -> None:
    field = ObstacleField.of_maps([tuple(shapes)], LOW, HIGH, n, reach, np.float64)
    truth = enumeration(tuple(shapes))
    cell = tuple(data.draw(st.integers(0, int(count) - 1)) for count in field.grid[:3])
    near, swept = lists(field, 0, *cell)
    low, size = field.geometry[:3], 1 / field.geometry[3:]
    rng = np.random.default_rng(0)
    for share in rng.uniform(0, 1, (20, 3)):
        point = low + (cell + share) * size
        distances = truth.distances(point)
        order = np.argsort(distances)[:n]
        assert set(order[distances[order] < reach]) <= set(near)
        assert np.argmin(distances - truth.radii) in near
    for share in rng.uniform(-g.MARGIN, g.MARGIN, (20, 3)) + rng.uniform(0, 1, (20, 3)) * size:
        assert np.argmin(truth.distances(low + cell * size + share) - truth.radii) in swept


def test_lists_stay_short(forest, level) -> None:
    """Ten times the obstacles: hardly more candidates per query."""
    lengths = {}
    for name, pitch in (("100", 4.0), ("1000", 1.3)):
        dense = replace(level("2"), spacings=(SpacingConfig(pitch, 0.1),))
        field = ObstacleField.build(forest, dense, 1, 10, 10.0)
        cells = field.grid[g.HEADER : g.HEADER + int(np.prod(field.grid[:3]))]
        lengths[name] = len(field.obstacles(0)), field.grid[cells].mean(), field.grid[cells + 1].mean()
    assert lengths["1000"][0] > 8 * lengths["100"][0]
    assert lengths["1000"][1] < 1.7 * lengths["100"][1]
    assert lengths["1000"][2] < 10


def test_forests_need_one_layer_and_other_worlds_several(forest, level) -> None:
    trees = ObstacleField.build(forest, level("3"), 1, 10, 10.0)
    assert trees.grid[2] == 1
    assert not g.is_flat(pack([*trees.obstacles(0), sphere((0, 0, 1), 0.3)]))


def test_grid_too_large_is_refused(monkeypatch) -> None:
    huge = (np.zeros((1, 1, 1), np.int64), np.zeros((1, 1), np.int64), np.empty(2**30, np.int32))
    monkeypatch.setattr(g, "map_records", lambda *_: huge)
    with pytest.raises(ValueError, match="use fewer maps"):
        g.build_grid(pack([sphere((0, 0, 1), 0.3)]), np.zeros(4, np.int64), LOW, HIGH, 10, 10.0)
