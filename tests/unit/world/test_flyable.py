"""The certificate of flyability against walls built by hand, and the choice of unseen maps."""

from dataclasses import replace

import pytest

from srlrace.config import SpacingConfig, TrackConfig
from srlrace.world.flyable import FIRST_UNSEEN_SEED, is_flyable, unseen_maps
from srlrace.world.levels import generate_map
from srlrace.world.obstacles import cylinder, sphere

CLEARANCE = 0.27  # m: arm and margin
TRACK = TrackConfig("hall", ((4.0, 0.0, 1.5),), (-4.0, 0.0, 1.5), (-5.0, -3.0, 0.0), (5.0, 3.0, 3.0), 0, 20.0)


def wall(door, height=3.0):
    """Trees of 0.3 m side by side at x = 0, but for a door of this width around y = 0."""
    offsets = [0.3 + door / 2 + 0.5 * k for k in range(6)]
    return [cylinder((0.0, side * y, height / 2), 0.3, height) for y in offsets for side in (-1, 1)]


def test_doors() -> None:
    assert is_flyable(TRACK, [], CLEARANCE)
    assert is_flyable(TRACK, wall(1.4), CLEARANCE)
    assert not is_flyable(TRACK, wall(2 * CLEARANCE - 0.02), CLEARANCE)
    assert not is_flyable(TRACK, wall(0.0), CLEARANCE)


def test_low_wall_is_flown_over_and_balls_flown_around() -> None:
    assert is_flyable(TRACK, wall(0.0, height=1.2), CLEARANCE)
    assert not is_flyable(TRACK, wall(0.0, height=2.6), CLEARANCE)
    assert is_flyable(TRACK, [sphere((0.0, 0.0, 1.5), 0.8)], CLEARANCE)


def test_blocked_waypoint() -> None:
    assert not is_flyable(TRACK, [sphere((4.0, 0.3, 1.5), 0.3)], CLEARANCE)
    assert not is_flyable(TRACK, [cylinder((-4.0, 0.3, 1.5), 0.3, 3.0)], CLEARANCE)


def test_split_s_can_be_flown(split_s, level) -> None:
    assert is_flyable(split_s, generate_map(split_s, level("split_s"), 0), CLEARANCE)


def test_unseen_maps_are_flyable_distinct_and_far_from_training(forest, level) -> None:
    seeds = unseen_maps(forest, level("3"), 4, 0.17)
    assert list(seeds) == sorted(set(seeds))
    assert len(seeds) == 4
    assert min(seeds) >= FIRST_UNSEEN_SEED
    assert all(is_flyable(forest, generate_map(forest, level("3"), seed), CLEARANCE) for seed in seeds)
    assert unseen_maps(forest, level("3"), 2, 0.17) == seeds[:2]


def test_unseen_maps_skip_what_cannot_be_flown(level) -> None:
    """In a narrow hall some forests close the way: they are skipped, and the rest kept in order."""
    dense = replace(level("3"), spacings=(SpacingConfig(1.6, 0.3),), clear_radius=0.5)
    seeds = unseen_maps(TRACK, dense, 3, 0.17)
    skipped = set(range(FIRST_UNSEEN_SEED, seeds[-1])) - set(seeds)
    assert skipped
    assert not any(is_flyable(TRACK, generate_map(TRACK, dense, seed), CLEARANCE) for seed in skipped)


def test_hopeless_level_is_explained(level) -> None:
    wood = replace(level("3"), spacings=(SpacingConfig(1.0, 0.0),))
    with pytest.raises(ValueError, match="are flyable"):
        unseen_maps(TRACK, wood, 1, 0.17)
