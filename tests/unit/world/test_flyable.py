"""Clear paths against walls built by hand."""

from itertools import pairwise

import numpy as np
import pytest

from srlrace.config import TrackConfig
from srlrace.world.flyable import clear_path
from srlrace.world.levels import generate_map
from srlrace.world.obstacles import cylinder, sphere

CLEARANCE = 0.27  # m: arm and margin
TRACK = TrackConfig("hall", ((4.0, 0.0, 1.5),), (-4.0, 0.0, 1.5), (-5.0, -3.0, 0.0), (5.0, 3.0, 3.0), 0, 20.0)


def wall(door, height=3.0):
    """Trees of 0.3 m side by side at x = 0, but for a door of this width around y = 0."""
    offsets = [0.3 + door / 2 + 0.5 * k for k in range(6)]
    return [cylinder((0.0, side * y, height / 2), 0.3, height) for y in offsets for side in (-1, 1)]


def has_path(track, obstacles):
    return clear_path(track, obstacles, CLEARANCE) is not None


def test_doors() -> None:
    assert has_path(TRACK, [])
    assert has_path(TRACK, wall(1.4))
    assert not has_path(TRACK, wall(2 * CLEARANCE - 0.02))
    assert not has_path(TRACK, wall(0.0))


def test_low_wall_is_flown_over_and_balls_flown_around() -> None:
    assert has_path(TRACK, wall(0.0, height=0.9))
    assert not has_path(TRACK, wall(0.0, height=2.6))
    assert has_path(TRACK, [sphere((0.0, 0.0, 1.5), 0.8)])


def test_blocked_waypoint() -> None:
    assert not has_path(TRACK, [sphere((4.0, 0.3, 1.5), 0.3)])
    assert not has_path(TRACK, [cylinder((-4.0, 0.3, 1.5), 0.3, 3.0)])


@pytest.mark.parametrize("name", ["1", "2", "3"])
def test_paths_join_all_waypoints_and_stay_clear(forest, level, enumeration, name) -> None:
    trees = generate_map(forest, level(name), 0)
    legs = clear_path(forest, trees, CLEARANCE)
    assert legs is not None
    stops = np.array([forest.start, *forest.waypoints])
    assert np.array([leg[0] for leg in legs]) == pytest.approx(stops[:-1])
    assert np.array([leg[-1] for leg in legs]) == pytest.approx(stops[1:])
    exact = enumeration(trees)
    assert min(exact.swept_gap(a, b) for leg in legs for a, b in pairwise(leg)) > CLEARANCE


def test_an_open_way_is_straight_and_a_guide_leads_elsewhere(forest) -> None:
    assert [len(leg) for leg in clear_path(forest, [], CLEARANCE)] == [2] * 9
    tree = [cylinder((0.0, 0.0, 1.5), 0.5, 3.0)]
    for side in (-1, 1):
        guide = np.array([[x, 2.0 * side, 1.5] for x in np.linspace(-4, 4, 50)])
        (leg,) = clear_path(TRACK, tree, CLEARANCE, guide)
        assert leg[np.argmin(np.abs(leg[:, 0])), 1] * side > 0.5
