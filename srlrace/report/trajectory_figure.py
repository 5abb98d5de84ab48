"""Trajectories through a course, in space and from above, coloured by speed (the paper's Fig. 3 and 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from srlrace.recording.flight import SceneObstacle
from srlrace.recording.reader import read_episodes, read_flight
from srlrace.report.drawing import gates_from_above, gates_in_space, keep_out, obstacles_from_above, obstacles_in_space
from srlrace.schema import Config

Array = NDArray[np.float64]

FLIGHTS = 20  # trajectories in one figure: more hide each other
VIRIDIS = ((0.267, 0.005, 0.329), (0.191, 0.407, 0.556), (0.208, 0.719, 0.473), (0.876, 0.891, 0.095))
SPEED_COLOURS = LinearSegmentedColormap.from_list("speed", VIRIDIS)  # colour-blind safe, ordered in greyscale too
CRASH = "black"
WIDE = 1.4  # x over y extent of a world


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One flight: position and speed over time."""

    position: Array  # (t, 3) m, world
    speed: Array  # (t,) m/s
    crashed: bool


@dataclass(frozen=True, eq=False)
class Course:
    """Flights on one map, with what stands there."""

    flights: tuple[Trajectory, ...]
    waypoints: Array  # (w, 3) m, world; every place at which a waypoint stood in some flight
    obstacles: tuple[SceneObstacle, ...]


def read_course(recording: Path, flights: int = FLIGHTS) -> Course:
    """Read the first flights of a recording that share its first map.

    Raises CorruptRecording for a damaged file, OSError for an unreadable one.
    """
    episodes = read_episodes(recording)
    chosen = episodes.loc[episodes["map"] == episodes["map"].iloc[0], "episode"]
    loaded = []
    for episode in chosen:
        try:
            loaded.append(read_flight(recording, int(episode)))
        except KeyError:  # only the first episodes of an evaluation may have been recorded
            break
        if len(loaded) == flights:
            break
    if not loaded:
        raise FileNotFoundError(f"{recording} holds no flight")
    trajectories = tuple(
        Trajectory(flight.position_w, np.linalg.norm(flight.velocity_w, axis=1), flight.outcome != "finished")
        for flight in loaded
    )
    placed = np.unique(np.concatenate([flight.waypoints for flight in loaded]), axis=0)
    return Course(trajectories, placed, loaded[0].scene)


def trajectory_figure(course: Course, config: Config, title: str) -> Figure:
    """Draw a course in space and from above, on white, for the screen and for print."""
    extent = np.subtract(config.env.bounds_high, config.env.bounds_low)
    wide = extent[0] > WIDE * extent[1]  # then the views stand one above the other
    figure = Figure(figsize=(8.0, 7.6) if wide else (11.0, 5.0), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.25)  # type: ignore[union-attr, call-arg]
    rows, columns = (2, 1) if wide else (1, 2)
    space = figure.add_subplot(rows, columns, 1, projection="3d")
    above = figure.add_subplot(rows, columns, 2)
    assert isinstance(space, Axes3D)
    scale = Normalize(0.0, max(float(flight.speed.max()) for flight in course.flights))
    _draw_space(space, course, config, scale)
    _draw_above(above, course, config, scale)
    figure.colorbar(ScalarMappable(scale, SPEED_COLOURS), ax=above, label="speed (m/s)", shrink=0.8, pad=0.01)
    figure.suptitle(title, fontsize=10)
    return figure


def _draw_space(axes: Axes3D, course: Course, config: Config, scale: Normalize) -> None:
    obstacles_in_space(axes, course.obstacles)
    gates_in_space(axes, course.waypoints)
    for flight in course.flights:
        lines = Line3DCollection(_segments(flight.position), cmap=SPEED_COLOURS, norm=scale, linewidths=1.0)
        lines.set_array(flight.speed[1:])
        axes.add_collection3d(lines, autolim=False)
    low, high = np.array(config.env.bounds_low), np.array(config.env.bounds_high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.set_box_aspect(high - low, zoom=1.3)  # more would cut the far corners off
    axes.view_init(elev=32, azim=-65)
    axes.tick_params(labelsize=7, pad=0)
    axes.locator_params(axis="z", nbins=3)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))


def _draw_above(axes: Axes, course: Course, config: Config, scale: Normalize) -> None:
    obstacles_from_above(axes, course.obstacles, keep_out(config))
    gates_from_above(axes, course.waypoints, config.env)
    for flight in course.flights:
        lines = LineCollection(
            _segments(flight.position[:, :2]), cmap=SPEED_COLOURS, norm=scale, linewidths=1.0, zorder=3
        )
        lines.set_array(flight.speed[1:])
        axes.add_collection(lines)
    _mark_crashes(axes, course.flights)
    low, high = config.env.bounds_low, config.env.bounds_high
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")


def _mark_crashes(axes: Axes, flights: Sequence[Trajectory]) -> None:
    ends = np.array([flight.position[-1, :2] for flight in flights if flight.crashed])
    if len(ends):
        axes.scatter(ends[:, 0], ends[:, 1], marker="x", color=CRASH, s=28, zorder=6, label="did not finish")
        axes.legend(loc="lower right", fontsize=7, frameon=True)


def _segments(points: Array) -> Any:
    """Return (t - 1, 2, d) line segments of a polyline (t, d)."""
    return np.stack([points[:-1], points[1:]], axis=1)
