"""Trajectories through a course, in space and from above, coloured by speed (the paper's Fig. 3 and 4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from srlrace.report.courses import Course, Trajectory
from srlrace.report.drawing import (
    floor_in_space,
    gates_from_above,
    gates_in_space,
    layer_of,
    obstacles_from_above,
    obstacles_in_space,
)
from srlrace.report.plots import Key, Panel, Plot
from srlrace.report.projection import project
from srlrace.report.style import GATE, INK, MUTED, SOLID, SPEEDS

Array = NDArray[np.float64]

WIDTH = 5.2  # inches of a view
TOLERANCE = 0.02  # m by which a drawn path may leave the flown one: a tenth of a line's width on paper
ROOM = 4.0  # m around the flights that is shown
SPEED_STEP = 1.0  # m/s to which the upper end of the scale is rounded


def trajectory_plot(courses: Mapping[str, Course], name: str, title: str) -> Plot:
    """Return each method's flights in space and from above; all share one scale of speed."""
    top = SPEED_STEP * np.ceil(max(course.top_speed for course in courses.values()) / SPEED_STEP)
    window = _window(list(courses.values()))
    panels: list[Panel] = []
    for method, course in courses.items():
        text = f"{len(course.flights)} flights of {method} past {len(course.obstacles)} obstacles, {course.origin}"
        panels.append(
            Panel(partial(_draw_space, course, window, method, top), f"{text}; in space", _space_size(window))
        )
        panels.append(
            Panel(partial(_draw_above, course, window, method, top), f"{text}; from above", _above_size(window))
        )
    origins = "; ".join(f"{method}: {course.origin}" for method, course in courses.items())
    caption = (
        "Coloured by speed; obstacles grey, around them from above the margin that the drone's centre has to keep; "
        f"waypoints numbered in the order of passing, drawn wherever they stood in one of the flights. {origins}."
    )
    keys = (
        Key("waypoint", GATE, marker="o"),
        Key("obstacle", SOLID, marker="s"),
        Key("did not finish", INK, marker="x"),
    )
    return Plot(name, title, caption, tuple(panels), columns=2, keys=keys, speed_mps=float(top))


def _space_size(window: Array) -> tuple[float, float]:
    extent = np.ptp(project(_corners(window)), axis=0)
    return WIDTH, float(WIDTH * extent[1] / extent[0] + 0.35)


def _above_size(window: Array) -> tuple[float, float]:
    extent = np.ptp(window, axis=0)
    return WIDTH, float(min(1.3, extent[1] / extent[0]) * WIDTH * 0.9 + 0.65)


def _window(courses: Sequence[Course]) -> Array:
    """Return the lower and upper corner (2, 3) [m] of what is shown: the flights, with some room, inside the world."""
    flights = [flight.position for course in courses for flight in course.flights]
    places = np.concatenate([course.waypoints for course in courses] + flights)
    bounds = np.array([courses[0].config.env.bounds_low, courses[0].config.env.bounds_high])
    window = np.stack([places.min(axis=0) - ROOM, places.max(axis=0) + ROOM]).round()
    window = np.clip(window, bounds[0], bounds[1])
    return np.column_stack([window[:, :2], bounds[:, 2]])


def _corners(window: Array) -> Array:
    (x0, y0, z0), (x1, y1, z1) = window
    return np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)])


def _draw_space(course: Course, window: Array, title: str, top: float, axes: Axes) -> None:
    low, high = window
    floor_in_space(axes, low, high)
    shown = [o for o in course.obstacles if np.all(low[:2] <= o.center[:2]) and np.all(o.center[:2] <= high[:2])]
    obstacles_in_space(axes, shown)
    for flight in course.flights:
        shadow = flight.position * [1.0, 1.0, 0.0]
        axes.plot(*project(shadow[_needed(shadow)]).T, color=MUTED, linewidth=0.5, alpha=0.35, zorder=1)
        for piece, colour in pieces(flight, top):
            axes.plot(*project(piece).T, color=colour, linewidth=1.15, zorder=layer_of(piece))
    gates_in_space(axes, course.waypoints, course.config.env)
    _mark_crashes(axes, course.flights, in_space=True)
    axes.set_axis_off()
    axes.set(aspect="equal", title=title)


def _draw_above(course: Course, window: Array, title: str, top: float, axes: Axes) -> None:
    obstacles_from_above(axes, course.obstacles, course.config.keep_out)
    gates_from_above(axes, course.waypoints, course.config.env)
    for flight in course.flights:
        for piece, colour in pieces(flight, top):
            axes.plot(*piece[:, :2].T, color=colour, linewidth=1.15, zorder=3)
    _mark_crashes(axes, course.flights, in_space=False)
    low, high = window
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"{title}, from above")


def pieces(flight: Trajectory, top: float) -> Iterator[tuple[Array, str]]:
    """Yield stretches (k, 3) of a path with the colour of their speed, on a scale from 0 to ``top`` m/s."""
    bins = np.clip((flight.speed * len(SPEEDS) / top).astype(int), 0, len(SPEEDS) - 1)[1:]
    ends = np.flatnonzero(np.diff(bins)) + 1
    for begin, end in zip([0, *ends], [*ends, len(bins)], strict=True):
        stretch = flight.position[begin : end + 1]
        yield stretch[_needed(stretch)], SPEEDS[bins[begin]]


def _needed(path: Array) -> list[int]:
    """Return the points of a path (n, 3) that draw it to within the tolerance (Douglas and Peucker's rule)."""
    kept, open_ = {0, len(path) - 1}, [(0, len(path) - 1)]
    while open_:
        begin, end = open_.pop()
        if end - begin < 2:
            continue
        chord, inner = path[end] - path[begin], path[begin + 1 : end] - path[begin]
        along = np.clip(inner @ chord / max(float(chord @ chord), 1e-12), 0.0, 1.0)
        away = np.linalg.norm(inner - along[:, None] * chord, axis=1)
        if away.max() > TOLERANCE:
            middle = begin + 1 + int(away.argmax())
            kept.add(middle)
            open_ += [(begin, middle), (middle, end)]
    return sorted(kept)


def _mark_crashes(axes: Axes, flights: Sequence[Trajectory], in_space: bool) -> None:
    ends = np.array([flight.position[-1] for flight in flights if flight.crashed])
    if len(ends):
        flat = project(ends) if in_space else ends[:, :2]
        axes.plot(*flat.T, "x", color=INK, markersize=6, markeredgewidth=1.4, zorder=202, label="did not finish")
