"""What is to be flown as fast as possible: track, obstacles and airframe in numbers, and the key of its solution."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srlrace.schema import Config, QuadConfig, TrackConfig, Vec3
from srlrace.sim.airframe import Airframe
from srlrace.world.levels import generate_map
from srlrace.world.obstacles import Obstacle
from srlrace.world.track import target_sequence

REVISION = 1  # of the method: a change that moves results makes older ones obsolete
DIGITS = 6  # of a coordinate in the key, m: the last bits of a cosine differ between machines
KINDS = ("lap", "race")


@dataclass(frozen=True)
class Problem:
    """A time-optimal problem.

    A lap is periodic: it ends in the state that it began in, at the last waypoint; it has no start. Everything else
    begins at rest, level, at the start.
    """

    waypoints: tuple[Vec3, ...]  # m, world, in the order of passing
    start: Vec3 | None  # m, world; None: a periodic lap
    stop: bool  # whether the flight ends at rest
    passing_radius: float  # m
    bounds_low: Vec3  # m, world
    bounds_high: Vec3  # m, world
    quad: QuadConfig
    obstacles: tuple[Obstacle, ...]
    keep_out: float  # m, the drone's centre stays this far from every sphere's surface

    @property
    def lap(self) -> bool:
        """Whether the flight is a periodic lap."""
        return self.start is None

    @property
    def drag(self) -> NDArray[np.float64]:
        """Drag along the body axes (3,), 1/s."""
        return Airframe(self.quad).drag_acceleration()

    @property
    def max_collective(self) -> float:
        """Largest collective acceleration, m/s^2."""
        return Airframe(self.quad).max_collective

    @property
    def key(self) -> str:
        """Name of the solution: a hash of all that it depends on."""
        quad = {name: getattr(self.quad, name) for name in QUAD}
        solids = sorted(_rounded([*o.origin, *o.pitch, *o.count, o.sphere_radius]) for o in self.obstacles)
        track = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in ("quad", "obstacles")}
        data = {"revision": REVISION, "track": _rounded(track), "quad": quad, "obstacles": solids}
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


# What the model takes of a quadrotor: no rotor lag, no rate controller.
QUAD = ("mass", "inertia", "arm_length", "torque_constant", "thrust_max", "body_rate_max", "drag", "drag_model")


def problem_of(config: Config, kind: str = "lap", stop: bool = False, obstacles: bool = True) -> Problem:
    """Return the problem that a training configuration poses, on the first of its maps.

    On a lap track ``kind`` chooses between the flying lap and the whole race from rest; a course has only the race.
    """
    track = config.env
    lap = track.laps > 0 and kind == "lap"
    drawn = generate_map(track, config.level, 0) if obstacles else ()
    return Problem(
        waypoints=tuple(track.waypoints[i] for i in passing_order(track, lap)),
        start=None if lap else track.start,
        stop=stop,
        passing_radius=track.passing_radius,
        bounds_low=track.bounds_low,
        bounds_high=track.bounds_high,
        quad=config.quad,
        obstacles=drawn,
        keep_out=config.keep_out if drawn else 0.0,
    )


def passing_order(track: TrackConfig, lap: bool) -> tuple[int, ...]:
    """Indices of the waypoints in the order of passing; a flying lap begins after the first and ends there."""
    return (*range(1, len(track.waypoints)), 0) if lap else target_sequence(track)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_rounded(item) for item in value]
    return round(value, DIGITS) + 0.0 if isinstance(value, float) else value
