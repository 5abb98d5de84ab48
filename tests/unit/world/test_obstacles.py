"""Obstacles as sphere lattices cover what they stand for, and not much more."""

import math

import numpy as np
import pytest

from srlrace.config import ObstacleConfig
from srlrace.world.obstacles import BOX_OVERSHOOT, box, cylinder, from_config, sphere


def test_sphere_is_itself() -> None:
    ball = sphere((1.0, 2.0, 3.0), 0.4)
    assert ball.spheres().tolist() == [[1.0, 2.0, 3.0]]
    assert ball.sphere_radius == 0.4


def test_cylinder_stands_between_its_ends() -> None:
    tree = cylinder((1.0, -2.0, 3.0), 0.3, 6.0)
    spheres = tree.spheres()
    assert np.allclose(spheres[:, :2], [1.0, -2.0])
    assert spheres[:, 2].min() >= 0.0
    assert spheres[:, 2].max() <= 6.0
    steps = np.diff(np.sort(spheres[:, 2]))
    assert np.allclose(steps, steps[0])
    assert steps[0] <= tree.sphere_radius
    waist = math.sqrt(0.3**2 - (steps[0] / 2) ** 2)  # thinnest between two spheres
    assert waist >= 0.96 * 0.3
    assert spheres[:, 2].min() < steps[0]


@pytest.mark.parametrize("edge", [0.2, 0.73, 0.75, 1.07, 3.0])
def test_box_is_covered_and_hardly_exceeded(edge: float) -> None:
    cube = box((0.5, -1.0, 2.0), edge)
    spheres, radius = cube.spheres() - np.array([0.5, -1.0, 2.0]), cube.sphere_radius
    assert np.abs(spheres).max() + radius - edge / 2 <= BOX_OVERSHOOT + 1e-12
    ticks = np.linspace(-edge / 2, edge / 2, 12)
    points = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    gaps = np.linalg.norm(points[:, None] - spheres[None], axis=2).min(axis=1) - radius
    assert gaps.max() <= 1e-9


def test_described_obstacles_keep_their_sizes() -> None:
    assert from_config(ObstacleConfig("sphere", (0, 0, 1), radius=0.5)).size == (1.0, 1.0, 1.0)
    assert from_config(ObstacleConfig("cylinder", (0, 0, 1), radius=0.5, height=2.0)).size == (1.0, 1.0, 2.0)
    assert from_config(ObstacleConfig("box", (0, 0, 1), edge=0.7)).size == (0.7, 0.7, 0.7)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "box", "cone"])
def test_obstacle_without_size_is_refused(kind: str) -> None:
    with pytest.raises(ValueError, match=kind):
        from_config(ObstacleConfig(kind, (0, 0, 0)))
