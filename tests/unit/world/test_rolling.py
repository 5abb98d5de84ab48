"""Fresh maps in their slots, against fields that were packed from scratch."""

from __future__ import annotations

import numpy as np
import pytest

from srlrace.world import rolling
from srlrace.world.field import ObstacleField, cast_rays, nearest, ray_directions
from srlrace.world.levels import FIRST_UNSEEN_SEED, generate_map
from srlrace.world.rolling import RollingField

NEAREST, REACH = 10, 10.0
MAPS, SPARE = 4, 2


@pytest.fixture(scope="module")
def settings():
    from srlrace.hydra_bridge import compose

    return compose(["level=endless"])


@pytest.fixture
def ring(settings) -> RollingField:
    return RollingField(settings.env, settings.level, MAPS, SPARE, NEAREST, REACH)


def answers(field, map_index: int, points) -> np.ndarray:
    """Nearest distances, the gap, and rays, seen from each point."""
    distance, index = np.empty(NEAREST, np.float32), np.empty(NEAREST, np.int32)
    directions, rays = ray_directions(16), np.empty(16, np.float32)
    found = []
    for point in points.astype(np.float32):
        count, gap = nearest(*point, map_index, *field.arrays, np.float32(REACH), distance, index)
        cast_rays(
            *point, map_index, *field.arrays, np.float32(0.25), np.float32(REACH), np.float32(1), np.float32(0),
            directions, rays,
        )  # fmt: skip
        found.append([count, gap, *distance, *rays])
    return np.array(found)


def check(settings, ring: RollingField, replaced: int) -> None:
    """Every map that is offered, and those before it, answer as when packed by themselves."""
    first = ring.offer(replaced)
    assert first == replaced % ring.slots
    rng = np.random.default_rng(replaced)
    points = rng.uniform(settings.env.bounds_low, settings.env.bounds_high, (20, 3))
    numbers = range(max(0, replaced - SPARE), replaced + MAPS)
    for number in numbers:
        alone = ObstacleField.of_seeds(settings.env, settings.level, [number], NEAREST, REACH)
        slot = number % ring.slots
        assert ring.obstacles(slot) == alone.obstacles(0)
        np.testing.assert_array_equal(answers(ring, slot, points), answers(alone, 0, points))


def test_what_is_offered_answers_like_a_field_of_its_own(settings, ring) -> None:
    arrays = [array.ctypes.data for array in ring.arrays]
    for replaced in (0, 1, 2, 7, 20):
        check(settings, ring, replaced)
    assert [array.ctypes.data for array in ring.arrays] == arrays  # exchanged in place: kernels see it


def test_what_is_offered_follows_from_the_count_alone(settings, ring) -> None:
    for replaced in range(9):
        ring.offer(replaced)
    again = RollingField(settings.env, settings.level, MAPS, SPARE, NEAREST, REACH)
    assert again.offer(8) == ring.offer(8)
    points = np.random.default_rng(1).uniform(settings.env.bounds_low, settings.env.bounds_high, (10, 3))
    for number in range(8 - SPARE, 8 + MAPS):
        slot = number % ring.slots
        np.testing.assert_array_equal(answers(ring, slot, points), answers(again, slot, points))


def test_a_slot_that_was_never_filled_is_empty(ring) -> None:
    inside = np.array([[0.0, 0.0, 2.0]])
    (seen,) = answers(ring, MAPS, inside)
    assert seen[0] == 0
    assert seen[1] > 100  # m
    assert (seen[2:] == REACH).all()


def test_a_larger_map_makes_room_for_itself(settings, monkeypatch) -> None:
    monkeypatch.setattr(rolling, "ROOM", 1.0)  # none to spare
    sparse_first = RollingField(settings.env, settings.level, 1, 0, NEAREST, REACH)
    sizes = [len(sparse_first.grid)]
    for number in range(1, 9):
        sparse_first.offer(number)
        sizes.append(len(sparse_first.grid))
    assert sizes[2] > sizes[0]  # the first dense map
    points = np.random.default_rng(1).uniform(settings.env.bounds_low, settings.env.bounds_high, (10, 3))
    alone = ObstacleField.of_seeds(settings.env, settings.level, [8], NEAREST, REACH)
    np.testing.assert_array_equal(answers(sparse_first, 0, points), answers(alone, 0, points))


def test_training_never_comes_to_the_maps_of_the_evaluation(settings) -> None:
    ring = RollingField(settings.env, settings.level, 1, 0, NEAREST, REACH)
    ring.offer(FIRST_UNSEEN_SEED + 2)
    assert ring.obstacles(0) == generate_map(settings.env, settings.level, 2)


def test_worlds_with_other_obstacles(settings) -> None:
    """Layers of cells in z as well."""
    import dataclasses

    from srlrace.config import ObstacleConfig

    ball = ObstacleConfig("sphere", (0.0, 0.0, 4.0), radius=1.0)
    level = dataclasses.replace(settings.level, obstacles=(ball,))
    ring = RollingField(settings.env, level, 2, 0, NEAREST, REACH)
    ring.offer(3)
    points = np.random.default_rng(1).uniform((-3, -3, 0), (3, 3, 8), (20, 3))
    alone = ObstacleField.of_seeds(settings.env, level, [4], NEAREST, REACH)
    np.testing.assert_array_equal(answers(ring, 0, points), answers(alone, 0, points))
