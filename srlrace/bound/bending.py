"""A flight that can give way: its copies, bent to where waypoints may be displaced to, touch few obstacles.

The fastest way past an obstacle, with all waypoints in their places, may be one that leads into it as soon as one of
them is displaced, where another way is hardly slower and stays open. So the obstacles that bent copies touch are grown,
one after the other, and the solver moves away from them or takes another way.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from srlrace.bound.accept import Rejected
from srlrace.bound.clearance import core_distance, points, violated
from srlrace.bound.model import Model
from srlrace.bound.problem import Problem
from srlrace.bound.solver import COARSE, settle
from srlrace.bound.transcription import Nodes

COPIES = 200  # displacements drawn for each waypoint
EVERY = 2  # of the points along the flight: 0.2 m apart at 15 m/s
GROWTH = 0.15  # m, of an obstacle's radius: ours
ALONG = 0.6  # m: a grown obstacle that is closer to the flight than this is kept clear from the beginning
RARELY = 0.02  # an obstacle that fewer of any waypoint's copies touch is left as it is
SLOWER = 1.02  # a flight takes at most that many times as long as the one it came from
logger = logging.getLogger(__name__)


def bend(problem: Problem, body: Model, nodes: Nodes, displacement: float, min_height: float) -> Nodes:
    """Return a solution near ``nodes`` whose bent copies touch fewer obstacles, if there is one.

    Waypoints are displaced by up to ``displacement`` m per axis, and stay ``min_height`` m above the floor.
    """
    touched = touching(problem, nodes, displacement, min_height)
    grown, untried, slowest = problem, set(range(len(problem.obstacles))), SLOWER * nodes.duration
    while untried:
        most = touched.mean(axis=1).max(axis=0)
        index = max(untried, key=lambda k: (most[k], k))
        if most[index] < RARELY:
            break
        untried.remove(index)
        larger = grow(grown, index)
        near = violated(larger, nodes.state, nodes.steps, ALONG)[0]
        try:
            found = settle(larger, body, nodes, {p for p in near if p.obstacle == index or p.share % COARSE == 0})
        except Rejected as failure:
            logger.info("more room from obstacle %d: no such flight (%s)", index, failure)
            continue
        after = touching(problem, found, displacement, min_height)
        before, now = (hits.any(axis=2).mean() for hits in (touched, after))
        logger.info(
            "more room from obstacle %d: %.3f s, %.1f %% of displacements are in the way, %.1f %% before",
            index, found.duration, 100.0 * now, 100.0 * before,
        )  # fmt: skip
        if now < before and found.duration < slowest:
            nodes, touched, grown = found, after, larger
    return nodes


def grow(problem: Problem, index: int) -> Problem:
    """The problem with one of its obstacles larger by `GROWTH`."""
    solids = list(problem.obstacles)
    solids[index] = replace(solids[index], sphere_radius=solids[index].sphere_radius + GROWTH)
    return replace(problem, obstacles=tuple(solids))


def touching(problem: Problem, nodes: Nodes, displacement: float, min_height: float) -> NDArray[np.bool_]:
    """Which bent copies come too close to which obstacles: (waypoints, copies, obstacles).

    A copy leaves the flight at one waypoint, goes smoothly to where the next is displaced to, and returns by the one
    after that.
    """
    path = points(nodes.state, nodes.steps)[:, ::EVERY].reshape(-1, 3)
    each = len(path) // len(problem.waypoints)
    rise = np.arange(each) / each
    rise = rise**2 * (3.0 - 2.0 * rise)
    drawn = displacement * np.random.default_rng(0).uniform(-1.0, 1.0, (COPIES, 1, 3))
    found = np.zeros((len(problem.waypoints), COPIES, len(problem.obstacles)), np.bool_)
    for k, waypoint in enumerate(problem.waypoints):
        part = path[k * each : (k + 2) * each]
        share = np.append(rise, 1.0 - rise)[: len(part), None]
        offset = drawn.copy()
        offset[:, :, 2] = np.maximum(offset[:, :, 2], min_height - waypoint[2])
        copies = part + share * offset
        for j, obstacle in enumerate(problem.obstacles):
            reach = obstacle.sphere_radius + problem.keep_out
            found[k, :, j] = (core_distance(obstacle, copies) < reach).any(axis=1)
    return found
