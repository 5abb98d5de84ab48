"""A drone's flight depends on its own stream alone; a race continues exactly from its snapshot."""

import dataclasses

import numpy as np
import pytest

from srlrace.task.race import Race, RaceMode


def actions(steps, n):
    return np.random.default_rng(5).uniform(-1, 1, (steps, n, 4)).astype(np.float32)


@pytest.mark.parametrize(
    "overrides", [(), ("env=split_s", "randomization=full", "randomization.maps=3", "observation=rays")]
)
def test_drones_do_not_depend_on_the_batch(config, overrides):
    """Drone i of 7 and drone i of 100: the same bits, over episodes that end and begin."""
    settings = config(*overrides, "curriculum=none")
    small, large = (Race(settings, RaceMode(3, np.arange(n), autoreset=True, curriculum=False)) for n in (7, 100))
    np.testing.assert_array_equal(small.reset(), large.reset()[:7])
    ended = 0
    for action in actions(120, 100):
        a, b = small.step(action[:7].copy()), large.step(action)
        ended += (a.outcome > 0).sum()
        for name in ("observation", "reward", "outcome", "time", "clearance"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name)[:7])
        np.testing.assert_array_equal(a.reward_terms, b.reward_terms[:, :7])
    assert ended > 5


def test_any_member_alone(config):
    """Episode 41 alone is episode 41 among others: the same stream, whatever the drone's place."""
    settings = config()
    some = Race(settings, RaceMode.evaluation(9, np.array([3, 41, 8])))
    alone = Race(settings, RaceMode.evaluation(9, np.array([41])))
    np.testing.assert_array_equal(some.reset()[1], alone.reset()[0])
    for action in actions(30, 1):
        a, b = some.step(np.repeat(action, 3, axis=0)), alone.step(action)
        np.testing.assert_array_equal(a.observation[1], b.observation[0])
        assert a.reward[1] == b.reward[0]


def test_seeds_and_members_differ(config):
    settings = config()
    starts = {
        tuple(Race(settings, RaceMode.evaluation(seed, np.array([member]))).reset()[0].tolist())
        for seed in (0, 1)
        for member in (0, 1)
    }
    assert len(starts) == 4


def test_the_same_seed_is_the_same_race(config, trained):
    a, b = trained(config(), 20), trained(config(), 20)
    for action in actions(80, 20):
        np.testing.assert_array_equal(a.step(action).observation, b.step(action).observation)


def test_a_snapshot_continues_exactly(config, trained):
    """Into a fresh race, in the middle of everything: curriculum, remembered passings, half-flown episodes."""
    settings = config("level=1", "randomization=full", "randomization.maps=3")
    curriculum = dataclasses.replace(settings.curriculum, memory_starts=0.5, gate_starts=0.4)
    settings = dataclasses.replace(settings, curriculum=curriculum)
    race, other = trained(settings, 30), trained(settings, 30, 2)
    for action in actions(100, 30):
        race.fleet.state[:3] = race.fleet.waypoints[race.fleet.target, :, np.arange(30)].T + 0.1  # so that they pass
        race.step(action)
    assert race.memory.count.sum() > 100
    other.restore(race.snapshot())
    race.set_progress(0.3)
    other.set_progress(0.3)
    for action in actions(100, 30):
        a, b = race.step(action), other.step(action)
        for name in ("observation", "terminal_observation", "reward", "outcome", "ledger"):
            ended = a.outcome > 0 if name == "terminal_observation" else slice(None)
            np.testing.assert_array_equal(getattr(a, name)[ended], getattr(b, name)[ended])
    for name, array in race.snapshot().items():
        np.testing.assert_array_equal(array, other.snapshot()[name], err_msg=name)


def test_a_snapshot_of_another_race_is_refused(config, trained):
    small, large = trained(config(), 3), trained(config(), 4)
    before = small.snapshot()
    with pytest.raises(ValueError, match=r"snapshot of fleet.state is float32\(17, 4\), not float32\(17, 3\)"):
        small.restore(large.snapshot())
    for name, array in small.snapshot().items():
        np.testing.assert_array_equal(array, before[name])
