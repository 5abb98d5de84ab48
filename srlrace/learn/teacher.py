"""A teacher for the beginning of training: what a controller along a demonstrated flight would do.

The demonstration (`srlrace.bound.demonstration`) is a flight, not a policy: it says what to do on its own path alone. A
linear-quadratic regulator along it says what to do nearby. Policies are drawn to its actions in the states that they
themselves come to (kickstarting: Schmitt et al. 2018), by less and less, and then left to the reward.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from srlrace.bound.demonstration import Demonstration
from srlrace.bound.escapes import HOLD, Escapes
from srlrace.learn.advice import AROUND, ERRORS, advise_all, advise_escapes
from srlrace.sim.dynamics import advance
from srlrace.task.arrays import Rules
from srlrace.task.race import Race, commands, ramp
from srlrace.task.reset import nominal_records

# How the regulator weighs errors against corrections, ours: 0.4 m as much as half the range of the collective, 0.3 m as
# half that of a rate.
ERROR_COST = np.diag([100.0] * 3 + [4.0] * 3 + [30.0] * 3 + [0.1] * 3 + [0.01] * 4)
ACTION_COST = np.diag([20.0, 10.0, 10.0, 10.0])
FINAL_COST = 10.0  # times ERROR_COST, of errors at the end
DIFFERENCE = 1e-4  # step of the differences that linearise the simulator, in the units of errors and actions
# Passings of the demonstration are remembered with normal errors of these sizes: m, m/s, rad, rad/s, N. Ours.
SPREAD = np.repeat([0.05, 0.3, 0.04, 0.3, 0.1], [3, 3, 3, 3, 4])
OFFERED = 0.25  # of the remembered passings, renewed before each rollout

Floats = NDArray[np.float64]


class Teacher:
    """Tells drones of a race what to do: along the flight that is shown, and on ways out of hard starts.

    ``weight`` is how much the flight counts and ``escape_weight`` how much the ways out do; 0 when that is over.
    """

    def __init__(self, race: Race, demonstration: Demonstration, escapes: Escapes | None = None) -> None:
        curriculum = race.config.curriculum
        self._race, self._demonstration = race, demonstration
        self._first, self._end = curriculum.teaching, curriculum.teaching_end
        self._plan = make_plan(demonstration, race.rules)
        self._error = np.zeros(ERRORS)
        self._escape_ramp = curriculum.escape_hold, curriculum.escape_end
        self._ways = np.zeros((0, 1, 4), np.float32) if escapes is None else escapes.action.astype(np.float32)
        if escapes is not None:
            race.offer_escapes(escapes.start)
        self._set_weights(0.0)

    def _set_weights(self, done: float) -> None:
        """Set how much is counted when a share of the training is ``done``."""
        self.weight = self._first * (1.0 - ramp(done, 0.0, self._end))
        self.escape_weight = self._first * (1.0 - ramp(done, *self._escape_ramp)) if len(self._ways) else 0.0

    @property
    def teaches(self) -> bool:
        """Whether anything counts yet."""
        return self.weight > 0.0 or self.escape_weight > 0.0

    def begin_rollout(self, steps: int) -> None:
        """Say how many of the training's steps are done; while teaching goes on, its flight's passings are starts."""
        self._set_weights(steps / self._race.config.algo.total_steps)
        if self.weight > 0.0:
            self._offer_passings(steps)

    def advise(self, action: NDArray[np.float32], weight: NDArray[np.float32]) -> None:
        """Write what each drone should do now, (n, 4), and how much that counts, (n,), or 0."""
        fleet = self._race.fleet
        weight[:] = 0.0
        if self.weight > 0.0:
            advise_all(fleet, self._race.rules, self._plan, self._error, self.weight, action, weight)
        if self.escape_weight > 0.0:
            advise_escapes(fleet, self._ways, HOLD, self.escape_weight, action, weight)

    def _offer_passings(self, steps: int) -> None:
        """Have the race remember passings of the demonstration, nearly; which ones follows from seed and ``steps``."""
        race, shown = self._race, self._demonstration
        rules, memory = race.rules, race.memory
        rng = np.random.default_rng([race.config.seed, steps])
        size = memory.record.shape[1]
        for target in range(1, len(rules.sequence)):
            count = size if steps == 0 else max(1, round(OFFERED * size))
            at = shown.passing[target - 1]
            state = displaced(np.repeat(shown.state[at : at + 1], count, 0), rng.normal(size=(count, ERRORS)) * SPREAD)
            rows = rng.choice(size, count, replace=False)
            memory.record[target, rows] = nominal_records(rules, state, int(at))
            memory.count[target] = max(memory.count[target], size)


def make_plan(shown: Demonstration, rules: Rules) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """Return what the kernel takes: states (n, 17), actions (n, 4), gains (n, 4, 16), and samples of targets (k, 2)."""
    n = len(shown.action)
    begin = np.maximum(np.append(0, shown.passing[:-1]) - AROUND, 0)
    ranges = np.stack([begin, np.minimum(shown.passing + AROUND, n)], axis=1).astype(np.int64)
    return shown.state[:n].copy(), shown.action.copy(), regulator(linearise(shown, rules)), ranges


def regulator(along: tuple[Floats, Floats]) -> Floats:
    """Gains (n, 4, 16) of the finite-horizon linear-quadratic regulator of `linearise`: action error = -gain error."""
    gains, cost = np.zeros((len(along[0]), 4, ERRORS)), FINAL_COST * ERROR_COST
    for k in range(len(gains) - 1, -1, -1):
        a, b = along[0][k], along[1][k]
        gains[k] = np.linalg.solve(ACTION_COST + b.T @ cost @ b, b.T @ cost @ a)
        cost = ERROR_COST + a.T @ cost @ (a - b @ gains[k])
        cost = 0.5 * (cost + cost.T)
    return gains


def linearise(shown: Demonstration, rules: Rules) -> tuple[Floats, Floats]:
    """Differentiate the simulator along a flight, by differences of one control period.

    Returns a (n, 16, 16) and b (n, 16, 4): error' = a error + b action error, one period later.
    """
    n = len(shown.action)
    a, b = np.zeros((n, ERRORS, ERRORS)), np.zeros((n, ERRORS, 4))
    for k, (state, action) in enumerate(zip(shown.state[:n], shown.action, strict=True)):
        inner = np.clip(action, -1.0 + DIFFERENCE, 1.0 - DIFFERENCE)  # beyond, an action is clipped
        states = np.vstack([state, displaced(np.tile(state, (ERRORS, 1)), DIFFERENCE * np.eye(ERRORS))])
        actions = np.vstack([inner, inner + DIFFERENCE * np.eye(4)])
        moved = fly_once(rules, states, np.tile(inner, (len(states), 1)))
        steered = fly_once(rules, np.tile(state, (len(actions), 1)), actions)
        a[k] = deviation(moved[1:], moved[0]).T / DIFFERENCE
        b[k] = deviation(steered[1:], steered[0]).T / DIFFERENCE
    return a, b


def fly_once(rules: Rules, state: Floats, action: Floats) -> Floats:
    """Return the states (n, 17) one control period after these, of the nominal quadrotor."""
    ended = np.ascontiguousarray(state.T)
    command = np.ascontiguousarray(commands(rules, action).T, np.float64)
    plant = np.tile(np.append(rules.drag, 1.0).astype(np.float64)[:, None], (1, len(state)))
    advance(ended, command, plant, rules.airframe.astype(np.float64), rules.dt, rules.substeps)
    return ended.T


def deviation(state: Floats, nominal: Floats) -> Floats:
    """Errors (n, 16) of states (n, 17) from one state (17,)."""
    turn = product(nominal[6:10] * [1.0, -1.0, -1.0, -1.0], state[:, 6:10])
    turn = np.where(turn[:, :1] < 0.0, -turn, turn)
    return np.hstack([state[:, :6] - nominal[:6], 2.0 * turn[:, 1:], state[:, 10:] - nominal[10:]])


def displaced(state: Floats, error: Floats) -> Floats:
    """The states (n, 17) that deviate from these by small errors (n, 16)."""
    turn = np.hstack([np.ones((len(error), 1)), 0.5 * error[:, 6:9]])
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    attitude = product(state[:, 6:10], turn)
    return np.hstack([state[:, :6] + error[:, :6], attitude, state[:, 10:] + error[:, 9:]])


def product(p: Floats, q: Floats) -> Floats:
    """Hamilton product of quaternions (n, 4) or (4,), w first."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    w = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)
