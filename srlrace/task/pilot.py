"""A pilot that knows the map: it follows a polyline, rounded and timed so that the quadrotor can track it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srlrace.config import Config
from srlrace.sim.airframe import GRAVITY, Airframe
from srlrace.world.flyable import Array

PACES = (1.0, 0.7, 0.5, 1.4)  # shares of the limits below that are tried in turn
SPEED = 10.0  # m/s
SIDEWAYS = 20.0  # m/s^2, centripetal
FORWARD = 10.0  # m/s^2, along the path
ROUNDING = 0.6  # m of path that a point is averaged over: a right angle is cut by a ninth of it
GRAIN = 0.05  # m, distance of the points of a rounded path
TIME_CONSTANT = 0.25  # s, in which an error of position or velocity is corrected
TURN_GAIN = 12.0  # 1/s, of the attitude


def plan(legs: Sequence[Array], pace: float, dt: float) -> Array:
    """Time a flight along polylines: position, velocity and acceleration at every control step, (steps, 9)."""
    corners = np.vstack([legs[0][:1], *(leg[1:] for leg in legs)])
    corners = corners[np.concatenate([[True], np.linalg.norm(np.diff(corners, axis=0), axis=1) > 1e-9])]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    beyond = corners[-1] + 2 * (corners[-1] - corners[-2]) / np.linalg.norm(corners[-1] - corners[-2])
    corners, along = np.vstack([corners, beyond]), np.append(along, along[-1] + 2.0)  # m: it flies through the end
    at = np.arange(0.0, along[-1], GRAIN)
    path = np.stack([np.interp(at, along, corners[:, axis]) for axis in range(3)], axis=1)
    half = round(ROUNDING / GRAIN / 4)
    window = np.full(2 * half + 1, 1 / (2 * half + 1))
    for _ in range(2):  # twice a moving average: continuous curvature
        padded = np.pad(path, ((half, half), (0, 0)), mode="edge")
        path = np.stack([np.convolve(axis, window, "valid") for axis in padded.T], axis=1)
    return _timed(path, _speeds(path, pace), dt)


def _speeds(path: Array, pace: float) -> Array:
    """Largest speed at each point of a path, m/s, from rest at its first, within the limits times ``pace``."""
    chords = np.maximum(np.linalg.norm(np.diff(path, axis=0), axis=1), 1e-6)
    tangent = np.diff(path, axis=0) / chords[:, None]
    bend = np.zeros(len(path))
    bend[1:-1] = np.linalg.norm(np.diff(tangent, axis=0), axis=1) / (0.5 * (chords[1:] + chords[:-1]))
    speed = np.minimum(pace * SPEED, np.sqrt(pace * SIDEWAYS / np.maximum(bend, 1e-6)))
    speed[0] = 0.3  # m/s: a start that takes finite time
    gain = 2 * pace * FORWARD * chords
    for k in range(len(chords)):
        speed[k + 1] = min(speed[k + 1], np.sqrt(speed[k] ** 2 + gain[k]))
    for k in range(len(chords) - 1, -1, -1):
        speed[k] = min(speed[k], np.sqrt(speed[k + 1] ** 2 + gain[k]))
    return speed


def _timed(path: Array, speed: Array, dt: float) -> Array:
    chords = np.linalg.norm(np.diff(path, axis=0), axis=1)
    when = np.concatenate([[0.0], np.cumsum(chords / (0.5 * (speed[1:] + speed[:-1])))])
    ticks = np.arange(0.0, when[-1], dt)
    place = np.stack([np.interp(ticks, when, path[:, axis]) for axis in range(3)], axis=1)
    velocity = np.gradient(place, dt, axis=0)
    return np.hstack([place, velocity, np.gradient(velocity, dt, axis=0)])


class Steering:
    """Turns quadrotors to where their thrust gives the accelerations that are wanted."""

    def __init__(self, airframe: Airframe, rates: Sequence[float]) -> None:
        self._most, self._rates = airframe.max_collective, np.array(rates)

    def act(self, state: Array, wanted: Array) -> np.ndarray:
        """Actions (n, 4) in the states (17, n), for accelerations (n, 3) with gravity's reaction, world, m/s^2."""
        x = np.asarray(state, np.float64).T
        w, v = x[:, 6:7], x[:, 7:10]
        up = _turned(w, v, np.broadcast_to([0.0, 0.0, 1.0], v.shape))
        collective = np.sum(wanted * up, axis=1)
        aim = wanted / np.maximum(np.linalg.norm(wanted, axis=1, keepdims=True), 1e-6)
        rates = TURN_GAIN * _turned(w, -v, np.cross(up, aim))
        action = np.hstack([(2 * collective / self._most - 1)[:, None], rates / self._rates])
        action[:, 3] = 0.0
        return np.clip(action, -1, 1).astype(np.float32)


class Pilot:
    """Flies n drones along n planned flights: a position controller on top of the rate controller."""

    def __init__(self, config: Config, plans: Sequence[Array]) -> None:
        airframe = Airframe(config.quad)
        self._steering = Steering(airframe, config.quad.body_rate_max)
        self._drag = float(airframe.drag_acceleration()[:2].mean())
        # Rotors and rate controller lag: the acceleration is that of the plan a little later.
        self._ahead = round((config.quad.rotor_time_constant + 0.1) / config.sim.control_period)
        steps = max(map(len, plans))
        padded = [np.pad(flight, ((0, steps - len(flight)), (0, 0)), mode="edge") for flight in plans]
        self._plan = np.stack(padded, axis=1)  # (steps, n, 9)

    def act(self, state: Array, step: int) -> np.ndarray:
        """Actions (n, 4) for the states (17, n) of a control step."""
        now = self._plan[min(step + 1, len(self._plan) - 1)]
        later = self._plan[min(step + 1 + self._ahead, len(self._plan) - 1)]
        x = np.asarray(state, np.float64).T
        wanted = (now[:, :3] - x[:, :3]) / TIME_CONSTANT**2 + 2 * (now[:, 3:6] - x[:, 3:6]) / TIME_CONSTANT
        wanted += later[:, 6:9] + self._drag * x[:, 3:6] + [0.0, 0.0, GRAVITY]
        return self._steering.act(state, wanted)


def _turned(w: Array, v: Array, vector: Array) -> Array:
    """Vectors (n, 3) turned by unit quaternions."""
    cross = np.cross(v, vector)
    return vector + 2 * (w * cross + np.cross(v, cross))
