"""Draw a course: obstacles in grey with the margin that the drone's centre must keep, and gates, in 2D and 3D."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from srlrace.recording.flight import SceneObstacle
from srlrace.schema import Config, TrackConfig

Array = NDArray[np.float64]

SOLID = "0.62"  # grey of the obstacle itself
HALO = "0.88"  # grey of the margin around it
GATE = "#D55E00"  # vermilion, from Okabe and Ito's palette: told apart from the speeds' blue to yellow
LIT = withStroke(linewidth=2.5, foreground="white")  # keeps numbers readable over trajectories
SIDES = 12  # facets around a cylinder in 3D


def keep_out(config: Config) -> float:
    """Return how far from an obstacle's surface the drone's centre must stay [m]: arm length and safety margin."""
    return config.quad.arm_length + config.level.safety_margin


def obstacles_from_above(axes: Axes, obstacles: Sequence[SceneObstacle], margin: float) -> None:
    """Draw obstacles as they collide: solid, and around them the margin [m] that the drone's centre keeps out of."""
    for inflation, colour, layer in ((margin, HALO, 1), (0.0, SOLID, 2)):
        for obstacle in obstacles:
            axes.add_patch(_outline(obstacle, inflation, colour, layer))


def obstacles_in_space(axes: Axes3D, obstacles: Sequence[SceneObstacle]) -> None:
    """Draw obstacles as translucent solids."""
    faces = [face for obstacle in obstacles for face in _faces(obstacle)]
    if faces:
        axes.add_collection3d(Poly3DCollection(faces, facecolors=SOLID, edgecolors="none", alpha=0.22))


def gates_from_above(axes: Axes, placed: Array, track: TrackConfig) -> None:
    """Draw waypoints where they were placed (w, 3) [m] with their passing radius, and number the track's own."""
    for x, y, _ in placed:
        axes.add_patch(Circle((x, y), track.passing_radius, fill=False, edgecolor=GATE, linewidth=1.2, zorder=4))
    style: dict[str, Any] = {"color": GATE, "fontsize": 9, "zorder": 5, "path_effects": [LIT]}
    for number, (x, y, _) in enumerate(track.waypoints, start=1):
        axes.annotate(str(number), (x, y), xytext=(5, 5), textcoords="offset points", **style)


def gates_in_space(axes: Axes3D, waypoints: Array) -> None:
    """Mark waypoints (w, 3) [m], each on a thin stem from the floor, without which its place is hard to see."""
    axes.scatter(*waypoints.T, color=GATE, s=18, depthshade=False)
    for x, y, z in waypoints:
        axes.plot([x, x], [y, y], [0, z], color=GATE, linewidth=0.6, alpha=0.6)


def _outline(obstacle: SceneObstacle, inflation: float, colour: str, layer: int) -> Circle | FancyBboxPatch:
    x, y, _ = obstacle.center
    style: dict[str, Any] = {"facecolor": colour, "edgecolor": "none", "zorder": layer}
    if obstacle.kind != "box":
        return Circle((x, y), obstacle.radius + inflation, **style)
    half = obstacle.edge / 2
    rounding = f"round,pad={inflation},rounding_size={inflation}" if inflation else "square,pad=0"
    return FancyBboxPatch((x - half, y - half), obstacle.edge, obstacle.edge, boxstyle=rounding, **style)


def _faces(obstacle: SceneObstacle) -> Iterator[Array]:
    """Yield polygons (corners, 3) of the obstacle's surface."""
    centre = np.array(obstacle.center)
    angles = np.linspace(0, 2 * np.pi, SIDES + 1)
    if obstacle.kind == "sphere":
        latitudes = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2 + 1)
        rings = [(obstacle.radius * np.cos(a), obstacle.radius * np.sin(a)) for a in latitudes]
    elif obstacle.kind == "cylinder":
        rings = [(obstacle.radius, -obstacle.height / 2), (obstacle.radius, obstacle.height / 2)]
    else:
        angles = np.pi / 4 + np.linspace(0, 2 * np.pi, 5)
        rings = [(obstacle.edge / np.sqrt(2), sign * obstacle.edge / 2) for sign in (-1, 1)]
    circles = [np.stack([r * np.cos(angles), r * np.sin(angles), np.full_like(angles, z)], axis=1) for r, z in rings]
    for low, high in pairwise(circles):
        for i in range(len(angles) - 1):
            yield centre + np.stack([low[i], low[i + 1], high[i + 1], high[i]])
    if obstacle.kind != "sphere":
        yield centre + circles[-1][:-1]
