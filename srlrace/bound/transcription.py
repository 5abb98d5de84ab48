"""Direct multiple shooting: a time-optimal problem as a nonlinear program, solved by IPOPT."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from srlrace.bound.clearance import SHARES, Point, core, weights
from srlrace.bound.model import REGULARISER, Model
from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import NODES, Array

# The solver aims this much inside each waypoint's ball and the world, and outside each obstacle, m: room for what
# happens between the nodes, and for the drift of a replay that has no feedback. It costs about 0.05 % of the time.
MARGIN = 0.005
STEP_LIMITS = 1e-3, 5.0  # s, length of an interval
IPOPT: dict[str, Any] = {"print_level": 0, "sb": "yes", "max_iter": 500, "tol": 1e-5, "mu_init": 1e-3}
# From a solution nearby: stay there, although most of its limits are active. A larger barrier would push the flight off
# all of them first.
PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac")
WARM: dict[str, Any] = {"mu_init": 1e-6, "bound_mult_init_method": "mu-based", **dict.fromkeys(PUSHES, 1e-7)}


@dataclass(frozen=True, eq=False)
class Nodes:
    """Values of a program's variables."""

    state: Array  # (n + 1, states)
    control: Array  # (n, controls)
    step: Array  # (segments,) s

    @property
    def steps(self) -> Array:
        """Length of every interval (n,), s."""
        return np.repeat(self.step, NODES)

    @property
    def duration(self) -> float:
        """Time of the whole flight, s."""
        return float(NODES * self.step.sum())

    def flat(self) -> Array:
        """All values in the order of the program's variables."""
        return np.concatenate([self.state.ravel(), self.control.ravel(), self.step])


@dataclass
class Constraints:
    """Expressions with their lower and upper bounds."""

    rows: list[Any] = field(default_factory=list)
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)

    def add(self, rows: Any, low: float, high: float) -> None:
        """Bound a column of expressions."""
        self.rows.append(rows)
        self.low += [low] * rows.numel()
        self.high += [high] * rows.numel()


def solve(
    problem: Problem, model: Model, guess: Nodes, clear: Collection[Point], warm: bool = False
) -> tuple[Nodes, str]:
    """Solve from a guess; return where IPOPT ended and what it says (``Solve_Succeeded``).

    ``clear`` are the points kept away from obstacles. ``warm`` says that the guess solves a similar problem.
    """
    segments = len(problem.waypoints)
    n = segments * NODES
    x, u, h = ca.MX.sym("x", model.states, n + 1), ca.MX.sym("u", model.controls, n), ca.MX.sym("h", segments)
    steps = ca.vec(ca.repmat(h.T, NODES, 1)).T
    rules = Constraints()
    rules.add(ca.vec(x[:, 1:] - model.step.map(n)(x[:, :-1], u, steps)), 0, 0)
    _pass_waypoints(rules, problem, x)
    _keep_clear(rules, problem, x, steps, clear)
    if model.control_norm is not None:
        rules.add(ca.vec(ca.sum1(u**2)), 0, model.control_norm**2)
    if model.asked is not None:  # at both ends of an interval, over which the command is held
        for state in (x[:, :-1], x[:, 1:]):
            rules.add(ca.vec(model.asked.map(n)(state, u)), 0, problem.quad.thrust_max)
    if problem.lap:
        _close_lap(rules, x)
    scale = model.control_norm or float(model.control_high[0])
    cost = NODES * ca.sum1(h) + REGULARISER * (ca.sumsqr(u / scale) * 100 + ca.sumsqr(x[6:, :])) / n
    program = {"x": ca.veccat(x, u, h), "f": cost, "g": ca.vertcat(*rules.rows)}
    options: Any = {"print_time": False, "ipopt": IPOPT | (WARM if warm else {})}
    solver = ca.nlpsol("bound", "ipopt", program, options)
    low, high = (side.flat() for side in _limits(problem, model, n))
    result = solver(x0=guess.flat(), lbx=low, ubx=high, lbg=rules.low, ubg=rules.high)
    values = result["x"].full().ravel()
    states, controls = model.states * (n + 1), model.controls * n
    nodes = Nodes(
        values[:states].reshape(n + 1, -1), values[states : states + controls].reshape(n, -1), values[-segments:]
    )
    return nodes, str(solver.stats()["return_status"])


def _pass_waypoints(rules: Constraints, problem: Problem, x: Any) -> None:
    """Each segment ends within the passing radius of its waypoint."""
    ends = x[:3, NODES::NODES] - ca.DM(problem.waypoints).T
    rules.add(ca.vec(ca.sum1(ends**2)), 0, (problem.passing_radius - min(MARGIN, 0.1 * problem.passing_radius)) ** 2)


def _keep_clear(rules: Constraints, problem: Problem, x: Any, steps: Any, clear: Collection[Point]) -> None:
    """Points between the nodes stay away from the boxes of sphere centres that they are paired with."""
    if not clear:
        return
    kept = sorted(clear)
    here, there = [point.interval for point in kept], [point.interval + 1 for point in kept]
    a, b, c, d = ca.vertsplit(ca.DM([weights(SHARES[point.share]) for point in kept]).T)
    low, high = (
        ca.DM(np.array(side)).T for side in zip(*(core(problem.obstacles[p.obstacle]) for p in kept), strict=True)
    )
    h, ones = steps[here], ca.DM.ones(3, 1)
    at = (ones @ a) * x[:3, here] + (ones @ (b * h)) * x[3:6, here]
    at += (ones @ c) * x[:3, there] + (ones @ (d * h)) * x[3:6, there]
    offset = at - ca.fmax(low, ca.fmin(at, high))
    reach = np.array([problem.obstacles[point.obstacle].sphere_radius for point in kept]) + problem.keep_out + MARGIN
    rules.add((ca.sum1(offset**2) - ca.DM(reach**2).T).T, 0, np.inf)


def _close_lap(rules: Constraints, x: Any) -> None:
    """The lap ends in the state that it began in.

    Of the attitude, that is three equations: no turn is left from its beginning to its end. Four, that both
    quaternions are equal, would ask once more for the length that the motion keeps by itself, and with constraints that
    depend on each other IPOPT takes ten times as many iterations.
    """
    rules.add(x[:6, 0] - x[:6, -1], 0, 0)
    if x.shape[0] == 6:
        return
    rules.add(x[10:, 0] - x[10:, -1], 0, 0)
    begin, end = x[6:10, 0], x[6:10, -1]
    rules.add(begin[0] * end[1:] - end[0] * begin[1:] - ca.cross(begin[1:], end[1:]), 0, 0)
    rules.add(ca.sumsqr(begin), 1, 1)


def _limits(problem: Problem, model: Model, n: int) -> tuple[Nodes, Nodes]:
    """Lower and upper limits of all variables: the world, the rates, the thrusts, the start, the stop."""
    segments = len(problem.waypoints)
    low, high = np.tile(-model.state_limit, (n + 1, 1)), np.tile(model.state_limit, (n + 1, 1))
    low[:, :3], high[:, :3] = np.array(problem.bounds_low) + MARGIN, np.array(problem.bounds_high) - MARGIN
    if problem.start is not None:
        low[0] = high[0] = np.concatenate([problem.start, model.rest[3:]])
    if problem.stop:
        low[-1, 3:6] = high[-1, 3:6] = 0.0
    return (
        Nodes(low, np.tile(model.control_low, (n, 1)), np.full(segments, STEP_LIMITS[0])),
        Nodes(high, np.tile(model.control_high, (n, 1)), np.full(segments, STEP_LIMITS[1])),
    )
