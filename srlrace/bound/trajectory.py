"""A flown-through trajectory of the solver, and its motion between the nodes in plain numpy.

The derivative is written here a second time, apart from the solver's symbols, so that what is accepted was not judged
by the code that made it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srlrace.bound.problem import Problem
from srlrace.sim.airframe import GRAVITY, Airframe

Array = NDArray[np.float64]
NODES = 20  # shooting intervals from one waypoint to the next


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Nodes of a flight: n intervals, `NODES` for each of the s waypoints, equally long within a segment."""

    state: Array  # (n + 1, 13): position m, velocity m/s (world), quaternion w x y z, body rates rad/s
    thrust: Array  # (n, 4) N, held over an interval
    step: Array  # (s,) s, length of an interval in each segment

    @property
    def steps(self) -> Array:
        """Length of every interval (n,), s."""
        return np.repeat(self.step, len(self.thrust) // len(self.step))

    @property
    def times(self) -> Array:
        """Times of the nodes (n + 1,), s."""
        return np.concatenate([[0.0], np.cumsum(self.steps)])

    @property
    def duration(self) -> float:
        """Time of the whole flight, s."""
        return float(self.times[-1])


@dataclass(frozen=True, eq=False)
class Reference:
    """The best solution found, and what the others came to."""

    trajectory: Trajectory
    times: Array  # (r,) s: of every accepted restart, in order
    point_mass_time: float  # s: of the fastest point mass, which no rigid body can beat

    @property
    def time(self) -> float:
        """T_ref, s."""
        return self.trajectory.duration


def derivative(problem: Problem, state: Array, thrust: Array) -> Array:
    """Time derivative of states (n, 13) under rotor thrusts (n, 4), N: the paper's Eq. 1 and 2 without rotor lag."""
    velocity, q, rate = state[:, 3:6], state[:, 6:10], state[:, 10:13]
    inertia = np.array(problem.quad.inertia)
    rotation = rotations(q)
    wrench = thrust @ Airframe(problem.quad).mixer().T
    force = -problem.drag * np.einsum("nij,ni->nj", rotation, velocity)
    force[:, 2] += wrench[:, 0] / problem.quad.mass
    acceleration = np.einsum("nij,nj->ni", rotation, force) - [0.0, 0.0, GRAVITY]
    spin = (wrench[:, 1:] - np.cross(rate, inertia * rate)) / inertia
    w, v = q[:, :1], q[:, 1:]
    turn = 0.5 * np.hstack([-np.sum(v * rate, axis=1, keepdims=True), w * rate + np.cross(v, rate)])
    return np.hstack([velocity, acceleration, turn, spin])


def rotations(quaternion: Array) -> Array:
    """Rotation matrices (n, 3, 3), body to world, of quaternions (n, 4) of any length."""
    q = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    w, v = q[:, 0, None, None], q[:, 1:]
    outer = v[:, :, None] * v[:, None, :]
    cross = np.zeros((len(q), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = v
    cross[:, [1, 2, 0], [2, 0, 1]] = -v
    return np.asarray((2 * w * w - 1) * np.eye(3) + 2 * outer + 2 * w * cross)


def between_nodes(problem: Problem, trajectory: Trajectory, parts: int) -> Array:
    """States (n, parts + 1, 13) within every interval, each integrated from its own node in ``parts`` RK4 steps."""
    h = (trajectory.steps / parts)[:, None]
    x, u = trajectory.state[:-1], trajectory.thrust
    passed = [x]
    for _ in range(parts):
        k1 = derivative(problem, x, u)
        k2 = derivative(problem, x + h / 2 * k1, u)
        k3 = derivative(problem, x + h / 2 * k2, u)
        k4 = derivative(problem, x + h * k3, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        passed.append(x)
    return np.stack(passed, axis=1)


def lift(mass: float, state: Array, force: Array, step: Array, turns: int = 0) -> Trajectory:
    """Turn a point mass's flight into a first guess of the rigid body's: thrust along its force, rates left at zero.

    state (n + 1, 6) m, m/s; force (n, 3) m/s^2; step (s,) s. The nose turns about the thrust, ``turns`` times in all.
    """
    size = np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-6)
    x, y, z = np.vstack([force / size, (force / size)[-1:]]).T
    q = np.stack([1 + z, -y, x, 0 * z], axis=1)  # the shortest turn from upright to the thrust's direction
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-3)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    q = np.where(length > 0.5, q, [0.0, 1.0, 0.0, 0.0])  # upside down: about x
    half = np.pi * turns * np.linspace(0.0, 1.0, len(q))[:, None]
    q = q * np.cos(half) + np.stack([-q[:, 3], q[:, 2], -q[:, 1], q[:, 0]], axis=1) * np.sin(half)
    return Trajectory(np.hstack([state, q, np.zeros((len(state), 3))]), np.tile(size * mass / 4, (1, 4)), step)
