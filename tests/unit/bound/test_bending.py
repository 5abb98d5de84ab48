"""Flights that give way: which bent copies touch what, and a flight that touches less."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from srlrace.bound.bending import COPIES, GROWTH, grow, touching
from srlrace.bound.problem import problem_of
from srlrace.bound.trajectory import NODES
from srlrace.bound.transcription import Nodes
from srlrace.hydra_bridge import compose
from srlrace.world.obstacles import sphere

CONFIG = compose(["env=forest", "level=none", "env.waypoints=[[-15,0,5],[-5,0,5]]"])


def problem(*obstacles):
    return dataclasses.replace(problem_of(CONFIG, "race"), obstacles=obstacles, keep_out=0.25)


def straight():
    """At 10 m/s along y = 0, z = 5, from 10 m before the first waypoint to the second."""
    at = np.linspace(-25.0, -5.0, 2 * NODES + 1)
    still = np.zeros_like(at)
    state = np.column_stack([at, still, still + 5.0, still + 10.0, still, still])
    return Nodes(state, np.zeros((2 * NODES, 3)), np.full(2, 1.0 / NODES))


def test_only_copies_that_are_bent_towards_an_obstacle_touch_it():
    found = touching(problem(sphere((-15.0, 1.0, 5.0), 0.25)), straight(), 1.0, 0.3)
    assert found.shape == (2, COPIES, 1)
    offset = np.random.default_rng(0).uniform(-1.0, 1.0, (COPIES, 3))
    reach = 0.5  # radius and keep-out; bent in x, the copy is there a little earlier
    surely = np.hypot(offset[:, 1] - 1.0, offset[:, 2]) < reach - 0.05
    maybe = np.hypot(offset[:, 1] - 1.0, offset[:, 2]) < reach + 0.05
    assert 5 < surely.sum() < COPIES / 5
    assert (found[0, surely, 0]).all()
    assert not found[0, ~maybe, 0].any()
    assert not found[1].any()  # from the first waypoint to where the second is displaced to: past it


def test_a_copy_comes_back_by_the_waypoint_after():
    beyond = touching(problem(sphere((-5.0, 0.6, 5.0), 0.1)), straight(), 1.0, 0.3)
    assert not beyond[0].any()
    assert beyond[1].any()


def test_waypoints_are_not_displaced_below_their_least_height():
    floor = sphere((-15.0, 0.0, 3.6), 0.4)  # its top is 1 m below the flight
    assert touching(problem(floor), straight(), 1.0, 0.3)[0].any()
    assert not touching(problem(floor), straight(), 1.0, 4.9)[0].any()


def test_nothing_is_touched_where_nothing_is_displaced():
    assert not touching(problem(sphere((-15.0, 1.0, 5.0), 0.25)), straight(), 0.0, 0.3).any()


def test_one_obstacle_grows():
    before = problem(sphere((0, 1, 2), 0.5), sphere((3, 1, 2), 0.5))
    after = grow(before, 1)
    assert [o.sphere_radius for o in after.obstacles] == [0.5, 0.5 + GROWTH]
    assert [o.sphere_radius for o in before.obstacles] == [0.5, 0.5]


def test_a_bent_flight_touches_less_and_takes_hardly_longer():
    pytest.importorskip("casadi", reason="the extra srlrace[bound] is not installed")
    from srlrace.bound.bending import SLOWER, bend
    from srlrace.bound.clearance import violated
    from srlrace.bound.guess import follow, straight_legs
    from srlrace.bound.model import point_mass
    from srlrace.bound.solver import settle

    posed = problem(sphere((-20.0, 0.1, 3.3), 0.3), sphere((-10.0, 0.4, 5.0), 0.3))
    mass = point_mass(posed)
    first = settle(posed, mass, follow(posed, straight_legs(posed, 0), 0), set())
    bent = bend(posed, mass, first, 0.5, 0.3)
    assert touching(posed, first, 0.5, 0.3).any(axis=2).mean() > touching(posed, bent, 0.5, 0.3).any(axis=2).mean()
    assert first.duration < bent.duration < SLOWER * first.duration
    assert violated(posed, bent.state, bent.steps, 0.0)[1] <= 0.0
