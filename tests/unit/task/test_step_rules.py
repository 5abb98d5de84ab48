"""What ends a step and an episode: passing and collision at racing speed, bounds, horizon, broken states."""

import dataclasses
import itertools

import numpy as np
import pytest

from srlrace.config import ObstacleConfig
from srlrace.task.arrays import CRASHED, DIVERGED, FINISHED, FLYING, MIN_CLEARANCE, OUT_OF_BOUNDS, TIMEOUT

DT = 0.02  # s, conf/train.yaml
FAST = 25.0  # m/s, half a metre a step
D_SAFE = 0.25  # m between a surface and the drone's centre: arm 0.15, margin 0.1
FIRST = np.array([-20.0, 0.0, 1.12])  # the Forest's first waypoint
LAST = np.array([20.0, 0.0, 1.12])


@pytest.fixture(scope="module")
def plain(config):
    return config("level=none", "randomization=none")


def ball_entry(start, velocity, centre, radius):
    """Time at which a straight flight enters a ball."""
    m = centre - start
    u = velocity / np.linalg.norm(velocity)
    along = m @ u
    return (along - np.sqrt(radius**2 - (m @ m - along**2))) / np.linalg.norm(velocity)


def test_a_waypoint_between_two_samples_is_passed_at_the_right_time(plain, flown, place_drones, hover):
    """0.29 m beside the centre: the ball is cut for 0.15 m of a step of 0.5 m, wherever the samples fall."""
    shift = np.linspace(0.1, 0.4, 13)  # m of the second step before the centre
    race = flown(plain, 13)
    start = FIRST + np.stack([-0.5 - shift, np.full(13, 0.29), np.zeros(13)], axis=1)
    place_drones(race, start, (FAST, 0, 0))
    ends = start[:, 0, None] + FAST * DT * np.arange(3)
    assert (np.hypot(ends - FIRST[0], 0.29) > 0.3).all()
    assert (race.step(hover(13)).outcome == FLYING).all()
    assert (race.fleet.target == 0).all()
    race.step(hover(13))
    assert (race.fleet.target == 1).all()
    expected = [ball_entry(p, np.array([FAST, 0, 0]), FIRST, 0.3) for p in start]
    np.testing.assert_allclose(race.fleet.passing_time[0], expected, atol=2e-6)


def test_a_near_miss_is_no_passing(plain, flown, place_drones, hover):
    race = flown(plain, 50)
    start = FIRST + np.stack([-np.linspace(0.5, 1.0, 50), np.full(50, 0.301), np.zeros(50)], axis=1)
    place_drones(race, start, (FAST, 0, 0))
    for _ in range(4):
        race.step(hover(50))
    assert (race.fleet.state[0] > -20).all()
    assert (race.fleet.target == 0).all()


def test_only_the_target_counts(plain, flown, place_drones, hover):
    race = flown(plain, 1)
    place_drones(race, LAST - [0.2, 0, 0], (FAST, 0, 0), target=0)
    race.step(hover(1))
    assert race.fleet.target[0] == 0


def test_the_finish_is_timed_within_the_step(plain, flown, place_drones, hover):
    race = flown(plain, 1)
    place_drones(race, LAST - [1.3, 0.1, 0], (FAST, 0, 0), target=8)
    while race.step(hover(1)).outcome[0] == FLYING:
        pass
    assert race.output.outcome[0] == FINISHED
    expected = ball_entry(LAST - [1.3, 0.1, 0], np.array([FAST, 0, 0]), LAST, 0.3)
    assert race.output.time[0] == pytest.approx(expected, abs=2e-6)
    assert race.output.final_passing_time[8, 0] == pytest.approx(expected, abs=2e-6)
    assert race.output.final_target[0] == 9


SHAPES = (
    ObstacleConfig("sphere", (0.0, 0.0, 4.0), radius=0.05),
    ObstacleConfig("cylinder", (0.9, 0.4, 4.0), radius=0.02, height=3.0),
    ObstacleConfig("box", (-0.5, -0.9, 4.2), edge=0.4),
)


def test_a_collision_is_a_swept_distance_below_d_safe(with_obstacles, flown, place_drones, hover, spheres):
    """Chords of half a metre in all directions around a thin pole, a small ball and a box, against dense sampling."""
    n = 700
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(n, 3))
    velocity = FAST * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    middle = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.9, 0.9, (n, 3))
    race = flown(with_obstacles(*SHAPES), n)
    place_drones(race, middle - velocity * DT / 2, velocity)
    before = race.fleet.state[:3].T.astype(float)
    out = race.step(hover(n))
    after = race.fleet.state[:3].T.astype(float)
    assert np.linalg.norm(after - before, axis=1) == pytest.approx(FAST * DT, rel=1e-4)
    truth = spheres(race, 0)
    share = np.linspace(0, 1, 101)[:, None]
    gap = np.array([truth.gap(a + share * (b - a)) for a, b in zip(before, after, strict=True)])
    clear = np.abs(gap - D_SAFE) > 1e-4  # the sampled minimum lies up to that much above the true one
    assert clear.sum() > 0.97 * n
    assert 60 < (gap < D_SAFE).sum() < n - 60
    np.testing.assert_array_equal(out.outcome[clear] == CRASHED, gap[clear] < D_SAFE)
    ends = np.array([min(truth.gap(a), truth.gap(b)) for a, b in zip(before, after, strict=True)])
    assert ((ends > D_SAFE) & (out.outcome == CRASHED)).sum() >= 5  # collisions that sampled ends would miss
    close = gap < 1.0  # m; farther away the step's end is reported, unswept
    np.testing.assert_allclose(out.clearance[close], gap[close] - 0.15, atol=1e-4)
    np.testing.assert_array_equal(
        race.output.final_tally[MIN_CLEARANCE, out.outcome > 0], out.clearance[out.outcome > 0]
    )


@pytest.mark.parametrize(("spare", "outcome"), [(0.01, FLYING), (-0.01, CRASHED)])
def test_a_thin_gap(with_obstacles, flown, place_drones, hover, spare, outcome):
    """Between two poles, the surfaces 2 (d_safe + spare) apart, the samples anywhere."""
    radius, height = 0.1, 4.025  # the middle of the layer of spheres nearest to 4 m
    away = radius + D_SAFE + spare
    poles = [ObstacleConfig("cylinder", (0.0, side * away, 4.0), radius=radius, height=4.0) for side in (-1.0, 1.0)]
    race = flown(with_obstacles(*poles), 40)
    start = np.stack([-np.linspace(0.6, 1.1, 40), np.zeros(40), np.full(40, height)], axis=1)
    place_drones(race, start, (FAST, 0, 0))
    ended = np.zeros(40, bool)
    for _ in range(5):
        ended |= race.step(hover(40)).outcome == CRASHED
    assert (ended == (outcome == CRASHED)).all()
    assert outcome == CRASHED or (race.fleet.state[0] > 1).all()


def test_the_margin_is_a_setting(with_obstacles, flown, place_drones, hover):
    ball = ObstacleConfig("sphere", (0.0, 0.0, 4.0), radius=0.3)
    for margin, outcome in ((0.0, FLYING), (0.2, CRASHED)):
        race = flown(with_obstacles(ball, safety_margin=margin), 1)
        place_drones(race, (0, 0.6, 4))
        assert race.step(hover(1)).outcome[0] == outcome


def test_leaving_the_world(plain, flown, place_drones, hover):
    low, high = np.array(plain.env.bounds_low), np.array(plain.env.bounds_high)
    places = np.tile((low + high) / 2, (12, 1))
    velocity = np.zeros((12, 3))
    for axis in range(3):
        for k, (bound, side) in enumerate(((low, -1), (high, 1))):
            leaving, staying = 4 * axis + 2 * k, 4 * axis + 2 * k + 1
            places[[leaving, staying], axis] = bound[axis] - side * np.array([0.09, 0.11])
            velocity[[leaving, staying], axis] = side * 5.0  # 0.1 m a step
    race = flown(plain, 12)
    place_drones(race, places, velocity)
    out = race.step(hover(12))
    assert out.outcome.tolist() == [OUT_OF_BOUNDS, FLYING] * 6


def test_the_horizon_is_neither_crash_nor_success(plain, flown, place_drones, hover):
    short = dataclasses.replace(plain, env=dataclasses.replace(plain.env, horizon=0.2))
    race = flown(short, 3)
    for step in range(1, 11):
        out = race.step(hover(3))
        assert (out.outcome == (TIMEOUT if step == 10 else FLYING)).all()
    assert out.reward_terms[[3, 4, 5]].tolist() == [[0.0] * 3] * 3
    assert out.time == pytest.approx(0.2)


def test_finishing_in_the_last_step_is_finishing(plain, flown, place_drones, hover):
    short = dataclasses.replace(plain, env=dataclasses.replace(plain.env, horizon=DT))
    race = flown(short, 1)
    place_drones(race, LAST - [0.5, 0, 0], (FAST, 0, 0), target=8)
    assert race.step(hover(1)).outcome[0] == FINISHED


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("mode", ["evaluation", "training"])
def test_a_broken_state_ends_its_own_episode_alone(config, flown, trained, value, mode):
    """Drone 3 + row gets a bad value in that row of its state; all others must not change by a bit."""
    settings = config("level=1", "curriculum=none")
    make = flown if mode == "evaluation" else trained
    broken, sound = make(settings, 40), make(settings, 40)
    victims = 3 + np.arange(17)
    others = np.setdiff1d(np.arange(40), victims)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 40, 4)).astype(np.float32)
    for k, action in enumerate(actions):
        if k == 5:
            broken.fleet.state[np.arange(17), victims] = value
        a, b = broken.step(action), sound.step(action)
        if k == 5:
            assert (a.outcome[victims] == DIVERGED).all()
            assert (a.reward_terms[3, victims] == broken.rules.weights[3]).all()
            assert np.isfinite(a.terminal_observation[victims]).all()
        for name in ("observation", "reward", "outcome", "clearance"):
            np.testing.assert_array_equal(getattr(a, name)[others], getattr(b, name)[others])
        for array in (a.observation, a.reward, a.reward_terms, broken.fleet.state, broken.fleet.tally, a.ledger):
            assert np.isfinite(array).all()
    np.testing.assert_array_equal(broken.fleet.state[:, others], sound.fleet.state[:, others])


def test_an_action_that_is_no_number_ends_the_episode(config, flown):
    settings = config("level=1")
    broken, sound = flown(settings, 6), flown(settings, 6)
    action = np.zeros((6, 4), np.float32)
    bad = action.copy()
    bad[np.arange(4), np.arange(4)] = np.nan
    a, b = broken.step(bad), sound.step(action)
    assert a.outcome.tolist() == [DIVERGED] * 4 + [FLYING] * 2
    assert np.isfinite(a.terminal_observation).all()
    np.testing.assert_array_equal(a.observation[4:], b.observation[4:])


def test_actions_are_clipped(config, flown):
    races = [flown(config("level=1"), 5) for _ in range(2)]
    action = np.random.default_rng(0).uniform(-4, 4, (5, 4)).astype(np.float32)
    action[0] = [np.inf, -np.inf, np.inf, 0]
    a, b = races[0].step(action), races[1].step(np.clip(action, -1, 1))
    np.testing.assert_array_equal(a.observation, b.observation)
    assert (a.outcome == FLYING).all()


@pytest.mark.parametrize(("track", "gates"), [("forest", list(range(9))), ("split_s", [*range(7), 0])])
def test_a_whole_course_flown(config, flown, pilot, track, gates):
    """Passing times of a flight against its path, searched for the balls in their order, 100 points a step."""
    race = flown(config(f"env={track}", "level=none", "randomization=none"), 1)
    path = [race.fleet.state[:3, 0].astype(float)]
    observation = race.output.observation
    while race.step(pilot(observation)).outcome[0] == FLYING:
        path.append(race.fleet.state[:3, 0].astype(float))
    path.append(race.fleet.state[:3, 0].astype(float))
    assert race.output.outcome[0] == FINISHED
    fine = np.concatenate([np.linspace(a, b, 100, endpoint=False) for a, b in itertools.pairwise(path)])
    assert race.rules.sequence.tolist() == gates
    at, times = 0, []
    for gate in gates:
        inside = np.linalg.norm(fine[at:] - race.config.env.waypoints[gate], axis=1) <= 0.3
        at += int(np.argmax(inside))
        times.append(at * DT / 100)
    np.testing.assert_allclose(race.output.final_passing_time[:, 0], times, atol=3e-4)
    assert race.output.time[0] == pytest.approx(times[-1], abs=3e-4)
    assert race.output.final_tally[2, 0] == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum(), rel=1e-5)


def test_a_parked_drone_stays(config, flown, place_drones, hover):
    race = flown(config("level=none", "randomization=none"), 2)
    place_drones(race, [[0, 0, 4], [0, 0, 0.05]], [[0, 0, 0], [0, 0, -5]])
    outcomes = [race.step(hover(2)).outcome.tolist() for _ in range(5)]
    assert outcomes == [[FLYING, OUT_OF_BOUNDS]] * 5
    assert race.fleet.steps.tolist() == [5, 1]
    assert race.take_ledger()["episodes"] == 1
