"""Flights for Rerun's viewer, as an RRD file.

Rerun reads a recording's states and poses from the MCAP itself, but maps no foxglove.SceneUpdate (0.41): the drone
would move through an empty world, and a pose alone is not drawn. This writes what it draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srlrace.config import Config
from srlrace.recording import Flight, SceneObstacle
from srlrace.runs import RunError

TIMELINE = "flight_time"
APPLICATION = "srlrace"
BODY = (0.11, 0.06, 0.03)  # m, half sizes of the drawn hull
OBSTACLE, GATE, PATH = (140, 150, 160), (230, 159, 0), (0, 114, 178)
ROTORS = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # signs of x and y, in the order of the recorded thrusts
THRUST = 0.05  # m of an arrow per N
SERIES = {"speed": "m/s", "clearance": "m"}


def write_rrd(path: Path, name: str, config: Config, flights: Sequence[Flight]) -> None:
    """Write flights with their surroundings; raises `RunError` when the Rerun SDK is not installed."""
    try:
        import rerun as rr
    except ImportError:
        raise RunError("writing .rrd files takes Rerun's SDK: pip install 'srlrace[rerun]'") from None
    stream = rr.RecordingStream(APPLICATION, recording_id=name)
    stream.save(path, default_blueprint=_blueprint())
    stream.send_recording_name(name)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_world(rr, stream, config, flights[0])
    for flight in flights:
        _log_flight(rr, stream, config, flight)
    stream.flush()
    stream.disconnect()


def _log_world(rr: Any, stream: Any, config: Config, flight: Flight) -> None:
    shapes: dict[str, list[SceneObstacle]] = {"sphere": [], "cylinder": [], "box": []}
    for obstacle in flight.scene:
        shapes[obstacle.kind].append(obstacle)
    spheres, cylinders, boxes = shapes["sphere"], shapes["cylinder"], shapes["box"]
    solid = {"fill_mode": "solid", "colors": OBSTACLE}
    drawn = {
        "spheres": rr.Ellipsoids3D(centers=[o.center for o in spheres], radii=[o.radius for o in spheres], **solid),
        "cylinders": rr.Cylinders3D(
            centers=[o.center for o in cylinders],
            radii=[o.radius for o in cylinders],
            lengths=[o.height for o in cylinders],
            **solid,
        ),
        "boxes": rr.Boxes3D(centers=[o.center for o in boxes], half_sizes=[[o.edge / 2] * 3 for o in boxes], **solid),
    }
    for kind, shape in drawn.items():
        stream.log(f"world/obstacles/{kind}", shape, static=True)
    gates = rr.Ellipsoids3D(
        centers=flight.waypoints,
        radii=[config.env.passing_radius] * len(flight.waypoints),
        colors=GATE,
        labels=[str(number + 1) for number in range(len(flight.waypoints))],
    )
    stream.log("world/gates", gates, static=True)
    low, high = np.array(config.env.bounds_low), np.array(config.env.bounds_high)
    stream.log("world/bounds", rr.Boxes3D(mins=[low], sizes=[high - low]), static=True)


def _log_flight(rr: Any, stream: Any, config: Config, flight: Flight) -> None:
    place = f"world/episode_{flight.episode}"
    stream.log(f"{place}/path", rr.LineStrips3D([flight.position_w], colors=PATH), static=True)
    drone = f"{place}/drone"
    arm = config.quad.arm_length / np.sqrt(2)
    rotors = np.array([[x * arm, y * arm, 0.0] for x, y in ROTORS])
    stream.log(f"{drone}/hull", rr.Boxes3D(half_sizes=[BODY], fill_mode="solid"), static=True)
    stream.log(f"{drone}/arms", rr.LineStrips3D([rotors[[0, 2]], rotors[[1, 3]]]), static=True)
    when = [rr.TimeColumn(TIMELINE, duration=np.asarray(flight.time, np.float64))]
    turned = np.asarray(flight.quaternion_wb)[:, [1, 2, 3, 0]]
    pose = rr.Transform3D.columns(translation=flight.position_w, quaternion=turned)
    stream.send_columns(drone, indexes=when, columns=pose)
    steps = len(flight.time)
    arrows = np.zeros((steps, 4, 3))
    arrows[:, :, 2] = THRUST * flight.rotor_thrust
    thrusts = rr.Arrows3D.columns(
        vectors=arrows.reshape(-1, 3), origins=np.tile(rotors, (steps, 1)), colors=np.full((steps * 4, 3), GATE)
    ).partition([4] * steps)
    stream.send_columns(f"{drone}/thrusts", indexes=when, columns=thrusts)
    values = {"speed": np.linalg.norm(flight.velocity_w, axis=1), "clearance": flight.clearance}
    for series, column in values.items():
        line = f"{series}/episode_{flight.episode}"
        stream.send_columns(line, indexes=when, columns=rr.Scalars.columns(scalars=column))


def _blueprint() -> Any:
    """The world large, speed and clearance beside it."""
    import rerun.blueprint as rrb

    plots = [rrb.TimeSeriesView(origin=f"/{series}", name=f"{series}, {unit}") for series, unit in SERIES.items()]
    world = rrb.Spatial3DView(origin="/world", name="flight")
    return rrb.Blueprint(rrb.Horizontal(world, rrb.Vertical(*plots), column_shares=[3, 1]), collapse_panels=True)
