"""Obstacles as spheres: every obstacle is a regular, axis-aligned lattice of equal spheres.

A sphere is a 1 x 1 x 1 lattice, a tree or cylinder a 1 x 1 x k stack, a box a k x k x k block. The sphere of a
lattice nearest to a point follows from rounding the point's lattice coordinates, so that a query costs the same
whatever the number of spheres (`srlrace.world.field`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srlrace.config import ObstacleConfig, Vec3

# Spheres of a stack stand at most this share of their radius apart: between two of them the stack is then no
# thinner than sqrt(1 - 1/16) = 97 % of its radius. Not in the paper: ours.
STACK_PITCH = 0.5
# The spheres of a box stick out of its faces by at most this, in m. Not in the paper: ours.
BOX_OVERSHOOT = 0.1


@dataclass(frozen=True)
class Obstacle:
    """One obstacle: the shape as its author drew it, and the lattice of spheres that stands for it.

    Nearest-obstacle distances are to the closest sphere centre; collisions use that distance and `sphere_radius`.
    """

    kind: str  # sphere | cylinder | box
    center: Vec3  # m, world
    size: Vec3  # m, full extent of the shape along x, y, z
    origin: Vec3  # m, world: the lattice's lowest sphere centre
    pitch: Vec3  # m, distance of lattice neighbours along x, y, z
    count: tuple[int, int, int]  # spheres along x, y, z
    sphere_radius: float  # m

    def spheres(self) -> NDArray[np.float64]:
        """Centres of all spheres, shape (m, 3), m, world."""
        axes = [o + p * np.arange(n) for o, p, n in zip(self.origin, self.pitch, self.count, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def sphere(center: Vec3, radius: float) -> Obstacle:
    """A single sphere of `radius` m."""
    return _lattice("sphere", center, (2 * radius,) * 3, (1, 1, 1), radius)


def cylinder(center: Vec3, radius: float, height: float) -> Obstacle:
    """An upright cylinder (or tree) as a stack of spheres of its own radius, evenly spread over its height."""
    layers = max(1, math.ceil(height / (STACK_PITCH * radius) - 1e-9))
    return _lattice("cylinder", center, (2 * radius, 2 * radius, height), (1, 1, layers), radius)


def box(center: Vec3, edge: float) -> Obstacle:
    """An axis-aligned cube as k x k x k spheres, each just around one of k^3 equal parts of the cube.

    Together they cover the cube and stick out of each face by (sqrt(3) - 1) edge / (2 k); the smallest k
    that keeps this below `BOX_OVERSHOOT` is taken.
    """
    k = max(1, math.ceil((math.sqrt(3) - 1) * edge / (2 * BOX_OVERSHOOT)))
    return _lattice("box", center, (edge,) * 3, (k, k, k), math.sqrt(3) * edge / (2 * k))


def from_config(config: ObstacleConfig) -> Obstacle:
    """Turn a described obstacle into spheres.

    Raises ValueError where the shape lacks a size.
    """
    for name in {"sphere": ("radius",), "cylinder": ("radius", "height"), "box": ("edge",)}.get(config.kind, ()):
        if not getattr(config, name) > 0:
            raise ValueError(f"a {config.kind} obstacle needs a positive {name} in m (at {config.center})")
    if config.kind == "sphere":
        return sphere(config.center, config.radius)
    if config.kind == "cylinder":
        return cylinder(config.center, config.radius, config.height)
    if config.kind == "box":
        return box(config.center, config.edge)
    raise ValueError(f"unknown kind of obstacle {config.kind!r}: use sphere, cylinder or box")


def _lattice(kind: str, center: Vec3, size: Vec3, count: tuple[int, int, int], radius: float) -> Obstacle:
    """Spread `count` spheres evenly: the shape is cut in equal parts and a sphere sits in the middle of each."""
    pitch = tuple(s / n for s, n in zip(size, count, strict=True))
    origin = tuple(c - 0.5 * p * (n - 1) for c, p, n in zip(center, pitch, count, strict=True))
    return Obstacle(kind, center, size, _vec3(origin), _vec3(pitch), count, radius)


def _vec3(values: tuple[float, ...]) -> Vec3:
    x, y, z = values
    return (float(x), float(y), float(z))
