"""Demonstrated flights: the simulator flies them as they say, and nothing but a sound one is read."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from srlrace.bound import demonstration
from srlrace.bound.clearance import smallest_gap
from srlrace.bound.demonstration import (
    demonstration_key,
    displacement_of,
    load_demonstration,
    room_problem,
    save_demonstration,
)
from srlrace.bound.problem import problem_of
from srlrace.hydra_bridge import compose
from srlrace.learn.teacher import deviation, fly_once
from srlrace.task.race import Race, RaceMode

FOREST = compose(["env=forest"])
SPLIT_S = compose(["env=split_s", "randomization=init"])  # one waypoint displaced in each episode


@pytest.fixture
def shown():
    found = load_demonstration(FOREST)
    assert found is not None
    return found


@pytest.fixture(params=[FOREST, SPLIT_S], ids=["forest", "split_s"])
def shipped(request):
    """A configuration and the demonstration that ships for it."""
    found = load_demonstration(request.param)
    assert found is not None
    return request.param, found


def rules(config):
    return Race(config, RaceMode.evaluation(0, np.arange(1)), dtype=np.float64).rules


def test_the_simulator_goes_from_each_sample_to_the_next(shipped):
    """What lies between is interpolated, so a centimetre (Split-S: 1.1) and a few degrees a second may be missing."""
    config, found = shipped
    ended = fly_once(rules(config), found.state[:-1], found.action)
    errors = np.array([deviation(a[None], b)[0] for a, b in zip(ended, found.state[1:], strict=True)])
    assert np.abs(errors[:, :3]).max() < (0.01 if config is FOREST else 0.011)
    assert np.abs(errors[:, 3:6]).max() < 0.3
    assert np.abs(errors[:, 6:9]).max() < 0.05


def test_it_starts_at_rest_and_passes_every_waypoint_with_room(shipped):
    config, found = shipped
    problem = room_problem(config)
    assert problem.keep_out == pytest.approx(config.keep_out + (0.2 if displacement_of(config) else 0.12))
    assert smallest_gap(problem, found.state[:, :3]) > problem.keep_out - 0.01  # chords of what the solver keeps clear
    np.testing.assert_allclose(found.state[0, :3], config.env.start, atol=1e-6)
    np.testing.assert_allclose(found.state[0, 3:13], [0, 0, 0, 1, 0, 0, 0, 0, 0, 0], atol=1e-6)
    for index, waypoint in zip(found.passing, problem.waypoints, strict=True):
        around = found.state[max(index - 1, 0) : index + 1, :3] - waypoint
        reach = problem.passing_radius + np.linalg.norm(np.diff(around, axis=0), axis=1).max(initial=0.0)
        assert np.linalg.norm(around, axis=1).min() < reach
    assert np.abs(found.action).max() <= 1.0
    assert found.duration == pytest.approx(len(found.action) * config.sim.control_period, abs=0.01)


def test_it_depends_on_how_far_waypoints_are_displaced():
    """On the Forest, none is."""
    assert demonstration_key(compose(["env=forest", "randomization=init"])) == demonstration_key(FOREST)
    assert displacement_of(FOREST) == 0.0
    assert displacement_of(SPLIT_S) == 1.0
    others = ({"waypoint_displacement": 0.0}, {"waypoint_displacement": 0.5}, {"min_height": 0.5})
    draws = [dataclasses.replace(SPLIT_S.randomization, **other) for other in others]
    changed = [dataclasses.replace(SPLIT_S, randomization=draw) for draw in draws]
    assert len({demonstration_key(config) for config in (SPLIT_S, *changed)}) == 4


def test_a_small_one_is_found(config):
    pytest.importorskip("casadi", reason="the extra srlrace[bound] is not installed")
    from srlrace.bound.demonstrate import find_demonstration
    from srlrace.bound.solver import find_reference

    settings = config("level=none", "env.waypoints=[[-20,0,1.5],[-16,-4,1.5]]")
    reference = find_reference(problem_of(settings, "race"), 1)
    found = find_demonstration(settings, reference.trajectory)
    assert reference.time < found.duration < 1.25 * reference.time
    ended = fly_once(rules(settings), found.state[:-1], found.action)
    errors = [deviation(a[None], b)[0] for a, b in zip(ended, found.state[1:], strict=True)]
    assert np.abs(errors)[:, :3].max() < 0.01
    assert np.linalg.norm(found.state[found.passing[-1], :3] - [-16, -4, 1.5]) < 0.3


def test_it_is_kept_by_what_it_depends_on(shown, tmp_path, monkeypatch):
    monkeypatch.setattr(demonstration, "FOLDER", tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert load_demonstration(FOREST) is None
    path = save_demonstration(FOREST, shown)
    again = load_demonstration(FOREST)
    assert again is not None
    np.testing.assert_allclose(again.state, shown.state, atol=1e-6)
    slower = dataclasses.replace(FOREST.quad, rotor_time_constant=0.05)
    for other in (compose(["env=forest", "level=3"]), dataclasses.replace(FOREST, quad=slower)):
        assert demonstration_key(other) != path.stem
        assert load_demonstration(other) is None


@pytest.mark.parametrize("part", ["state", "action", "passing", "duration", "all"])
def test_a_damaged_one_is_none(shown, tmp_path, monkeypatch, part):
    monkeypatch.setattr(demonstration, "FOLDER", tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = save_demonstration(FOREST, shown, tmp_path)
    assert load_demonstration(FOREST) is not None
    with np.load(path, allow_pickle=False) as data:
        arrays = dict(data)
    if part == "all":
        path.write_bytes(path.read_bytes()[:-100])
    else:
        arrays[part] = {"passing": arrays["passing"][::-1], "duration": np.array(np.inf)}.get(
            part, arrays[part] * np.nan
        )
        np.savez(path, **arrays)
    assert load_demonstration(FOREST) is None
