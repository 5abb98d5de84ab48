"""Learning curves: of the training episodes, and of policies kept along the way; bands over seeds."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from io import BytesIO

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from srlrace.files import FileError, read_json, read_limited
from srlrace.report.collect import Run
from srlrace.report.plots import Key, Panel, Plot, methods_keys
from srlrace.report.style import series
from srlrace.runs import RunError, RunFolder

Array = NDArray[np.float64]
Frames = Mapping[str, Sequence[pd.DataFrame]]  # progress of each seed, by method

PROGRESS_LIMIT = 64_000_000  # bytes: a row per rollout leaves room for 200 000 of them
POINTS = 120  # of a curve: more cannot be seen
WINDOW = 9  # points of the running mean over a curve
AXES = (("steps", 1e-6, "environment steps (million)"), ("wall_s", 1 / 60, "wall-clock (min)"))
QUANTITIES = (
    ("success_ratio", 100.0, "finished (%)", (-3.0, 103.0)),
    ("crash_ratio", 100.0, "crashed (%)", (-3.0, 103.0)),
    ("time_s", 1.0, "time of finished (s)", None),
)
EVALUATED = (("finished_pct", 1.0, "finished (%)", (-3.0, 103.0)), ("time_s", 1.0, "time of finished (s)", None))
TERM = "reward/"

logger = logging.getLogger(__name__)


def read_progress(run: Run) -> pd.DataFrame | None:
    """Return a run's ``progress.csv``, or None where there is none, or, with a warning, none to read."""
    if not (run.path / "progress.csv").exists():
        return None
    try:
        content = read_limited(RunFolder(run.path).file("progress.csv"), PROGRESS_LIMIT)
        frame = pd.read_csv(BytesIO(content), on_bad_lines="skip").apply(pd.to_numeric, errors="coerce")
    except (FileError, RunError, ValueError) as error:
        logger.warning("no learning curve of %s: %s", run.id, error)
        return None
    return frame if "steps" in frame and len(frame) else None


def read_learning(run: Run, suite: str, progress: pd.DataFrame) -> pd.DataFrame | None:
    """Return what the policies kept along a run's training did on a suite, with the wall-clock after which they were.

    Columns: steps, finished_pct, crashed_pct, time_s (NaN where none finished), wall_s. None where none were flown, or,
    with a warning, where the file cannot be used.
    """
    path = run.path / "eval" / suite / "learning.json"
    if not path.exists() or "wall_s" not in progress:
        return None
    try:
        stored = read_json(RunFolder(run.path).file("eval", suite, "learning.json"))
        frame = pd.DataFrame(stored["snapshots"], columns=["steps", "finished", "crashed", "time_s"]).astype(float)
        share = 100.0 / float(stored["episodes"])
    except (FileError, RunError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        logger.warning("no evaluated learning curve of %s: %s", run.id, error)
        return None
    timed = progress[["steps", "wall_s"]].dropna().sort_values("steps")
    wall = np.interp(frame["steps"], timed["steps"], timed["wall_s"])
    return frame.assign(finished_pct=share * frame["finished"], crashed_pct=share * frame["crashed"], wall_s=wall)


def evaluated_plot(methods: Frames, name: str, title: str) -> Plot:
    """Return success and time of the policies kept along the training against wall-clock, one line per method."""
    panels = []
    for quantity, scale, label, limits in EVALUATED:
        draw = partial(_draw_quantity, methods, AXES[1], (quantity, scale), label, limits)
        alt = f"{label} of evaluated flights against wall-clock: {_last(methods, quantity, scale)}"
        panels.append(Panel(draw, alt))
    caption = (
        "Policies kept along the training, each flown without exploration on the same frozen initial conditions as the "
        "last one. Lines are means over seeds, bands reach from the lowest to the highest seed. " + first_good(methods)
    )
    keys = methods_keys([f"{name} (n={len(frames)})" for name, frames in methods.items()], _styles(len(methods)))
    return Plot(name, title, caption, tuple(panels), columns=2, keys=keys)


def first_good(methods: Frames, finished_pct: float = 99.0) -> str:
    """Say after how long the policies of each method finished nearly all of their flights."""
    parts = []
    for method, frames in methods.items():
        reached = [frame.loc[frame["finished_pct"] >= finished_pct, "wall_s"].min() for frame in frames]
        times = [time for time in reached if np.isfinite(time)]
        span = f" after {min(times):.0f} to {max(times):.0f} s" if times else ""
        parts.append(f"{method} in {len(times)} of {len(frames)} seeds{span}")
    return f"{finished_pct:g} % of flights were finished by {'; '.join(parts)}."


def learning_plot(methods: Frames, name: str, title: str) -> Plot:
    """Return outcomes and time against steps and against wall-clock, one line per method."""
    panels = []
    for quantity, scale, label, limits in QUANTITIES:
        for axis, unit, axis_label in AXES:
            draw = partial(_draw_quantity, methods, (axis, unit, axis_label), (quantity, scale), label, limits)
            panels.append(
                Panel(draw, f"{label} of the training episodes against {axis_label}: {_last(methods, quantity, scale)}")
            )
    caption = (
        "Training episodes, exploration noise and curriculum included, as a running mean. Lines are means over seeds, "
        "bands reach from the lowest to the highest seed. Wall-clock depends on the machine and on what else it did."
    )
    keys = methods_keys([f"{name} (n={len(frames)})" for name, frames in methods.items()], _styles(len(methods)))
    return Plot(name, title, caption, tuple(panels), columns=2, keys=keys)


def reward_plot(methods: Frames, name: str, title: str) -> Plot:
    """Return the reward of a step by term against steps, one panel per method."""
    terms = sorted({column for frames in methods.values() for frame in frames for column in _active(frame)})
    styles = dict(zip(terms, _styles(len(terms)), strict=True))
    panels = tuple(
        Panel(partial(_draw_terms, frames, styles, method), f"Reward by term over the training of {method}")
        for method, frames in methods.items()
    )
    keys = tuple(Key(term.removeprefix(TERM).replace("_", " "), *styles[term]) for term in terms)
    caption = (
        "Mean reward of an environment step by term, weights included, mean over seeds. Rewards of different methods "
        "have different terms and weights, so their sums do not compare; terms that are zero throughout are left out."
    )
    return Plot(name, title, caption, panels, columns=2, keys=keys)


def curves(
    frames: Sequence[pd.DataFrame], axis: str, unit: float, quantity: str, scale: float
) -> tuple[Array, Array] | None:
    """Return (points,) abscissae common to all seeds and (seeds, points) values; None if no seed has both columns."""
    found = []
    for frame in frames:
        if axis in frame and quantity in frame:
            known = frame[[axis, quantity]].dropna().drop_duplicates(axis).sort_values(axis)
            if len(known):
                found.append((unit * known[axis].to_numpy(float), scale * known[quantity].to_numpy(float)))
    if not found:
        return None
    low, high = max(x[0] for x, _ in found), min(x[-1] for x, _ in found)
    common = np.linspace(low, max(low, high), POINTS)
    return common, np.array([np.interp(common, x, _smooth(y)) for x, y in found])


def _smooth(values: Array) -> Array:
    """Return the running mean over a window that shrinks at the ends."""
    half = max(1, len(values) * WINDOW // (2 * POINTS)) if len(values) > POINTS else 0
    if not half:
        return values
    ones = np.ones(2 * half + 1)
    return np.asarray(np.convolve(values, ones, "same") / np.convolve(np.ones_like(values), ones, "same"))


def _draw_quantity(
    methods: Frames,
    axis: tuple[str, float, str],
    quantity: tuple[str, float],
    label: str,
    limits: tuple[float, float] | None,
    axes: Axes,
) -> None:
    for frames, style in zip(methods.values(), _styles(len(methods)), strict=True):
        _draw(axes, curves(frames, axis[0], axis[1], *quantity), style)
    axes.set(xlabel=axis[2], title=label)
    axes.grid(axis="y")
    if limits:
        axes.set_ylim(*limits)


def _draw(axes: Axes, found: tuple[Array, Array] | None, style: tuple[str, object]) -> None:
    if found is None:
        return
    x, values = found
    colour, dashes = style
    axes.plot(x, values.mean(axis=0), color=colour, linestyle=dashes)
    if len(values) > 1:
        axes.fill_between(x, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.18, linewidth=0)


def _draw_terms(
    frames: Sequence[pd.DataFrame], styles: Mapping[str, tuple[str, object]], method: str, axes: Axes
) -> None:
    for term, style in styles.items():
        if any(term in _active(frame) for frame in frames):
            _draw(axes, curves(frames, *AXES[0][:2], term, 1.0), style)
    axes.axhline(0, linewidth=0.7, color=axes.spines["left"].get_edgecolor())
    axes.set(xlabel=AXES[0][2], title=method)
    axes.grid(axis="y")


def _active(frame: pd.DataFrame) -> list[str]:
    return [column for column in map(str, frame) if column.startswith(TERM) and frame[column].fillna(0).any()]


def _last(methods: Frames, quantity: str, scale: float) -> str:
    """Say where each curve ends, for the text that stands in for a picture."""
    ends = []
    for method, frames in methods.items():
        found = curves(frames, "steps", 1.0, quantity, scale)
        if found:
            ends.append(f"{method} ends at {found[1][:, -1].mean():.1f}")
    return "; ".join(ends) or "no data"


def _styles(count: int) -> list[tuple[str, object]]:
    return [series(i) for i in range(count)]
