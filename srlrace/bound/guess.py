"""First guesses: a point that follows a polyline at constant speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import NODES, Array
from srlrace.bound.transcription import Nodes
from srlrace.sim.airframe import GRAVITY

SPEED = 6.0  # m/s; the restarts vary it by a factor of up to 1.5
DETOUR = 1.5  # m, standard deviation of where the restarts bend the straight legs


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
