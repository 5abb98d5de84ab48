"""What a policy is shown at first: a regulator that flies, and lessons that count as they should."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from srlrace.bound.demonstration import Demonstration, load_demonstration
from srlrace.bound.escapes import ACTIONS, HOLD, load_escapes
from srlrace.config import ConfigError
from srlrace.hydra_bridge import compose
from srlrace.learn import update
from srlrace.learn.lean_ppo import LeanPPO
from srlrace.learn.ppo import build_ppo, what_is_shown
from srlrace.learn.teacher import SPREAD, Teacher, deviation, displaced, regulator
from srlrace.learn.train import train
from srlrace.task.arrays import FINISHED
from srlrace.task.race import Race, RaceMode
from srlrace.task.vec_env import RaceVecEnv

SMALL = [
    "env=forest", "algo.n_envs=16", "algo.n_steps=64", "algo.batch_size=256", "algo.n_epochs=1",
    "curriculum.teaching=2", "curriculum.teaching_end=0.5", "algo.total_steps=1000",
]  # fmt: skip


def flight(*overrides: str) -> tuple[Demonstration, Race]:
    config = compose([*SMALL, *overrides])
    shown = load_demonstration(config)
    assert shown is not None
    return shown, Race(config, RaceMode.evaluation(0, np.arange(60)))


def test_whoever_does_as_told_finishes_in_the_time_shown() -> None:
    shown, race = flight("randomization=none")
    teacher = Teacher(race, shown)
    race.reset()
    errors = 0.1 * np.random.default_rng(0).normal(size=(race.n, 16)) * SPREAD
    start = displaced(np.repeat(shown.state[:1], race.n, 0), errors)
    race.fleet.state[:] = start.T
    action, told = np.zeros((race.n, 4), np.float32), np.zeros(race.n, np.float32)
    while not race.fleet.parked.all():
        teacher.advise(action, told)
        assert told[~race.fleet.parked].all()
        race.step(action)
    assert (race.output.outcome == FINISHED).all()
    np.testing.assert_allclose(race.output.time, shown.duration, atol=0.15)


def test_there_is_nothing_to_say_far_away_or_where_a_waypoint_is_displaced() -> None:
    shown, race = flight("randomization=none")
    teacher = Teacher(race, shown)
    race.reset()
    race.fleet.state[:] = shown.state[0][:, None]
    race.fleet.state[0, 0] += 1.1
    race.fleet.state[3, 1] -= 6.0
    race.fleet.state[6:10, 2] = [0.0, 1.0, 0.0, 0.0]
    race.fleet.waypoints[0, 1, 3] += 0.2
    race.fleet.waypoints[1, 2, 4] -= 0.2
    race.fleet.waypoints[2, 2, 5] -= 0.2  # not next, nor the one after
    told = np.full(race.n, 7.0, np.float32)
    teacher.advise(np.zeros((race.n, 4), np.float32), told)
    assert told[:7].tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0]


def test_errors_are_what_states_were_displaced_by() -> None:
    rng = np.random.default_rng(1)
    state = rng.normal(size=17)
    state[6:10] /= np.linalg.norm(state[6:10])
    error = 1e-4 * rng.normal(size=(30, 16))
    moved = displaced(np.repeat(state[None], 30, 0), error)
    np.testing.assert_allclose(deviation(moved, state), error, atol=1e-8)
    moved[::2, 6:10] *= -1.0  # the same attitude
    np.testing.assert_allclose(deviation(moved, state), error, atol=1e-8)


def test_the_regulator_settles_a_double_integrator() -> None:
    a, b = np.tile(np.eye(16), (300, 1, 1)), np.zeros((300, 16, 4))
    a[:, 0, 3], b[:, 3, 0] = 0.02, 0.4
    gains = regulator((a, b))
    error = np.zeros(16)
    error[0] = 0.5
    for k in range(150):
        error = a[k] @ error - b[k] @ (gains[k] @ error)
    assert abs(error[0]) < 0.02


def taught(*overrides: str) -> LeanPPO:
    env = RaceVecEnv(compose([*SMALL, *overrides]))
    model = build_ppo(env.race.config, env)
    assert isinstance(model, LeanPPO)
    assert model.teacher
    model.teacher.begin_rollout(0)
    _, callback = model._setup_learn(16 * 64, None)
    model.collect_rollouts(env, callback, model.rollout_buffer, 64)
    return model


@pytest.mark.parametrize("std", ["false", "true"])
def test_a_lesson_adds_the_gradient_of_its_squared_error(std: str) -> None:
    model = taught(f"algo.state_dependent_std={std}")
    buffer, rows = model.rollout_buffer, np.arange(1024)
    wanted, counts = (a.reshape(1024, -1) for a in model._lessons)
    assert set(counts.ravel().tolist()) == {0.0, 2.0}
    observations, actions = (a.reshape(1024, -1) for a in (buffer.observations, buffer.actions))
    samples = [a.reshape(-1) for a in (buffer.log_probs, buffer.advantages, buffer.returns)]
    gradients = []
    for lessons in ((wanted[:0], counts[:0, 0]), (wanted, counts[:, 0])):
        update.gradient_step(
            model.networks.memory, model.actor, model.critic, model.networks.activation, model.parameters,
            model.gradient, rows, observations, actions, *samples, lessons, 0.2, 0.0, 0.5, True,
            np.zeros(update.STATISTICS),
        )  # fmt: skip
        gradients.append(model.gradient.copy())
    policy = model.policy
    latent = policy.mlp_extractor.forward_actor(torch.from_numpy(observations))
    error = policy.action_net(latent)[:, :4] - torch.from_numpy(wanted)
    beyond = (torch.from_numpy(np.abs(wanted)) >= 1.0) & (error * torch.from_numpy(wanted) >= 0.0)
    loss = (torch.from_numpy(counts) * error.masked_fill(beyond, 0.0) ** 2).sum() / 1024
    policy.zero_grad()
    loss.backward()
    expected = np.concatenate(
        [(torch.zeros_like(p) if p.grad is None else p.grad).flatten().numpy() for p in policy.parameters()]
    )
    np.testing.assert_allclose(gradients[1] - gradients[0], expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_teaching_ends_and_its_passings_are_starts_until_then() -> None:
    model = taught()
    teacher, memory = model.teacher, model.env.race.memory  # type: ignore[union-attr]
    assert teacher is not None
    weights = []
    for steps in (0, 250, 499, 500, 900):
        before = memory.record.copy()
        teacher.begin_rollout(steps)
        weights.append(teacher.weight)
        assert (memory.record[1:] != before[1:]).any() == (steps in (250, 499))  # at 0 the same as at first
    assert weights == pytest.approx([2.0, 1.0, 0.004, 0.0, 0.0])
    assert (memory.count[1:] > 0).all()


def escaping(*overrides: str) -> tuple[Race, Teacher]:
    """A training race all of whose episodes begin at hard starts, and its teacher."""
    config = compose([*SMALL, "curriculum=none", "curriculum.escape_starts=1", *overrides])
    race = Race(config, RaceMode.training(0, 64))
    shown, escapes = load_demonstration(config), load_escapes(config)
    assert shown is not None
    assert escapes is not None
    return race, Teacher(race, shown, escapes)


def test_ways_out_are_told_from_hard_starts_as_long_as_they_last() -> None:
    race, teacher = escaping()
    escapes = load_escapes(race.config)
    assert escapes is not None
    race.reset()
    begun = race.fleet.escape.copy()
    assert (begun >= 0).all()
    assert len(set(begun.tolist())) > 40
    np.testing.assert_array_equal(race.fleet.state.T, escapes.start[begun, :17].astype(np.float32))
    assert race.fleet.staged.all()  # none counts as an episode from the start
    action, told = np.zeros((race.n, 4), np.float32), np.zeros(race.n, np.float32)
    teacher.weight, teacher.escape_weight = 0.0, 2.0
    for step in range(ACTIONS * HOLD):
        teacher.advise(action, told)
        assert (told == 2.0).all()
        np.testing.assert_array_equal(action, escapes.action[begun, step // HOLD].astype(np.float32))
        race.step(action)
    assert (race.fleet.escape == begun).all()  # nobody has crashed
    teacher.advise(action, told)
    assert not told.any()


def test_ways_out_count_until_they_do_not() -> None:
    _, teacher = escaping("curriculum.escape_hold=0.2", "curriculum.escape_end=0.6")
    weights = []
    for steps in (0, 200, 400, 600, 900):
        teacher.begin_rollout(steps)
        weights.append((teacher.weight, teacher.escape_weight, teacher.teaches))
    assert weights == [
        (2.0, 2.0, True),
        (pytest.approx(1.2), 2.0, True),
        (pytest.approx(0.4), pytest.approx(1.0), True),
        (0.0, 0.0, False),
        (0.0, 0.0, False),
    ]


def test_without_ways_out_on_file_they_cannot_be_asked_for(tmp_path: Path) -> None:
    config = compose([*SMALL, "curriculum.escape_starts=0.1", "randomization.velocity=1.1"])
    with pytest.raises(ConfigError, match="srlrace bound --escapes"):
        what_is_shown(config)


def test_a_track_without_a_flight_says_what_finds_one() -> None:
    env = RaceVecEnv(compose([*SMALL, "level=3"]))
    with pytest.raises(ConfigError, match="srlrace bound --demonstrate"):
        build_ppo(env.race.config, env)


def test_who_is_refused_leaves_no_folder(tmp_path: Path) -> None:
    config = compose(["env=forest", "level=1", "level.map_seed=4711", "curriculum=taught"])
    with pytest.raises(ConfigError, match="srlrace bound --demonstrate"):
        train(config, tmp_path)
    assert not list(tmp_path.iterdir())


def test_many_maps_cannot_be_taught() -> None:
    with pytest.raises(ConfigError, match="100 maps"):
        compose([*SMALL, "level=mixed"])
