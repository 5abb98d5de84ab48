"""Races in a disturbed world: the plant, the air and the estimate differ from what policy and rate controller believe.

Nothing of it is used in training. Everything random here depends on the race's seed and the episode's number alone, so
that every policy meets the same wind and the same errors (common random numbers).

Mass
    The thrust accelerates ``mass`` times the mass that the controller reckons with. The inertia stays, as with ballast
    at the centre; the drag *force* stays too, so that the mass-normalised drag falls as the mass grows.
Wind
    The air moves at a constant velocity w, and drag acts on v - w. In axes that move with the air the equations are
    those of still air, so a step subtracts w from the velocity, flies, and adds it again and w dt to the position. This
    is exact, also for each Runge-Kutta stage, and the dynamics kernel stays as it is.
Delay
    Actions wait in line. Until the first arrives, the drone is told to hover level.
Noise
    Errors of position, velocity and attitude follow first-order Gauss-Markov processes. The policy sees what the drone
    would see at the estimated place: in the map that it believes in, distances to obstacles are off as its position is.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike, NDArray

from srlrace.config import Config
from srlrace.schema import DisturbanceConfig
from srlrace.sim.airframe import ACCELERATION, GRAVITY
from srlrace.task.arrays import Floats, Output
from srlrace.task.race import ACTION_SIZE, Race, RaceMode
from srlrace.world.field import ObstacleField

Array = NDArray[np.float64]

WIND_STREAM, NOISE_STREAM = 0x71D, 0x015E  # keep these draws apart from all others that start from the same seed


class DisturbedRace(Race):
    """A race whose world is disturbed; for evaluation, where no episode begins within a step."""

    def __init__(
        self,
        config: Config,
        mode: RaceMode,
        field: ObstacleField,
        disturbance: DisturbanceConfig,
        dtype: DTypeLike = np.float32,
    ) -> None:
        """Raises ValueError for a delay that is not a whole number of control periods."""
        if mode.autoreset:
            raise ValueError("a disturbed race is for evaluation: its episodes do not restart")
        super().__init__(config, mode, field, dtype)
        self.disturbance = disturbance
        self._late = periods(disturbance.delay, config.sim.control_period)
        airframe = self.rules.airframe.copy()
        airframe[ACCELERATION] /= disturbance.mass
        wind = draw_wind(disturbance.wind, mode).astype(dtype)
        self.rules = self.rules._replace(airframe=airframe, wind=wind)
        self._errors = EstimateErrors(disturbance, mode, config.sim.control_period)
        self._waiting: list[NDArray[np.float32]] = []

    def reset(self) -> Floats:
        """Start a new episode of every drone; return the observations, (n, d)."""
        super().reset()
        self.fleet.plant[:3] *= self.disturbance.drag / self.disturbance.mass
        self.fleet.plant[3] *= self.disturbance.thrust
        hover = np.zeros((self.n, ACTION_SIZE), np.float32)
        hover[:, 0] = 2.0 * GRAVITY / self.rules.max_collective - 1.0
        self._waiting = [hover] * self._late
        self._errors.restart()
        self._mistake()
        return self.output.observation

    def step(self, action: NDArray[np.float32]) -> Output:
        """Advance every drone by one control step; ``action`` (n, 4) takes effect after the delay."""
        self._waiting.append(action.copy())
        super().step(self._waiting.pop(0))
        self._mistake()
        return self.output

    def _mistake(self) -> None:
        """Show the policy the estimate instead of the state."""
        if not self._errors.any:
            return
        error = self._errors.advance()
        state = self.fleet.state.copy()
        state[:6] += error[:6]
        state[6:10] = turned(state[6:10], error[6:])
        self.observe(state)


class EstimateErrors:
    """Errors (9, n) of position, m, velocity, m/s, and attitude, rad about the body axes, step after step."""

    def __init__(self, disturbance: DisturbanceConfig, mode: RaceMode, period: float) -> None:
        d = disturbance
        self._scale = np.repeat([d.position_noise, d.velocity_noise, d.attitude_noise], 3)[:, None]
        self._kept = math.exp(-period / d.noise_time) if d.noise_time > 0.0 else 0.0
        self._mode = mode
        self.restart()

    @property
    def any(self) -> bool:
        """Whether there are errors at all."""
        return bool(self._scale.any())

    def restart(self) -> None:
        """Begin anew, with errors of the size that they keep."""
        self._steps, self._now = 0, np.zeros((9, len(self._mode.members)))

    def advance(self) -> Array:
        """Return the errors of the next step."""
        fresh = draws(self._mode, (NOISE_STREAM, self._steps), 9)
        kept = self._kept if self._steps else 0.0
        self._now = kept * self._now + math.sqrt(1.0 - kept * kept) * fresh
        self._steps += 1
        return self._scale * self._now


def draws(mode: RaceMode, stream: tuple[int, ...], count: int) -> Array:
    """Return standard normal numbers (count, n); each member's depend on the seed, the stream and itself alone."""
    rng = np.random.default_rng((mode.seed, *stream))
    return rng.standard_normal((int(mode.members.max()) + 1, count))[mode.members].T


def draw_wind(speed: float, mode: RaceMode) -> Array:
    """Return the wind of each member (3, n), m/s, world; (3, 0) where there is none."""
    if not speed:
        return np.zeros((3, 0))
    x, y = draws(mode, (WIND_STREAM,), 2)
    return speed * np.stack([x, y, np.zeros_like(x)]) / np.hypot(x, y)


def turned(quaternion: Floats, angles: Array) -> Array:
    """Return quaternions (4, n) turned by rotation vectors (3, n), rad, about their own axes."""
    half = 0.5 * np.linalg.norm(angles, axis=0)
    w, (x, y, z) = np.cos(half), angles * 0.5 * np.sinc(half / np.pi)
    a, b, c, d = quaternion.astype(np.float64)
    product = np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )
    return product / np.linalg.norm(product, axis=0)


def periods(delay: float, period: float) -> int:
    """Return a delay in control periods; raises ValueError where it is not a whole number of them."""
    count = round(delay / period)
    if abs(count * period - delay) > 1e-6:
        raise ValueError(f"a delay of {1000 * delay:g} ms is no multiple of the control period, {1000 * period:g} ms")
    return count
