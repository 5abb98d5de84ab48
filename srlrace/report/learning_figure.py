"""Learning curves: success and time of the training episodes against steps and wall-clock, with a band over seeds."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from io import BytesIO

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from srlrace.files import FileError, read_limited
from srlrace.report.collect import Run
from srlrace.runs import RunError, RunFolder

Array = NDArray[np.float64]

PROGRESS_LIMIT = 64_000_000  # bytes: a row per rollout leaves room for 200 000 of them
POINTS = 200  # of a curve: more cannot be seen
STYLES = (  # Okabe and Ito's palette, told apart in greyscale by the line style as well
    ("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#CC79A7", ":"), ("#E69F00", (0, (6, 2, 1, 2))),
)  # fmt: skip
AXES = (("steps", 1e-6, "environment steps (million)"), ("wall_s", 1 / 60, "wall-clock (min)"))
QUANTITIES = (("success_ratio", 100.0, "finished (%)"), ("time_s", 1.0, "time of finished (s)"))

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


def learning_figure(methods: Mapping[str, Sequence[pd.DataFrame]], title: str) -> Figure:
    """Draw one line per method, the mean over its seeds, and a band from the lowest to the highest seed."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    grid = figure.subplots(len(QUANTITIES), len(AXES), squeeze=False, sharey="row")
    for row, (quantity, scale, label) in zip(grid, QUANTITIES, strict=True):
        for axes, (axis, unit, axis_label) in zip(row, AXES, strict=True):
            for (method, frames), style in zip(methods.items(), _styles(len(methods)), strict=True):
                _draw(axes, _curves(frames, axis, unit, quantity, scale), method, style)
            axes.set_xlabel(axis_label)
            axes.grid(alpha=0.3)
        row[0].set_ylabel(label)
    grid[0][0].set_ylim(-3, 103)
    grid[0][0].legend(fontsize=8)
    figure.suptitle(f"{title}: training episodes, mean and range over seeds", fontsize=10)
    return figure


def _curves(
    frames: Sequence[pd.DataFrame], axis: str, unit: float, quantity: str, scale: float
) -> tuple[Array, Array] | None:
    """Return (points,) abscissae common to all seeds and (seeds, points) values; None if no seed has both columns."""
    series = []
    for frame in frames:
        if axis in frame and quantity in frame:
            known = frame[[axis, quantity]].dropna().drop_duplicates(axis).sort_values(axis)
            if len(known):
                series.append((unit * known[axis].to_numpy(float), scale * known[quantity].to_numpy(float)))
    if not series:
        return None
    low, high = max(x[0] for x, _ in series), min(x[-1] for x, _ in series)
    common = np.linspace(low, max(low, high), POINTS)
    return common, np.array([np.interp(common, x, y) for x, y in series])


def _draw(axes: Axes, curves: tuple[Array, Array] | None, method: str, style: tuple[str, object]) -> None:
    if curves is None:
        return
    x, values = curves
    colour, dashes = style
    axes.plot(x, values.mean(axis=0), color=colour, linestyle=dashes, label=f"{method} (n={len(values)})")
    if len(values) > 1:
        axes.fill_between(x, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.18, linewidth=0)


def _styles(count: int) -> list[tuple[str, object]]:
    return [STYLES[i % len(STYLES)] for i in range(count)]
