"""Solving a time-optimal problem: several starts, a point mass first, obstacles only where they are in the way."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from srlrace.bound.accept import Rejected, accept
from srlrace.bound.clearance import Point, violated
from srlrace.bound.guess import follow, straight_legs
from srlrace.bound.model import Model, point_mass, rigid_body
from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import Array, Reference, Trajectory, lift
from srlrace.bound.transcription import MARGIN, Nodes, solve

ROUNDS = 15  # of adding the constraints that a solution violates
SCOUTS = 3  # point masses sent: for each rigid body where obstacles leave several ways, at least so many where not
SOLVED = "Solve_Succeeded"
logger = logging.getLogger(__name__)


class BoundError(ValueError):
    """No start led to an acceptable solution; the message says what failed."""


def find_reference(problem: Problem, restarts: int = 3, paths: Sequence[Sequence[Array]] = ()) -> Reference:
    """Solve from several starts and keep the best accepted solution; raises `BoundError` where there is none.

    ``paths`` are further first guesses, one polyline (k, 3) m for each segment.
    """
    body, failures, found = rigid_body(problem), list[str](), list[Trajectory]()
    scouts = _scouts(problem, restarts, paths, failures)
    for restart, (scout, clear) in enumerate(scouts):
        if len(found) == restarts:
            break
        guess = lift(problem.quad.mass, scout.state, scout.control, scout.step)
        sign = -1 if problem.lap and restart % 2 else 1
        try:
            nodes = settle(problem, body, Nodes(guess.state, guess.thrust, guess.step), clear, sign)
            trajectory = Trajectory(nodes.state, nodes.control, nodes.step)
            accept(problem, trajectory, scouts[0][0].duration)
        except Rejected as failure:
            failures.append(str(failure))
            logger.debug("restart %d rejected: %s", restart, failure)
        else:
            logger.debug("restart %d: %.4f s", restart, trajectory.duration)
            found.append(trajectory)
    if not found:
        raise BoundError(_explain(failures))
    best = min(found, key=lambda trajectory: trajectory.duration)
    return Reference(best, np.array([trajectory.duration for trajectory in found]), scouts[0][0].duration)


def continue_from(problem: Problem, near: Trajectory) -> Reference:
    """Solve from the solution of a problem that differs a little; raises `BoundError` where that does not lead on."""
    first, last = near.state[[0, -1], 6:10]
    sign = -1 if first @ last < 0 else 1
    guess = Nodes(near.state, np.minimum(near.thrust, problem.quad.thrust_max), near.step)
    try:
        nodes = settle(problem, rigid_body(problem), guess, set(), sign)
        floor = min(scout.duration for scout, _ in _scouts(problem, 1, (), []))
        trajectory = Trajectory(nodes.state, nodes.control, nodes.step)
        accept(problem, trajectory, floor)
    except Rejected as failure:
        raise BoundError(_explain([str(failure)])) from None
    return Reference(trajectory, np.array([trajectory.duration]), floor)


def _scouts(
    problem: Problem, restarts: int, paths: Sequence[Sequence[Array]], failures: list[str]
) -> list[tuple[Nodes, set[Point]]]:
    """Solved point masses, fastest first, each with the points that it keeps clear of obstacles."""
    mass, found = point_mass(problem), []
    count = SCOUTS * restarts if problem.obstacles else max(SCOUTS, restarts)
    for guess in _guesses(problem, count, paths):
        try:
            clear = violated(problem, guess.state, guess.steps, MARGIN)[0]
            found.append((settle(problem, mass, guess, clear), clear))
        except Rejected as failure:
            failures.append(f"point mass: {failure}")
    return sorted(found, key=lambda scout: scout[0].duration)


def _guesses(problem: Problem, count: int, paths: Sequence[Sequence[Array]]) -> Iterator[Nodes]:
    yield from (follow(problem, path) for path in paths)
    yield from (follow(problem, straight_legs(problem, restart), restart) for restart in range(count))


def settle(problem: Problem, model: Model, guess: Nodes, clear: set[Point], sign: int = 1) -> Nodes:
    """Solve, add the constraints that the solution violates to ``clear``, and repeat until it violates none."""
    nodes = guess
    for _ in range(ROUNDS):
        nodes, status = solve(problem, model, nodes, clear, sign)
        if status != SOLVED:
            raise Rejected(f"IPOPT did not converge ({status})")
        more, worst = violated(problem, nodes.state, nodes.steps, 0.6 * MARGIN)
        if worst <= 0 or more <= clear:
            return nodes
        clear |= more
    raise Rejected(f"after {ROUNDS} rounds it still cuts an obstacle by {worst:.3g} m")


def _explain(failures: Sequence[str]) -> str:
    counted = {failure: failures.count(failure) for failure in failures}
    return "no acceptable solution: " + "; ".join(f"{text} ({n}x)" for text, n in counted.items())
