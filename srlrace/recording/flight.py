"""One flown episode as the recording stores it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vec3 = tuple[float, float, float]

_WIDTHS = {
    "position_w": 3,
    "velocity_w": 3,
    "quaternion_wb": 4,
    "body_rate_b": 3,
    "rotor_thrust": 4,
    "action": 4,
}
"""Columns of each array of a `Flight` that has one row per time."""


@dataclass(frozen=True)
class SceneObstacle:
    """An obstacle as it is drawn: a sphere, an upright cylinder or an axis-aligned cube."""

    kind: str  # sphere, cylinder or box
    center: Vec3  # m, world
    radius: float = 0.0  # m, sphere and cylinder
    height: float = 0.0  # m, cylinder
    edge: float = 0.0  # m, box

    def __post_init__(self) -> None:
        if self.kind not in ("sphere", "cylinder", "box"):
            raise ValueError(f"unknown kind of obstacle {self.kind!r}: sphere, cylinder or box expected")


@dataclass(frozen=True, eq=False)
class Flight:
    """The trajectory of one episode: T states, each with the action and reward of the step that led to it.

    Arrays of any real type are taken. Raises ValueError when shapes do not agree or times do not increase.
    """

    episode: int  # number within the evaluation
    seed: int  # of the episode's initial condition
    map_seed: int
    outcome: str  # finished, crashed, out_of_bounds, timeout or diverged
    finish_time: float | None  # s, None unless finished
    time: Array  # (T,) s since the reset, increasing
    position_w: Array  # (T, 3) m, world
    velocity_w: Array  # (T, 3) m/s, world
    quaternion_wb: Array  # (T, 4) w x y z, body to world
    body_rate_b: Array  # (T, 3) rad/s, body
    rotor_thrust: Array  # (T, 4) N
    action: Array  # (T, 4) commanded collective thrust m/s^2 and body rates rad/s
    reward_terms: Array  # (T, R) in the order of the writer's names
    clearance: Array  # (T,) m, from the drone's centre to the nearest obstacle's surface
    target: NDArray[np.int_]  # (T,) index of the waypoint flown to
    waypoints: Array  # (W, 3) m, world, as placed in this episode
    scene: tuple[SceneObstacle, ...] = ()

    def __post_init__(self) -> None:
        steps = len(self.time)
        shapes = {name: (steps, width) for name, width in _WIDTHS.items()}
        shapes |= {"time": (steps,), "clearance": (steps,), "target": (steps,)}  # type: ignore[dict-item]
        for name, shape in shapes.items():
            if (found := np.shape(getattr(self, name))) != shape:
                raise ValueError(f"episode {self.episode}: {name} has shape {found}, expected {shape}")
        if np.ndim(self.reward_terms) != 2 or len(self.reward_terms) != steps:
            raise ValueError(f"episode {self.episode}: reward_terms must have one row per time")
        if np.ndim(self.waypoints) != 2 or np.shape(self.waypoints)[1] != 3:
            raise ValueError(f"episode {self.episode}: waypoints must have shape (W, 3)")
        times = np.asarray(self.time, np.float64)
        if steps == 0 or not np.isfinite(times).all() or times[0] < 0 or (np.diff(times) <= 0).any():
            raise ValueError(f"episode {self.episode}: times must be finite, increasing and not negative")
