"""The model, written twice: as symbols for the solver and in numpy for its judge; and the geometry between nodes."""

import shutil

import numpy as np
import pytest

from srlrace.bound.clearance import SHARES, core_distance, points, smallest_gap
from srlrace.bound.model import COMPILER, STEPS, point_mass, quick_body, rigid_body
from srlrace.bound.problem import problem_of
from srlrace.bound.trajectory import NODES, Trajectory, between_nodes, lift, rotations
from srlrace.hydra_bridge import compose
from srlrace.world.obstacles import box, cylinder, sphere


def random_flight(problem, seed=0, step=0.02):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(NODES + 1, 13)) * ([1.0] * 3 + [8.0] * 3 + [1.0] * 4 + [3.0] * 3)
    state[:, 6:10] /= np.linalg.norm(state[:, 6:10], axis=1, keepdims=True)
    return Trajectory(state, rng.uniform(0, problem.quad.thrust_max, (NODES, 4)), np.array([step]))


@pytest.mark.parametrize("drag_model", ["acceleration", "force"])
def test_symbols_and_numpy_move_alike(drag_model):
    problem = problem_of(compose(["env=forest", "level=none", f"quad.drag_model={drag_model}"]))
    flight = random_flight(problem)
    step = rigid_body(problem).step
    moved = np.array([step(x, u, 0.02).full().ravel() for x, u in zip(flight.state, flight.thrust, strict=False)])
    assert between_nodes(problem, flight, STEPS)[:, -1] == pytest.approx(moved, abs=1e-11)


def test_a_quaternion_of_any_length_gives_no_more_thrust():
    """Without q/|q| in the rotation, twice the quaternion would be four times the thrust."""
    problem = problem_of(compose(["env=forest", "level=none"]))
    step = rigid_body(problem).step
    one, two = (step([0] * 6 + [norm, 0, 0, 0] + [0] * 3, [5.0] * 4, 0.01).full().ravel() for norm in (1, 2))
    assert two[:6] == pytest.approx(one[:6])


@pytest.mark.skipif(shutil.which(COMPILER) is None, reason="no C compiler")
def test_the_compiled_model_is_the_interpreted_one():
    problem = problem_of(compose(["env=forest", "level=none"]))
    flight, slow = random_flight(problem), rigid_body(problem).step
    with quick_body(problem) as body:
        for x, u in zip(flight.state[:3], flight.thrust, strict=False):
            assert body.step(x, u, 0.02).full() == pytest.approx(slow(x, u, 0.02).full(), rel=1e-12)


def test_without_a_compiler_the_model_is_interpreted(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    problem = problem_of(compose(["env=forest", "level=none"]))
    with quick_body(problem) as body:
        assert body.step([0] * 6 + [1] + [0] * 6, [0] * 4, 0.1).full()[5, 0] < -0.9


def test_rotations_are_scipys():
    from scipy.spatial.transform import Rotation

    q = np.random.default_rng(1).normal(size=(20, 4))
    assert rotations(q) == pytest.approx(Rotation.from_quat(q, scalar_first=True).as_matrix())


def test_the_lifted_guess_thrusts_along_the_point_masss_force():
    problem = problem_of(compose(["env=forest", "level=none"]))
    rng = np.random.default_rng(2)
    force = np.vstack([rng.normal(size=(NODES - 2, 3)) * 10, [[0, 0, -9.0], [0.0, 0.0, 9.81]]])
    lifted = lift(problem.quad.mass, np.zeros((NODES + 1, 6)), force, np.array([0.02]))
    along = rotations(lifted.state[:-1, 6:10])[:, :, 2] * lifted.thrust.sum(axis=1, keepdims=True) / problem.quad.mass
    assert along == pytest.approx(force, abs=1e-9)


def test_the_point_mass_falls_and_is_slowed():
    problem = problem_of(compose(["env=forest", "level=none"]))
    x = point_mass(problem).step([0, 0, 0, 10, 0, 0], [0, 0, 0], 0.1).full().ravel()
    assert x[3] == pytest.approx(10 * np.exp(-0.026), rel=1e-6)
    assert x[5] == pytest.approx(-9.81 * (1 - np.exp(-0.026)) / 0.26, rel=1e-6)


def test_points_between_nodes_are_on_the_flight():
    problem = problem_of(compose(["env=forest", "level=none"]))
    flight = random_flight(problem, 3, 0.02)
    fine = between_nodes(problem, flight, len(SHARES))
    whole = Trajectory(np.vstack([fine[:1, 0], fine[:1, -1]]), flight.thrust[:1], np.array([0.02]))
    assert points(whole.state, np.array([0.02]))[0] == pytest.approx(fine[0, :-1, :3], abs=1e-4)


def test_the_solvers_obstacles_hold_the_races():
    """The rounded box is never smaller than the spheres, and the gap of a path is that of enumerated spheres."""
    rng = np.random.default_rng(4)
    for obstacle in (sphere((0, 0, 0), 0.5), cylinder((0, 0, 0), 0.4, 3.0), box((0, 0, 0), 1.0)):
        at = rng.uniform(-2, 2, (300, 3))
        nearest = np.linalg.norm(at[:, None] - obstacle.spheres()[None], axis=2).min(axis=1)
        assert (core_distance(obstacle, at) <= nearest + 1e-12).all()
        problem = problem_of(compose(["env=forest", "level=none"]))
        object.__setattr__(problem, "obstacles", (obstacle,))
        path = np.array([[-1.0, 0.9, 0.3], [1.0, 0.8, -0.2]])
        fine = path[0] + np.linspace(0, 1, 2001)[:, None] * (path[1] - path[0])
        exact = np.linalg.norm(fine[:, None] - obstacle.spheres()[None], axis=2).min() - obstacle.sphere_radius
        assert smallest_gap(problem, path) == pytest.approx(exact, abs=1e-5)
