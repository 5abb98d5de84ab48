"""An independent solution of the equations of motion: SciPy's DOP853, float64.

The reference shares nothing with the kernel: it builds torques from rotor positions and cross products, rotates
with quaternion products, solves the mixer as a linear system, and integrates all 17 states jointly with an adaptive
eighth-order method. What it takes from the simulator's definition is when the rate controller runs: at the start
of every substep, its rotor commands held until the next one, as a digital controller does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from srlrace.config import QuadConfig

Array = NDArray[np.float64]
SUBSTEPS, PERIOD = 8, 0.02  # of a control period, s


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
    """The equations of the paper, written for clarity, for a batch of drones.

    ``mass``, ``drag`` (a force) and ``thrust`` are multiples of what the rate controller believes; ``wind`` is how the
    air moves, m/s, world, (3, 1) or (3, n).
    """

    def __init__(
        self, quad: QuadConfig, mass: float = 1.0, drag: float = 1.0, thrust: float = 1.0, wind: Array | None = None
    ) -> None:
        self.quad, self.mass, self.thrust = quad, mass * quad.mass, thrust
        self.drag = drag * quad.mass * np.array(quad.drag)[:, None]  # kg/s
        self.wind = np.zeros((3, 1)) if wind is None else wind
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
        return self.thrust * np.clip(thrusts, 0, self.quad.thrust_max)

    def slope(self, state: Array, rotors: Array) -> Array:
        v, q, w, f = state[3:6], state[6:10], state[10:13], state[13:17]
        wrench = self.mixer @ f
        force = -self.drag * turned(conjugate(q), v - self.wind)
        force[2] += wrench[0]
        acceleration = turned(q, force) / self.mass
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

    def flown_period(self, state: Array, command: Array) -> Array:
        """States a control period later, the rate controller running at each substep."""
        for _ in range(SUBSTEPS):
            state = self.flown(state, self.rotor_commands(state[10:13], command), PERIOD / SUBSTEPS)
        return state
