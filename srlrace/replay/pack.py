"""Flights and their surroundings as the JSON data of a replay page.

Every value of a flight becomes 16 bits between the least and the largest of its column in that flight: positions
are then exact to 0.4 mm on 50 m, speeds to 0.2 mm/s on 25 m/s, thrusts to 0.07 mN on 8.5 N. Times stay float32.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srlrace.config import Config
from srlrace.recording import Flight, SceneObstacle
from srlrace.sim.airframe import GRAVITY
from srlrace.world import obstacles as world
from srlrace.world.track import target_sequence

COLUMNS = ("position_w", "velocity_w", "quaternion_wb", "body_rate_b", "rotor_thrust", "action", "clearance")
LEVELS = 65_534  # steps between the least and the largest value
MISSING = 65_535  # stands for values that are not finite
MILLIMETRES = 4  # decimals of a metre that places and sizes in the scene keep


def pack_flight(flight: Flight) -> dict[str, Any]:
    """A flight's arrays: ``scale`` (columns, 2) least value and step, ``values`` (columns, T) uint16 in base64."""
    table = np.column_stack([np.asarray(getattr(flight, name), np.float64) for name in COLUMNS]).T
    low, step, levels = quantise(table)
    return {
        "steps": len(flight.time),
        "time": _base64(np.asarray(flight.time, "<f4")),
        "scale": np.stack([low, step], axis=1).tolist(),
        "values": _base64(levels.astype("<u2")),
        "target": _base64(np.asarray(flight.target, "<u2")),
        "waypoints": _rounded(flight.waypoints),
    }


def quantise(table: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint16]]:
    """Least value and step of each row of (rows, T), and its values in steps; what is not finite is `MISSING`."""
    finite = np.isfinite(table)
    low = np.where(finite, table, np.inf).min(axis=1)
    high = np.where(finite, table, -np.inf).max(axis=1)
    low, high = (np.where(np.isfinite(end), end, 0.0) for end in (low, high))
    step = np.where(high > low, (high - low) / LEVELS, 1.0)
    levels = np.rint((np.where(finite, table, low[:, None]) - low[:, None]) / step[:, None])
    return low, step, np.where(finite, levels, MISSING).astype(np.uint16)


def pack_obstacles(scene: Sequence[SceneObstacle]) -> dict[str, list[list[float]]]:
    """Obstacles by kind, with the spheres that stand for them when they collide (`srlrace.world.obstacles`).

    sphere: x, y, z, radius; cylinder: x, y, z, radius, height, z of the lowest and of the highest sphere;
    box: x, y, z, edge, spheres along an edge, their radius. In m.
    """
    packed: dict[str, list[list[float]]] = {"sphere": [], "cylinder": [], "box": []}
    for drawn in scene:
        packed[drawn.kind].append(_rounded(np.array([*drawn.center, *_shape(drawn)])))
    return packed


def _shape(drawn: SceneObstacle) -> tuple[float, ...]:
    if drawn.kind == "sphere":
        return (drawn.radius,)
    if drawn.kind == "cylinder":
        solid = world.cylinder(drawn.center, drawn.radius, drawn.height)
        low = solid.origin[2]
        return drawn.radius, drawn.height, low, low + solid.pitch[2] * (solid.count[2] - 1)
    solid = world.box(drawn.center, drawn.edge)
    return drawn.edge, solid.count[0], solid.sphere_radius


def pack_course(config: Config) -> dict[str, Any]:
    """What all flights of a page share: the world's bounds, the order of the gates, and sizes of the drone."""
    track, quad = config.env, config.quad
    return {
        "name": track.name,
        "low": list(track.bounds_low),
        "high": list(track.bounds_high),
        "sequence": list(target_sequence(track)),
        "gates": len(track.waypoints),
        "laps": track.laps,
        "passingRadius": track.passing_radius,
        "keepOut": config.keep_out,
        "armLength": quad.arm_length,
        "mass": quad.mass,
        "gravity": GRAVITY,
        "thrustMax": quad.thrust_max,
        "rateMax": list(quad.body_rate_max),
    }


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _rounded(array: NDArray[np.float64]) -> Any:
    return np.round(np.asarray(array, np.float64), MILLIMETRES).tolist()
