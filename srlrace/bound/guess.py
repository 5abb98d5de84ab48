"""First guesses: a point that follows a polyline at constant speed, and a pilot's flight along one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import NODES, Array, lift
from srlrace.bound.transcription import Nodes
from srlrace.sim.airframe import GRAVITY
from srlrace.task.pilot import plan

SPEED = 6.0  # m/s; the restarts vary it by a factor of up to 1.5
DETOUR = 1.5  # m, standard deviation of where the restarts bend the straight legs
PACE = 1.0  # of the pilot: the first that certificates are flown at
TICK = 0.01  # s, at which the pilot's flight is sampled


def straight_legs(problem: Problem, restart: int) -> list[Array]:
    """One polyline (2 or 3, 3) for each segment: straight in the first restart, bent at random in later ones."""
    stops = np.array([problem.start or problem.waypoints[-1], *problem.waypoints])
    if restart == 0:
        return [stops[i : i + 2] for i in range(len(stops) - 1)]
    bends = np.random.default_rng(restart).normal(0.0, DETOUR, (len(stops) - 1, 3)) * [1.0, 1.0, 0.3]
    middles = np.clip(0.5 * (stops[1:] + stops[:-1]) + bends, problem.bounds_low, problem.bounds_high)
    return [np.stack([a, m, b]) for a, m, b in zip(stops[:-1], middles, stops[1:], strict=True)]


def follow(problem: Problem, legs: Sequence[Array], restart: int = 0) -> Nodes:
    """Nodes of a point mass that follows one polyline a segment, in hover thrust."""
    speed = SPEED * 1.5 ** ((restart % 3) - 1 if restart else 0)
    states, step = [], []
    for leg in legs:
        chords = np.linalg.norm(np.diff(leg, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(chords)])
        length = max(float(along[-1]), 0.5)
        at = np.linspace(0.0, along[-1], NODES + 1)
        places = np.stack([np.interp(at, along, leg[:, axis]) for axis in range(3)], axis=1)
        duration = length / speed
        step.append(duration / NODES)
        states.append(np.hstack([places, np.gradient(places, duration / NODES, axis=0)]))
    joined = np.vstack([states[0][:1], *(state[1:] for state in states)])
    if problem.start is not None:
        joined[0, 3:] = 0.0
    return Nodes(joined, np.tile([0.0, 0.0, GRAVITY], (len(joined) - 1, 1)), np.array(step))


def piloted(problem: Problem, legs: Sequence[Array]) -> Nodes:
    """Nodes of the rigid body on a pilot's flight along one polyline (k, 3), m, a segment: rounded and flyable.

    Raises ValueError where the rounded flight cuts off more of a waypoint than its ball holds.
    """
    flight = plan(legs, PACE, TICK)
    parts, step, here = [], [], 0
    for waypoint in problem.waypoints:
        there = here + _nearest(flight[here:, :3], np.array(waypoint), problem.passing_radius)
        at = np.linspace(here, there, NODES + 1)
        ticks = np.arange(here, there + 1)
        parts.append(np.stack([np.interp(at, ticks, column) for column in flight[here : there + 1].T], axis=1))
        step.append((there - here) * TICK / NODES)
        here = there
    joined = np.vstack([parts[0][:1], *(part[1:] for part in parts)])
    joined[0, :6] = [*legs[0][0], 0.0, 0.0, 0.0]
    return _rigid(problem, joined, np.array(step))


def _nearest(places: Array, waypoint: Array, reach: float) -> int:
    """Index of the first of a flight's approaches to a waypoint that comes within reach of it."""
    away = np.linalg.norm(places - waypoint, axis=1)
    if away.min() > reach:
        raise ValueError(f"the rounded path misses a waypoint by {away.min():.2f} m")
    entry = int(np.argmax(away <= reach))
    leaving = np.flatnonzero(away[entry:] > reach)
    inside = away[entry : entry + int(leaving[0])] if len(leaving) else away[entry:]
    return max(1, entry + int(np.argmin(inside)))


def _rigid(problem: Problem, flown: Array, step: Array) -> Nodes:
    """Turn positions, velocities and accelerations (n + 1, 9) into states and thrusts within their limits."""
    force = flown[:-1, 6:9] + [0.0, 0.0, GRAVITY] + float(problem.drag.mean()) * flown[:-1, 3:6]
    size = np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-6)
    force *= np.minimum(1.0, problem.max_collective / size)
    guess = lift(problem.quad.mass, flown[:, :6], force, step)
    q, limit = guess.state[:, 6:10], np.array(problem.quad.body_rate_max)
    w, v = q[:-1, :1], -q[:-1, 1:]  # the turn from one node to the next is conj(q) * next
    turn = w * q[1:, 1:] + q[1:, :1] * v + np.cross(v, q[1:, 1:])
    guess.state[1:, 10:13] = np.clip(2 * turn / np.repeat(step, NODES)[:, None], -limit, limit)
    guess.state[0, 3:] = [0.0] * 3 + [1.0] + [0.0] * 6
    return Nodes(guess.state, guess.thrust, step)
