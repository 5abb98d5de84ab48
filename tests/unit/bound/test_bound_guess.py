"""First guesses along a clear path: a flight that the rigid body could nearly fly, past everything in its way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from srlrace.bound.clearance import smallest_gap
from srlrace.bound.guess import piloted
from srlrace.bound.problem import problem_of
from srlrace.bound.trajectory import NODES, lift
from srlrace.hydra_bridge import compose
from srlrace.world.flyable import clear_path


@pytest.fixture(scope="module")
def guessed():
    config = compose(["env=forest", "level=3"])
    problem = problem_of(config)
    path = clear_path(config.env, problem.obstacles, problem.keep_out)
    return problem, path, piloted(problem, path)


def test_it_passes_every_waypoint_and_touches_nothing(guessed):
    problem, _, nodes = guessed
    ends = nodes.state[NODES::NODES, :3]
    assert np.linalg.norm(ends - np.array(problem.waypoints), axis=1).max() <= problem.passing_radius
    assert smallest_gap(problem, nodes.state[:, :3]) > problem.keep_out
    assert nodes.state[0, :7] == pytest.approx([*problem.start, 0, 0, 0, 1])


def test_its_velocities_and_rates_are_those_of_its_motion(guessed):
    problem, _, nodes = guessed
    h, state = nodes.steps[:, None], nodes.state
    moved = np.diff(state[:, :3], axis=0)
    assert moved[1:] == pytest.approx((0.5 * h * (state[1:, 3:6] + state[:-1, 3:6]))[1:], abs=0.03)
    turns = Rotation.from_quat(state[:, 6:10], scalar_first=True)
    rates = (turns[:-1].inv() * turns[1:]).as_rotvec() / h
    slow = np.abs(rates).max(axis=1) < 1.5
    assert slow.sum() > 30
    assert state[1:, 10:13][slow] == pytest.approx(rates[slow], abs=0.02)
    assert (np.abs(state[:, 10:13]) <= np.array(problem.quad.body_rate_max)).all()
    assert nodes.control.min() >= 0
    assert nodes.control.max() <= problem.quad.thrust_max * (1 + 1e-9)


def test_a_path_that_misses_a_waypoint_is_no_guess(guessed):
    problem, path, _ = guessed
    elsewhere = [leg + [0.0, 0.0, 1.0] for leg in path]
    with pytest.raises(ValueError, match="misses a waypoint"):
        piloted(problem, elsewhere)


@pytest.mark.parametrize("turns", [1, -1, 2])
def test_a_lifted_lap_turns_its_nose_and_not_its_thrust(turns):
    force = np.random.default_rng(0).normal(0.0, 5.0, (4 * NODES, 3)) + [0.0, 0.0, 9.81]
    mass, state, step = 0.75, np.zeros((len(force) + 1, 6)), np.full(4, 0.03)
    straight, turned = (lift(mass, state, force, step, n) for n in (0, turns))
    nose, level = (Rotation.from_quat(flight.state[:, 6:10], scalar_first=True) for flight in (turned, straight))
    assert turned.thrust == pytest.approx(straight.thrust)
    assert np.linalg.norm(turned.state[:, 6:10], axis=1) == pytest.approx(1)
    angles = 2 * np.pi * turns * np.linspace(0.0, 1.0, len(state))
    assert (level.inv() * nose).as_matrix() == pytest.approx(
        Rotation.from_euler("z", angles[:, None]).as_matrix(), abs=1e-9
    )
