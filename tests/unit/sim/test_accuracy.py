"""The kernel against an independent solution of the equations of motion (scipy's DOP853, float64).

The reference shares nothing with the kernel: it builds torques from rotor positions and cross products, rotates
with quaternion products, solves the mixer as a linear system, and integrates all 17 states jointly with an adaptive
eighth-order method. What it takes from the simulator's definition is when the rate controller runs: at the start
of every substep, its rotor commands held until the next one, as a digital controller does.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from srlrace.config import QuadConfig
from srlrace.sim.airframe import Airframe
from srlrace.sim.dynamics import advance
from srlrace.sim.quadrotor import integrate

Array = NDArray[np.float64]
DRONES, PERIODS, SUBSTEPS, PERIOD = 100, 100, 8, 0.02  # 2 s of flight


def hamilton(a: Array, b: Array) -> Array:
    """Quaternion product a b, shapes (4, n)."""
    scalar = a[0] * b[0] - np.sum(a[1:] * b[1:], axis=0)
    return np.concatenate([scalar[None], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:], axis=0)])


def turned(q: Array, vector: Array) -> Array:
    """`vector` (3, n) from the body to the world frame."""
    pure = np.concatenate([np.zeros_like(vector[:1]), vector])
    return hamilton(hamilton(q, pure), conjugate(q))[1:]


def conjugate(q: Array) -> Array:
    return np.concatenate([q[:1], -q[1:]])


class Reference:
    """The equations of the paper, written for clarity, for a batch of drones."""

    def __init__(self, quad: QuadConfig) -> None:
        self.quad = quad
        self.inertia = np.array(quad.inertia)[:, None]
        half = quad.arm_length / np.sqrt(2)
        positions = np.array([[half, half, 0], [half, -half, 0], [-half, -half, 0], [-half, half, 0]])
        torque = np.cross(positions, [0, 0, 1]).T
        torque[2] = quad.torque_constant * np.array([1, -1, 1, -1])
        self.mixer = np.vstack([np.ones(4), torque])

    def rotor_commands(self, w: Array, command: Array) -> Array:
        wanted = np.array(self.quad.rate_gains)[:, None] * (command[1:] - w)
        torque = self.inertia * wanted + np.cross(w, self.inertia * w, axis=0)
        thrusts = np.linalg.solve(self.mixer, np.vstack([self.quad.mass * command[:1], torque]))
        return np.clip(thrusts, 0, self.quad.thrust_max)

    def slope(self, state: Array, rotors: Array) -> Array:
        v, q, w, f = state[3:6], state[6:10], state[10:13], state[13:17]
        wrench = self.mixer @ f
        force = -np.array(self.quad.drag)[:, None] * turned(conjugate(q), v)
        force[2] += wrench[0] / self.quad.mass
        acceleration = turned(q, force)
        acceleration[2] -= 9.81
        attitude = 0.5 * hamilton(q, np.concatenate([np.zeros_like(w[:1]), w]))
        rates = (wrench[1:] - np.cross(w, self.inertia * w, axis=0)) / self.inertia
        return np.concatenate([v, acceleration, attitude, rates, (rotors - f) / self.quad.rotor_time_constant])

    def flown(self, state: Array, rotors: Array, duration: float) -> Array:
        """States after `duration` [s] under held rotor commands (4, n)."""

        def flat(_: float, x: Array) -> Array:
            return self.slope(x.reshape(state.shape), rotors).ravel()

        solution = solve_ivp(flat, (0, duration), state.ravel(), method="DOP853", rtol=1e-10, atol=1e-11)
        return solution.y[:, -1].reshape(state.shape)


@pytest.fixture(scope="module")
def flight(
    quad: QuadConfig,
    random_states: Callable[[int, int], Array],
    random_commands: Callable[[int, int], Array],
) -> tuple[Array, list[Array], Array]:
    """Start states, a command for each control period, and the reference's end states."""
    reference = Reference(quad)
    start = random_states(DRONES, 0)
    commands = [random_commands(DRONES, 1 + i) for i in range(PERIODS)]
    state = start
    for command in commands:
        for _ in range(SUBSTEPS):
            rotors = reference.rotor_commands(state[10:13], command)
            state = reference.flown(state, rotors, PERIOD / SUBSTEPS)
    return start, commands, state


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 2e-5), (np.float32, 5e-4)])
def test_two_seconds_of_random_actions(
    flight: tuple[Array, list[Array], Array], airframe: Airframe, dtype: type, tolerance: float
) -> None:
    start, commands, expected = flight
    state = start.astype(dtype)
    plant = np.ones((4, DRONES), dtype)
    plant[:3] = airframe.drag_acceleration()[:, None]
    for command in commands:
        advance(state, command.astype(dtype), plant, airframe.pack(dtype), PERIOD, SUBSTEPS)
    error = np.linalg.norm(state[:3] - expected[:3], axis=0)
    assert np.abs(expected[:3] - start[:3]).max() > 5  # the drones do fly
    assert error.max() < tolerance


def test_integrator_is_of_fourth_order(
    quad: QuadConfig, airframe: Airframe, random_states: Callable[[int, int], Array]
) -> None:
    start, duration = random_states(5, 3), 0.04
    rotors = np.random.default_rng(4).uniform(0, quad.thrust_max, (4, 5))
    expected = Reference(quad).flown(start, rotors, duration)
    drag = tuple(airframe.drag_acceleration())
    errors = []
    for count in (4, 8, 16):
        worst = 0.0
        for i in range(5):
            column = tuple(float(x) for x in start[:, i])
            parts = column[:3], column[3:6], column[6:10], column[10:13], column[13:]
            for _ in range(count):
                parts = integrate(*parts, tuple(rotors[:, i]), drag, airframe.pack(np.float64), duration / count)
            worst = max(worst, float(np.abs(np.concatenate(parts) - expected[:, i]).max()))
        errors.append(worst)
    assert 13 < errors[0] / errors[1] < 20
    assert 13 < errors[1] / errors[2] < 20
