"""Distances of a flight from obstacles, and which of its points the solver must keep away from which of them.

To the solver an obstacle is the box that the centres of its spheres span, rounded by their radius: smooth, and never
smaller than the spheres. What is accepted is judged by the spheres themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import Array
from srlrace.world.obstacles import Obstacle

SHARES = tuple(k / 8 for k in range(8))  # of an interval: where points are kept clear; 0.05 m apart at 15 m/s
NEAR = 0.1  # m: points this close to violating are constrained along with those that do


class Point(NamedTuple):
    """A point of the flight that is to be kept clear of an obstacle."""

    interval: int
    share: int  # index into SHARES
    obstacle: int


def weights(share: float) -> tuple[float, float, float, float]:
    """Cubic Hermite weights of (p0, h v0, p1, h v1) at a share of an interval; its error is below 0.01 mm."""
    s = share
    return 1 - 3 * s**2 + 2 * s**3, s - 2 * s**2 + s**3, 3 * s**2 - 2 * s**3, s**3 - s**2


def points(state: Array, steps: Array) -> Array:
    """Positions (n, shares, 3) of all points that can be constrained; state (n + 1, >= 6), steps (n,) s."""
    p, v, h = state[:, :3], state[:, 3:6], steps[:, None]
    rows = [a * p[:-1] + b * h * v[:-1] + c * p[1:] + d * h * v[1:] for a, b, c, d in map(weights, SHARES)]
    return np.stack(rows, axis=1)


def core(obstacle: Obstacle) -> tuple[Array, Array]:
    """Lower and upper corner of the box of sphere centres, m."""
    low = np.array(obstacle.origin)
    return low, low + np.array(obstacle.pitch) * (np.array(obstacle.count) - 1)


def core_distance(obstacle: Obstacle, at: Array) -> Array:
    """Distance from positions (..., 3) to the box of an obstacle's sphere centres, m."""
    low, high = core(obstacle)
    return np.linalg.norm(at - np.clip(at, low, high), axis=-1)


def violated(problem: Problem, state: Array, steps: Array, margin: float) -> tuple[set[Point], float]:
    """Return the points to keep clear, those of obstacles that are too close, and by how much the worst is, m."""
    at, found, worst = points(state, steps), set[Point](), 0.0
    for index, obstacle in enumerate(problem.obstacles):
        gap = core_distance(obstacle, at) - obstacle.sphere_radius - problem.keep_out - margin
        worst = max(worst, -float(gap.min()))
        if gap.min() < 0:
            found |= {Point(int(k), int(s), index) for k, s in zip(*np.nonzero(gap < NEAR), strict=True)}
    return found, worst


def smallest_gap(problem: Problem, path: Array) -> float:
    """Smallest distance of a polyline (m, 3) from any obstacle's spheres' surfaces, m; inf without obstacles."""
    start, chord = path[:-1], np.diff(path, axis=0)
    gap = np.inf
    for obstacle in problem.obstacles:
        near = core_distance(obstacle, start) < obstacle.sphere_radius + 1.0
        if near.any():
            gap = min(
                gap, float(_distances(obstacle.spheres(), start[near], chord[near]).min()) - obstacle.sphere_radius
            )
    return gap


def _distances(centres: Array, start: Array, chord: Array) -> Array:
    """Distances (m, c) of chords from points."""
    length = np.maximum(np.sum(chord * chord, axis=1), 1e-300)
    offset = centres[None] - start[:, None]
    share = np.clip(np.einsum("mci,mi->mc", offset, chord) / length[:, None], 0, 1)
    return np.linalg.norm(offset - share[..., None] * chord[:, None], axis=2)
