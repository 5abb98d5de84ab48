"""Solving a time-optimal problem: several starts, a point mass first, obstacles only where they are in the way."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from srlrace.bound.accept import SLACK, Rejected, accept
from srlrace.bound.clearance import Point, violated
from srlrace.bound.guess import follow, piloted, straight_legs
from srlrace.bound.model import Model, point_mass, quick_body, rigid_body
from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import Array, Reference, Trajectory, lift, rotations
from srlrace.bound.transcription import MARGIN, Nodes, solve

ROUNDS = 15  # of adding the constraints that a solution violates
SCOUTS = 3  # point masses sent: for each rigid body where obstacles leave several ways, at least so many where not
SIZES = (0.3, 0.5, 0.7, 0.85, 0.95, 1.0)  # shares of their size at which obstacles stop growing for a solution
NEARBY = 0.05  # m: obstacles closer to a neighbour's solution than this are kept clear from the beginning
ALONG = 0.5  # m: and closer than this to a pilot's flight, which will change more
COARSE = 4  # of its points that many eighths apart
TURNS = (0, 1, -1)  # of the nose about the thrust during a lap, in its first guesses
SOLVED = "Solve_Succeeded"
logger = logging.getLogger(__name__)


class BoundError(ValueError):
    """No start led to an acceptable solution; the message says what failed."""


def find_reference(
    problem: Problem,
    restarts: int = 3,
    paths: Sequence[Sequence[Array]] = (),
    free: Reference | None = None,
    body: Model | None = None,
) -> Reference:
    """Solve from several starts and keep the best accepted solution; raises `BoundError` where there is none.

    ``free`` is the reference without the obstacles, below which no solution is believed; they are grown into it, and
    flights along ``paths`` through them, one polyline (k, 3) m for each segment, are made faster. ``body`` is the
    model, if it is there already.
    """
    if body is None:
        with quick_body(problem) as body:
            return find_reference(problem, restarts, paths, free, body)
    failures, found = list[str](), list[Trajectory]()
    least = free.point_mass_time if free else np.inf
    for floor, attempt in _attempts(problem, restarts, body, paths, free, found, failures):
        if len(found) == restarts:
            break
        least = min(least, floor)
        try:
            nodes = attempt()
            trajectory = Trajectory(nodes.state, nodes.control, nodes.step)
            if trajectory.duration < least and not free:  # on a way that no scout took?
                least = min(least, _scout_along(problem, trajectory).duration)
            accept(problem, trajectory, least)
            if free and trajectory.duration < free.time * (1 - SLACK):
                raise Rejected(f"{trajectory.duration:.3f} s beat the flight without obstacles, {free.time:.3f} s")
        except Rejected as failure:
            failures.append(str(failure))
            logger.debug("rejected: %s", failure)
        else:
            logger.debug("accepted: %.4f s", trajectory.duration)
            found.append(trajectory)
    if not found:
        raise BoundError(_explain(failures))
    best = min(found, key=lambda trajectory: trajectory.duration)
    return Reference(best, np.array([trajectory.duration for trajectory in found]), least)


def _attempts(
    problem: Problem,
    restarts: int,
    body: Model,
    paths: Sequence[Sequence[Array]],
    free: Reference | None,
    found: Collection[Trajectory],
    failures: list[str],
) -> Iterator[tuple[float, Callable[[], Nodes]]]:
    """Ways to a solution, one after the other, each with the time that no solution can beat.

    ``found`` is what came of those before.
    """
    if free is not None:
        yield free.point_mass_time, partial(_give_way, problem, body, free.trajectory)
        yield from ((free.point_mass_time, partial(_hurry, problem, body, path)) for path in paths)
        if not problem.lap:
            if found:
                return  # what is left is slow in a wood, and finds no better way than the paths
            yield free.point_mass_time, partial(_grow, problem, body, free.trajectory)
    scouts = _scouts(problem, restarts, failures)
    for restart, (scout, clear) in enumerate(scouts):
        turns = TURNS[restart % len(TURNS)] if problem.lap else 0
        guess = lift(problem.quad.mass, scout.state, scout.control, scout.step, turns)
        nodes = Nodes(guess.state, guess.thrust, guess.step)
        yield scouts[0][0].duration, partial(settle, problem, body, nodes, clear)
    if free is not None and problem.lap:
        yield free.point_mass_time, partial(_grow, problem, body, free.trajectory)


def _hurry(problem: Problem, body: Model, path: Sequence[Array]) -> Nodes:
    """Make a pilot's flight along a clear path faster: it begins on the right side of every obstacle and stays there.

    The obstacles along it are there from the beginning, so that none is met from within.
    """
    try:
        guess = piloted(problem, path)
    except ValueError as error:
        raise Rejected(str(error)) from None
    return settle(problem, body, guess, _along(problem, guess))


def _give_way(problem: Problem, body: Model, free: Trajectory) -> Nodes:
    """Bend the flight without obstacles around all of those along it at once."""
    guess = Nodes(free.state, free.thrust, free.step)
    return settle(problem, body, guess, _along(problem, guess))


def _along(problem: Problem, guess: Nodes) -> set[Point]:
    """Points of a flight, few for each of the obstacles along it, to be kept clear from the beginning."""
    clear = violated(problem, guess.state, guess.steps, ALONG)[0]
    return {point for point in clear if point.share % COARSE == 0}


def _grow(problem: Problem, body: Model, free: Trajectory) -> Nodes:
    """Let the obstacles grow from lines and points to their size, the flight giving way to them."""
    nodes = Nodes(free.state, free.thrust, free.step)
    for share in SIZES:
        solids = tuple(replace(solid, sphere_radius=share * solid.sphere_radius) for solid in problem.obstacles)
        smaller = replace(problem, obstacles=solids, keep_out=share * problem.keep_out)
        clear = violated(smaller, nodes.state, nodes.steps, MARGIN)[0]
        nodes = settle(smaller, body, nodes, clear, warm=True)
    return nodes


def _scout_along(problem: Problem, flight: Trajectory) -> Nodes:
    """The fastest point mass near a rigid body's flight."""
    upward = rotations(flight.state[:-1, 6:10])[:, :, 2]
    force = upward * flight.thrust.sum(axis=1, keepdims=True) / problem.quad.mass
    clear = violated(problem, flight.state, flight.steps, NEARBY)[0]
    return settle(problem, point_mass(problem), Nodes(flight.state[:, :6], force, flight.step), clear)


def continue_from(problem: Problem, near: Trajectory) -> Reference:
    """Solve from the solution of a problem that differs a little; raises `BoundError` where that does not lead on."""
    guess = Nodes(near.state, np.minimum(near.thrust, problem.quad.thrust_max), near.step)
    try:
        clear = violated(problem, guess.state, guess.steps, NEARBY)[0]
        nodes = settle(problem, rigid_body(problem), guess, clear, warm=True)
        floor = min(scout.duration for scout, _ in _scouts(problem, 1, []))
        trajectory = Trajectory(nodes.state, nodes.control, nodes.step)
        accept(problem, trajectory, floor)
    except Rejected as failure:
        raise BoundError(_explain([str(failure)])) from None
    return Reference(trajectory, np.array([trajectory.duration]), floor)


def _scouts(problem: Problem, restarts: int, failures: list[str]) -> list[tuple[Nodes, set[Point]]]:
    """Solved point masses, fastest first, each with the points that it keeps clear of obstacles."""
    mass, found = point_mass(problem), []
    count = SCOUTS * restarts if problem.obstacles else max(SCOUTS, restarts)
    for restart in range(count):
        guess = follow(problem, straight_legs(problem, restart), restart)
        try:
            clear = violated(problem, guess.state, guess.steps, MARGIN)[0]
            found.append((settle(problem, mass, guess, clear), clear))
        except Rejected as failure:
            failures.append(f"point mass: {failure}")
    return sorted(found, key=lambda scout: scout[0].duration)


def settle(problem: Problem, model: Model, guess: Nodes, clear: set[Point], warm: bool = False) -> Nodes:
    """Solve, add the constraints that the solution violates to ``clear``, and repeat until it violates none."""
    nodes = guess
    for _ in range(ROUNDS):
        nodes, status = solve(problem, model, nodes, clear, warm)
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
