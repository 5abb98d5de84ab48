"""What stands around a flight, as a foxglove.SceneUpdate: obstacles, gates and the flown path."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from srlrace.recording.flight import Flight, SceneObstacle
from srlrace.recording.schema import WORLD_FRAME

OBSTACLES, GATES, PATH = "obstacles", "gates", "path"
"""Ids of the entities: each episode's replace the ones before."""

_OBSTACLE_COLOR = Color(r=0.45, g=0.47, b=0.50, a=0.9)
_GATE_COLOR = Color(r=0.90, g=0.62, b=0.0, a=0.6)
_PATH_COLOR = Color(r=0.0, g=0.45, b=0.70, a=0.9)
_PATH_WIDTH = 2.0
"""Pixels."""


def _pose(center: tuple[float, float, float]) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = center
    pose.orientation.w = 1.0
    return pose


def _add_sphere(entity: SceneEntity, shape: SceneObstacle, color: Color) -> None:
    sphere = entity.spheres.add(pose=_pose(shape.center), color=color)
    sphere.size.x = sphere.size.y = sphere.size.z = 2 * shape.radius


def _add_cylinder(entity: SceneEntity, shape: SceneObstacle, color: Color) -> None:
    cylinder = entity.cylinders.add(pose=_pose(shape.center), color=color, bottom_scale=1.0, top_scale=1.0)
    cylinder.size.x = cylinder.size.y = 2 * shape.radius
    cylinder.size.z = shape.height


def _add_box(entity: SceneEntity, shape: SceneObstacle, color: Color) -> None:
    cube = entity.cubes.add(pose=_pose(shape.center), color=color)
    cube.size.x = cube.size.y = cube.size.z = shape.edge


_ADD: dict[str, Callable[[SceneEntity, SceneObstacle, Color], None]] = {
    "sphere": _add_sphere,
    "cylinder": _add_cylinder,
    "box": _add_box,
}


@lru_cache(maxsize=256)
def _obstacles(scene: tuple[SceneObstacle, ...]) -> bytes:
    """The obstacles' entity without its timestamp; an evaluation draws its episodes from a few maps."""
    entity = SceneEntity(frame_id=WORLD_FRAME, id=OBSTACLES)
    for obstacle in scene:
        _ADD[obstacle.kind](entity, obstacle, _OBSTACLE_COLOR)
    return entity.SerializeToString(deterministic=True)


def scene_message(flight: Flight, passing_radius: float, seconds: int, nanos: int) -> bytes:
    """One serialised scene of an episode; gates are spheres of the radius within which they are passed [m]."""
    update = SceneUpdate()
    update.entities.add().MergeFromString(_obstacles(flight.scene))
    gates = update.entities.add(frame_id=WORLD_FRAME, id=GATES)
    for x, y, z in flight.waypoints.tolist():
        _add_sphere(gates, SceneObstacle("sphere", (x, y, z), passing_radius), _GATE_COLOR)
    path = update.entities.add(frame_id=WORLD_FRAME, id=PATH)
    line = path.lines.add(type=LinePrimitive.LINE_STRIP, thickness=_PATH_WIDTH, scale_invariant=True, color=_PATH_COLOR)
    for x, y, z in flight.position_w.tolist():
        line.points.add(x=x, y=y, z=z)
    for entity in update.entities:
        entity.timestamp.seconds, entity.timestamp.nanos = seconds, nanos
    return update.SerializeToString(deterministic=True)


def parse_scene(data: bytes) -> tuple[np.ndarray, tuple[SceneObstacle, ...]]:
    """Waypoints (W, 3) m and obstacles of a serialised scene; obstacles come grouped by kind."""
    entities = {entity.id: entity for entity in SceneUpdate.FromString(data).entities}
    waypoints = [_center(sphere.pose) for sphere in entities[GATES].spheres]
    shapes = entities[OBSTACLES]
    obstacles = [SceneObstacle("sphere", _center(s.pose), radius=s.size.x / 2) for s in shapes.spheres]
    obstacles += [
        SceneObstacle("cylinder", _center(s.pose), radius=s.size.x / 2, height=s.size.z) for s in shapes.cylinders
    ]
    obstacles += [SceneObstacle("box", _center(s.pose), edge=s.size.x) for s in shapes.cubes]
    return np.array(waypoints, np.float64).reshape(-1, 3), tuple(obstacles)


def _center(pose: Pose) -> tuple[float, float, float]:
    return pose.position.x, pose.position.y, pose.position.z
