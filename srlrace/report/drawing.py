"""Draw a course in space and from above: obstacles, the margin that the drone's centre must keep, gates."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch, Polygon
from numpy.typing import NDArray

from srlrace.recording.flight import SceneObstacle
from srlrace.report.projection import nearness, outline, project
from srlrace.report.style import CAP, GATE, GRID, HALO, MUTED, SOLID
from srlrace.schema import TrackConfig

Array = NDArray[np.float64]

SIDES = 24  # corners of a circle
TILE = 5.0  # m between lines on the floor


def obstacles_from_above(axes: Axes, obstacles: Sequence[SceneObstacle], margin: float) -> None:
    """Draw obstacles as they collide: solid, and around them the margin [m] that the drone's centre keeps out of."""
    for inflation, colour, layer in ((margin, HALO, 1), (0.0, SOLID, 2)):
        for obstacle in obstacles:
            axes.add_patch(_outline(obstacle, inflation, colour, layer))


def obstacles_in_space(axes: Axes, obstacles: Sequence[SceneObstacle]) -> None:
    """Draw obstacles as translucent solids, each in the layer of its distance."""
    for obstacle in obstacles:
        rings = _rings(obstacle)
        layer = layer_of(np.array([obstacle.center]))
        axes.add_patch(Polygon(outline(np.concatenate(rings)), facecolor=SOLID, linewidth=0, alpha=0.6, zorder=layer))
        if obstacle.kind != "sphere":
            axes.add_patch(Polygon(project(rings[-1]), facecolor=CAP, linewidth=0, alpha=0.9, zorder=layer))


def floor_in_space(axes: Axes, low: Array, high: Array) -> None:
    """Draw the world's floor as a grid of squares of 5 m, with its length and width [m]."""
    for axis in (0, 1):
        ticks = np.arange(np.ceil(low[axis] / TILE) * TILE, high[axis] + 1e-6, TILE)
        for value in ticks:
            ends = np.array([[low[0], low[1], 0.0], [high[0], high[1], 0.0]])
            ends[:, axis] = value
            axes.plot(*project(ends).T, color=GRID, linewidth=0.6, zorder=0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]])
    axes.plot(*project(np.column_stack([corners, np.zeros(5)])).T, color=MUTED, linewidth=0.7, zorder=0)
    for a, b in pairwise(corners[:3]):
        x, y = project(np.array([*(a + b) / 2, 0.0]))
        axes.annotate(f"{np.abs(b - a).sum():g} m", (x, y), xytext=(0, -4), textcoords="offset points", ha="center",
                      va="top", fontsize=8, color=MUTED)  # fmt: skip


def gates_from_above(axes: Axes, placed: Array, track: TrackConfig) -> None:
    """Draw waypoints where they were placed (w, 3) [m] with their passing radius, and number the track's own."""
    for x, y, _ in placed:
        axes.add_patch(Circle((x, y), track.passing_radius, fill=False, edgecolor=GATE, linewidth=1.2, zorder=4))
    _number(axes, [(x, y) for x, y, _ in track.waypoints], 5)


def gates_in_space(axes: Axes, placed: Array, track: TrackConfig) -> None:
    """Mark waypoints (w, 3) [m], each on a thin stem from the floor, without which its place is hard to see."""
    for waypoint in placed:
        stem = np.array([[*waypoint[:2], 0.0], waypoint])
        axes.plot(*project(stem).T, color=GATE, linewidth=0.7, alpha=0.7, zorder=layer_of(stem))
    flat = project(np.array(placed))
    axes.plot(*flat.T, "o", color=GATE, markersize=4.0, fillstyle="none", markeredgewidth=1.3, zorder=200)
    _number(axes, [tuple(place) for place in project(np.array(track.waypoints))], 201)


def layer_of(points: Array) -> float:
    """Return the layer, among those from 10 to 190, in which something at points (n, 3) [m] is drawn: near over far."""
    return float(np.clip(100.0 + nearness(points).mean(), 10.0, 190.0))


def _number(axes: Axes, places: Sequence[tuple[float, float]], layer: float) -> None:
    style: dict[str, Any] = {"color": GATE, "fontsize": 8.5, "fontweight": "bold", "zorder": layer}
    for number, place in enumerate(places, start=1):
        axes.annotate(str(number), place, xytext=(4, 4), textcoords="offset points", **style)


def _outline(obstacle: SceneObstacle, inflation: float, colour: str, layer: int) -> Circle | FancyBboxPatch:
    x, y, _ = obstacle.center
    style: dict[str, Any] = {"facecolor": colour, "edgecolor": "none", "zorder": layer}
    if obstacle.kind != "box":
        return Circle((x, y), obstacle.radius + inflation, **style)
    half = obstacle.edge / 2
    rounding = f"round,pad={inflation},rounding_size={inflation}" if inflation else "square,pad=0"
    return FancyBboxPatch((x - half, y - half), obstacle.edge, obstacle.edge, boxstyle=rounding, **style)


def _rings(obstacle: SceneObstacle) -> list[Array]:
    """Return polygons (corners, 3) around the obstacle, lowest first, whose hull is its shape."""
    angles = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    if obstacle.kind == "sphere":
        latitudes = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2 + 1)
        rings = [(obstacle.radius * np.cos(a), obstacle.radius * np.sin(a)) for a in latitudes]
    elif obstacle.kind == "cylinder":
        rings = [(obstacle.radius, -obstacle.height / 2), (obstacle.radius, obstacle.height / 2)]
    else:
        angles = np.pi / 4 + np.linspace(0, 2 * np.pi, 4, endpoint=False)
        rings = [(obstacle.edge / np.sqrt(2), sign * obstacle.edge / 2) for sign in (-1, 1)]
    circles = (np.stack([r * np.cos(angles), r * np.sin(angles), np.full_like(angles, z)], axis=1) for r, z in rings)
    return [np.array(obstacle.center) + circle for circle in circles]
