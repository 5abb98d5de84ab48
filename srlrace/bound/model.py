"""The models of the solver, as CasADi functions: point mass, rigid body, and the quadrotor with all its actuators."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from srlrace.bound.problem import Problem
from srlrace.sim.airframe import GRAVITY, Airframe

# Keeps a bang-bang solution's singular arcs well posed; a flight of 5 s is lengthened by less than 1e-4 s.
REGULARISER = 1e-6
# RK4 steps of the rigid body in an interval. One is up to 0.2 mm off where intervals last 40 ms, and over a lap that
# adds up to more than a centimetre.
STEPS = 2
LAG_STEPS = 4  # and of the rotors' lag: a step is a fifth of its time constant
COMPILER = "cc"
JIT = {"jit": True, "compiler": "shell", "jit_temp_suffix": True, "jit_cleanup": False}  # the folder goes as a whole
WORTH_IT = 6  # waypoints of a problem, from which on compiling saves more time than it takes


@dataclass(frozen=True)
class Model:
    """A controlled system: its RK4 step, its limits, and the small cost that makes its solution unique."""

    step: Any  # casadi Function (x, u, h) -> x
    rest: NDArray[np.float64]  # state at rest in the origin
    state_limit: NDArray[np.float64]  # largest absolute value of each state, inf for none
    control_low: NDArray[np.float64]
    control_high: NDArray[np.float64]
    control_norm: float | None  # largest Euclidean norm of the control, None: no such limit
    asked: Any = None  # casadi Function (x, u) -> rotor thrusts that are asked for, N, within what a rotor can give

    @property
    def states(self) -> int:
        """Number of states; the first three are the position, the next three the velocity."""
        return len(self.rest)

    @property
    def controls(self) -> int:
        """Number of controls."""
        return len(self.control_low)


def point_mass(problem: Problem) -> Model:
    """Position and velocity under any force up to the rotors' sum and the least of the drag coefficients."""
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 3)
    slope = ca.vertcat(x[3:6], u - ca.DM([0, 0, GRAVITY]) - float(problem.drag.min()) * x[3:6])
    free = np.full(3, np.inf)
    return Model(_rk4(x, u, slope, 1), np.zeros(6), np.full(6, np.inf), -free, free, problem.max_collective)


@contextmanager
def quick_body(problem: Problem, body: Callable[[Problem, dict[str, Any]], Model] | None = None) -> Iterator[Model]:
    """The rigid body, or another ``body``, compiled if that pays and there is a C compiler.

    Derivatives are what most of the time goes into. Compiling takes 3 s of CPU, once for all programs of
    the model; each iteration is then five times faster.
    """
    body = body or rigid_body
    if len(problem.waypoints) < WORTH_IT or shutil.which(COMPILER) is None:
        yield body(problem, {})
        return
    directions = ca.GlobalOptions.getMaxNumDir()
    ca.GlobalOptions.setMaxNumDir(1)  # derivatives one direction at a time: the same short code, called more often
    try:
        with tempfile.TemporaryDirectory() as folder:
            settings = {"compiler": COMPILER, "flags": ["-O1"], "directory": f"{folder}/", "cleanup": False}
            yield body(problem, {**JIT, "jit_options": settings})
    finally:
        ca.GlobalOptions.setMaxNumDir(directions)


def rigid_body(problem: Problem, options: dict[str, Any] | None = None) -> Model:
    """The paper's Eq. 1 and 2, rotor thrusts as controls; attitude built from q/|q|, lest |q| > 1 gives free thrust.

    ``options`` are CasADi's of the step's function.
    """
    quad = problem.quad
    x, u = ca.SX.sym("x", 13), ca.SX.sym("u", 4)
    rest = np.array([0.0] * 6 + [1.0] + [0.0] * 6)
    limit = np.concatenate([np.full(10, np.inf), quad.body_rate_max])
    step = _rk4(x, u, _rigid_slope(problem, x, u), STEPS, options)
    return Model(step, rest, limit, np.zeros(4), np.full(4, quad.thrust_max), None)


def actuated_body(problem: Problem, options: dict[str, Any] | None = None) -> Model:
    """The quadrotor as it is simulated: rotors that lag, under a rate controller; its commands are the controls.

    States are those of the simulator, (17,); controls are collective, m/s^2, and body rates, rad/s.
    """
    quad, hover = problem.quad, Airframe(problem.quad).hover_thrust
    x, u = ca.SX.sym("x", 17), ca.SX.sym("u", 4)
    inertia, rate, mixer = ca.DM(quad.inertia), x[10:13], Airframe(quad).mixer()
    torque = inertia * ca.DM(quad.rate_gains) * (u[1:] - rate) + ca.cross(rate, inertia * rate)
    asked = ca.mtimes(ca.DM(np.linalg.inv(mixer)), ca.vertcat(quad.mass * u[0], torque))
    slope = ca.vertcat(_rigid_slope(problem, x[:13], x[13:]), (asked - x[13:]) / quad.rotor_time_constant)
    rates = np.array(quad.body_rate_max)
    return Model(
        step=_rk4(x, u, slope, LAG_STEPS, options),
        rest=np.array([0.0] * 6 + [1.0] + [0.0] * 6 + [hover] * 4),
        state_limit=np.concatenate([np.full(13, np.inf), np.full(4, quad.thrust_max)]),
        control_low=np.concatenate([[0.0], -rates]),
        control_high=np.concatenate([[problem.max_collective], rates]),
        control_norm=None,
        asked=ca.Function("asked", [x, u], [asked]),
    )


def _rigid_slope(problem: Problem, x: Any, thrust: Any) -> Any:
    quad = problem.quad
    inertia, rate, q = ca.DM(quad.inertia), x[10:13], x[6:10]
    rotation = _rotation(q / ca.norm_2(q))
    wrench = ca.mtimes(ca.DM(Airframe(quad).mixer()), thrust)
    force = -ca.DM(problem.drag) * ca.mtimes(rotation.T, x[3:6]) + ca.vertcat(0, 0, wrench[0] / quad.mass)
    return ca.vertcat(
        x[3:6],
        ca.mtimes(rotation, force) - ca.DM([0, 0, GRAVITY]),
        0.5 * ca.vertcat(-ca.dot(q[1:], rate), q[0] * rate + ca.cross(q[1:], rate)),
        (wrench[1:] - ca.cross(rate, inertia * rate)) / inertia,
    )


def _rk4(x: Any, u: Any, slope: Any, steps: int, options: dict[str, Any] | None = None) -> Any:
    f, h = ca.Function("slope", [x, u], [slope]), ca.SX.sym("h")
    end, part = x, h / steps
    for _ in range(steps):
        k1 = f(end, u)
        k2 = f(end + part / 2 * k1, u)
        k3 = f(end + part / 2 * k2, u)
        k4 = f(end + part * k3, u)
        end = end + part / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("step", [x, u, h], [end], options or {})


def _rotation(q: Any) -> Any:
    w, x, y, z = (q[i] for i in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
