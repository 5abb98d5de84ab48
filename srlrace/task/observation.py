"""The observation: named blocks, concatenated in the order of `ObservationConfig.blocks`.

======================  ======  ======================================================  =================
block                   values  meaning                                                 scale
======================  ======  ======================================================  =================
position                3       position, world frame                                   `POSITION_SCALE`
rotation                9       rotation matrix body to world, row by row               1
velocity                3       velocity, world frame                                   `SPEED_SCALE`
body_rate               3       body rates                                              `RATE_SCALE`
targets                 3 j     next j waypoints minus position, world frame            `TARGET_SCALE`
obstacle_distances      N       centre distances, nearest first, padded with the range   `DISTANCE_SCALE`
obstacle_vectors        4 N     unit vector to the centre (world) and that distance     1, `DISTANCE_SCALE`
rays                    R       exp(-d / ray_scale) along fixed directions              1
height                  1       height above the floor                                  `HEIGHT_SCALE`
======================  ======  ======================================================  =================

Vectors are in the world's axes, or with ``frame=target`` in axes that are turned about z so that x points from the
drone to the next waypoint: what is alike in every direction then looks alike. The position stays in the world's.

Scales are constants, not running statistics: a policy file needs nothing but its weights. After the
last waypoint the last one repeats. To add a block: write its function, name it in `BLOCKS` with its
size, and add a line to `observe`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from srlrace.config import ObservationConfig
from srlrace.sim.compile import inline
from srlrace.world.field import cast_rays, nearest_centre

# Ours, found by training. An input's scale decides how fast its weights matter: what is one skill at every waypoint
# (where the next ones are, how fast we fly) is large, what differs from place to place is small.
POSITION_SCALE = 40.0  # m
TARGET_SCALE = 5.0  # m; waypoints are 5-15 m apart
SPEED_SCALE = 5.0  # m/s; flights average 8-13 m/s
RATE_SCALE = 6.0  # rad/s; the largest commanded roll and pitch rate
DISTANCE_SCALE = 20.0  # m; twice the range in which obstacles are seen
HEIGHT_SCALE = 5.0  # m; as targets, whose heights differ by about this

BLOCKS: dict[str, Callable[[ObservationConfig], int]] = {
    "position": lambda _: 3,
    "rotation": lambda _: 9,
    "velocity": lambda _: 3,
    "body_rate": lambda _: 3,
    "targets": lambda o: 3 * o.targets,
    "obstacle_distances": lambda o: o.obstacles,
    "obstacle_vectors": lambda o: 4 * o.obstacles,
    "rays": lambda o: o.rays,
    "height": lambda _: 1,
}
(
    POSITION, ROTATION, VELOCITY, BODY_RATE, TARGETS, OBSTACLE_DISTANCES, OBSTACLE_VECTORS, RAYS, HEIGHT
) = range(len(BLOCKS))  # fmt: skip


def block_codes(observation: ObservationConfig) -> NDArray[np.int64]:
    """Return the blocks as indices into `BLOCKS`, the form in which the kernel takes them."""
    names = list(BLOCKS)
    return np.array([names.index(block) for block in observation.blocks], np.int64)


def observation_size(observation: ObservationConfig) -> int:
    """Return the number of values in an observation."""
    return sum(BLOCKS[block](observation) for block in observation.blocks)


@inline
def write_rotation(state, i, out, at):
    """Write R(q), body to world, row by row."""
    w, x, y, z = state[6, i], state[7, i], state[8, i], state[9, i]
    two = state.dtype.type(2.0)
    one = state.dtype.type(1.0)
    out[at + 0] = one - two * (y * y + z * z)
    out[at + 1] = two * (x * y - w * z)
    out[at + 2] = two * (x * z + w * y)
    out[at + 3] = two * (x * y + w * z)
    out[at + 4] = one - two * (x * x + z * z)
    out[at + 5] = two * (y * z - w * x)
    out[at + 6] = two * (x * z - w * y)
    out[at + 7] = two * (y * z + w * x)
    out[at + 8] = one - two * (x * x + y * y)


@inline
def facing(fleet, rules, i):
    """Return cosine and sine of the angle about z from the world's x axis to that of the observation."""
    cos, sin = fleet.state.dtype.type(1.0), fleet.state.dtype.type(0.0)
    if rules.facing:
        w = rules.sequence[min(fleet.target[i], rules.sequence.shape[0] - 1)]
        dx, dy = fleet.waypoints[w, 0, i] - fleet.state[0, i], fleet.waypoints[w, 1, i] - fleet.state[1, i]
        length = math.sqrt(dx * dx + dy * dy)
        if length > 1e-3:
            cos, sin = fleet.state.dtype.type(dx / length), fleet.state.dtype.type(dy / length)
    return cos, sin


@inline
def turn(out, at, step, cos, sin):
    """Turn a horizontal vector, the values at ``at`` and ``at + step``, into the axes of the observation."""
    x, y = out[at], out[at + step]
    out[at], out[at + step] = cos * x + sin * y, cos * y - sin * x


@inline
def write_scaled(state, row, i, scale, out, at):
    """Write three rows of the state, divided by ``scale``."""
    for axis in range(3):
        out[at + axis] = state[row + axis, i] * (1.0 / scale)


@inline
def write_targets(fleet, rules, i, out, at):
    """Write the next waypoints relative to the drone; past the end the last one repeats."""
    last = rules.sequence.shape[0] - 1
    for ahead in range(rules.targets):
        w = rules.sequence[min(fleet.target[i] + ahead, last)]
        for axis in range(3):
            out[at + 3 * ahead + axis] = (fleet.waypoints[w, axis, i] - fleet.state[axis, i]) * (1.0 / TARGET_SCALE)


@inline
def write_vectors(fleet, field, i, distance, index, out, at):
    """Write direction and distance of each obstacle; an empty slot has no direction."""
    for k in range(distance.shape[0]):
        slot = at + 4 * k
        out[slot + 3] = distance[k] * (1.0 / DISTANCE_SCALE)
        if index[k] < 0:
            out[slot], out[slot + 1], out[slot + 2] = 0.0, 0.0, 0.0
            continue
        x, y, z = fleet.state[0, i], fleet.state[1, i], fleet.state[2, i]
        cx, cy, cz = nearest_centre(index[k], x, y, z, field[0])
        inverse = 1.0 / max(distance[k], 1e-6)
        out[slot], out[slot + 1], out[slot + 2] = (cx - x) * inverse, (cy - y) * inverse, (cz - z) * inverse


@inline
def wall_distance(position, direction, low, high):
    """Distance along a ray, of which ``direction`` is one coordinate, to where that coordinate leaves the world."""
    if direction > 0.0:
        gap, speed = high - position, direction
    else:
        gap, speed = position - low, -direction
    return max(gap, 0.0) / max(speed, 1e-6)


@inline
def write_rays(fleet, rules, field, i, cos, sin, out, at):
    """Write exp(-d / ray_scale) of horizontal rays to inflated obstacles and, where asked, to the world's walls."""
    rays = out[at : at + rules.rays]
    x, y, z = fleet.state[0, i], fleet.state[1, i], fleet.state[2, i]
    cast_rays(x, y, z, fleet.map[i], *field, rules.keep_out, rules.reach, cos, sin, rules.directions, rays)
    if rules.ray_walls:
        for k in range(rules.rays):
            ahead, left = rules.directions[0, k], rules.directions[1, k]
            rays[k] = min(rays[k], wall_distance(x, cos * ahead - sin * left, rules.bounds[0], rules.bounds[3]))
            rays[k] = min(rays[k], wall_distance(y, sin * ahead + cos * left, rules.bounds[1], rules.bounds[4]))
    for k in range(rules.rays):
        rays[k] = math.exp(-rays[k] / rules.ray_scale)


@inline
def observe(fleet, rules, field, i, distance, index, out):
    """Write the observation of drone ``i`` to ``out``, shape (observation_size,).

    ``distance`` and ``index`` (N,) are the nearest obstacles as `srlrace.world.field.nearest` gives them.
    """
    cos, sin = facing(fleet, rules, i)
    at = 0
    for code in rules.blocks:
        if code == POSITION:
            write_scaled(fleet.state, 0, i, POSITION_SCALE, out, at)
            at += 3
        elif code == ROTATION:
            write_rotation(fleet.state, i, out, at)
            for column in range(3):
                turn(out, at + column, 3, cos, sin)
            at += 9
        elif code == VELOCITY:
            write_scaled(fleet.state, 3, i, SPEED_SCALE, out, at)
            turn(out, at, 1, cos, sin)
            at += 3
        elif code == BODY_RATE:
            write_scaled(fleet.state, 10, i, RATE_SCALE, out, at)
            at += 3
        elif code == TARGETS:
            write_targets(fleet, rules, i, out, at)
            for _ in range(rules.targets):
                turn(out, at, 1, cos, sin)
                at += 3
        elif code == OBSTACLE_DISTANCES:
            for k in range(distance.shape[0]):
                out[at + k] = distance[k] * (1.0 / DISTANCE_SCALE)
            at += distance.shape[0]
        elif code == OBSTACLE_VECTORS:
            write_vectors(fleet, field, i, distance, index, out, at)
            for _ in range(distance.shape[0]):
                turn(out, at, 1, cos, sin)
                at += 4
        elif code == RAYS:
            write_rays(fleet, rules, field, i, cos, sin, out, at)
            at += rules.rays
        elif code == HEIGHT:
            out[at] = (fleet.state[2, i] - rules.bounds[2]) * (1.0 / HEIGHT_SCALE)
            at += 1
