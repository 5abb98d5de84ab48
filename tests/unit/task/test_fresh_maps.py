"""Fresh maps in training: no forest changes around a drone that flies in it, and a snapshot goes on exactly."""

from __future__ import annotations

import numpy as np
import pytest

from srlrace.task.arrays import FLYING, Memory
from srlrace.task.race import Race, RaceMode
from srlrace.task.reset import forget_maps
from srlrace.world.field import ObstacleField

N, ROLLOUT, FRESH = 20, 50, 1000  # drones; steps of each in a rollout; environment steps for a map
MAPS = 6


@pytest.fixture(scope="module")
def settings(config):
    return config(
        "level=endless", f"level.maps={MAPS}", f"level.fresh_steps={FRESH}", "env.horizon=2", f"algo.n_steps={ROLLOUT}",
        "curriculum.memory_size=8", "curriculum.memory_starts=0.5", "curriculum.gate_starts=0.3",
        "curriculum.retry_starts=0.1",
    )  # fmt: skip


def begin(settings) -> Race:
    race = Race(settings, RaceMode.training(1, N))
    race.refresh(0)
    race.reset()
    return race


def offered(race: Race) -> set[int]:
    return {(race.rules.first_map + k) % race.rules.slots for k in range(race.rules.maps)}


def remembered(race: Race) -> np.ndarray:
    """The maps of all remembered passings."""
    size = race.memory.record.shape[1]
    return np.concatenate([race.memory.record[k, : min(c, size), -1] for k, c in enumerate(race.memory.count)])


def test_a_forest_does_not_change_around_a_drone(settings, pilot):
    race = begin(settings)
    seen, kept = race.output.observation, 0
    under = [race.field.obstacles(slot) for slot in race.fleet.map]
    for rollout in range(1, 14):
        began = offered(race)
        for _ in range(ROLLOUT):
            before = race.fleet.map.copy()
            out = race.step(pilot(seen))
            for i in range(N):
                if out.outcome[i] != FLYING:
                    assert race.fleet.map[i] in began
                    under[i] = race.field.obstacles(race.fleet.map[i])
                else:
                    assert race.fleet.map[i] == before[i]
        race.refresh(rollout * ROLLOUT * N)
        for i, obstacles in enumerate(under):
            assert race.field.obstacles(race.fleet.map[i]) is obstacles
            kept += race.fleet.map[i] not in offered(race)
        assert set(remembered(race).astype(int)) <= offered(race)
    assert race.field.obstacles(race.rules.first_map) is not under[0]
    assert kept > 10  # some did fly on in a forest that was no longer offered
    assert len(remembered(race)) > 0
    assert race.rules.first_map == 13 * ROLLOUT * N // FRESH % race.rules.slots


def test_a_snapshot_between_rollouts_goes_on_exactly(settings, pilot):
    one, saved = begin(settings), {}
    for rollout in range(1, 8):
        if rollout == 4:
            saved = one.snapshot()  # as a checkpoint: what was learned from the rollout, and no fresh map yet
        one.refresh((rollout - 1) * ROLLOUT * N)
        for _ in range(ROLLOUT):
            one.step(pilot(one.output.observation))
    other = Race(settings, RaceMode.training(1, N))
    other.restore(saved)
    for rollout in range(4, 8):
        other.refresh((rollout - 1) * ROLLOUT * N)
        for _ in range(ROLLOUT):
            other.step(pilot(other.output.observation))
    for name, array in one.snapshot().items():
        np.testing.assert_array_equal(array, other.snapshot()[name], err_msg=name)


def test_without_fresh_maps_nothing_is_exchanged(config, pilot):
    settings = config("level=mixed", "level.maps=3")
    race = begin(settings)
    assert isinstance(race.field, ObstacleField)
    for _ in range(100):
        race.step(pilot(race.output.observation))
    before, rules = race.snapshot(), race.rules
    race.refresh(10**6)
    assert race.rules is rules
    for name, array in race.snapshot().items():
        np.testing.assert_array_equal(array, before[name])


def test_evaluation_has_the_certified_maps_of_the_level(settings):
    race = Race(settings, RaceMode.evaluation(1, np.arange(3)))
    assert isinstance(race.field, ObstacleField)
    assert race.field.maps == MAPS


def test_forgetting_keeps_the_order_of_passing():
    """A ring of four that has been written six times, and one of two entries."""
    record = np.zeros((2, 4, 3), np.float32)
    for k in range(6):
        record[0, k % 4] = (k, 0, k % 3)  # number, filler, map
    record[1, :2] = [(10, 0, 2), (11, 0, 1)]
    hard = np.array([[4, 1, 0], [1, 2, 0], [2, 1, 0], [3, 0, 0]], np.float32)  # number, map, target; written five times
    failed, trail = np.zeros((2, 1), np.uint64), np.zeros((0, 2, 3), np.float32)
    memory = Memory(record, np.array([6, 2]), failed, np.zeros(1, np.int64), trail, hard, np.array([5]))
    forget_maps(memory, np.array([True, False, True]))
    assert memory.count.tolist() == [3, 1]
    assert record[0, :3, 0].tolist() == [2, 3, 5]
    assert record[1, 0, 0] == 10
    assert memory.hards.tolist() == [2]
    assert hard[:2, 0].tolist() == [1, 3]
    before = record.copy()
    forget_maps(memory, np.array([True, False, True]))
    np.testing.assert_array_equal(record, before)
