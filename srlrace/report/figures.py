"""The figures of a report: which there are, and writing them as PNG, SVG and, for a paper, PDF."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from srlrace.files import atomic_write
from srlrace.report.collect import Evaluation, Run
from srlrace.report.courses import find_course
from srlrace.report.learning_figure import (
    evaluated_plot,
    learning_plot,
    read_learning,
    read_progress,
    reward_plot,
)
from srlrace.report.model import Cell, Report, Table
from srlrace.report.plots import Plot, figure_of
from srlrace.report.results_figure import flights_plot, results_plot
from srlrace.report.style import styled
from srlrace.report.trajectory_figure import trajectory_plot
from srlrace.suites import maps_of

RESOLUTION = 160  # dots per inch of the PNG
FORMATS: dict[str, dict[str, None]] = {  # without dates: the same figure is the same file
    "png": {},
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
}


@dataclass(frozen=True)
class Group:
    """The filled cells of a table in one environment, on one suite."""

    table: Table
    environment: str
    suite: str
    cells: tuple[Cell, ...]

    @property
    def name(self) -> str:
        """Beginning of the names of its figures."""
        return f"{self.table.experiment.name}-{_slug(self.environment)}"

    @property
    def title(self) -> str:
        """Title of its figures."""
        return f"{self.environment}: {self.table.experiment.title[:1].lower()}{self.table.experiment.title[1:]}"


def groups(table: Table) -> Iterator[Group]:
    """Yield the filled cells of a table by environment and suite; disturbed ones are in the results alone."""
    filled = (cell for cell in table.cells if cell.runs and maps_of(cell.suite) == cell.suite)
    for (environment, suite), cells in groupby(filled, key=lambda cell: (cell.environment, cell.suite)):
        yield Group(table, environment, suite, tuple(cells))


def report_plots(report: Report, runs: Sequence[Run], fly: bool = False) -> Iterator[tuple[Table, list[Plot]]]:
    """Yield each table with its plots; what an earlier table showed is not shown again.

    With ``fly``, runs without a recording fly a few episodes again, which takes torch and seconds.
    """
    known = {run.id: run for run in runs}
    drawn: set[tuple[str, str]] = set()
    for table in report.tables:
        results = results_plot(table)
        yield table, [*([results] if results else []), *_group_plots(table, known, drawn, fly)]


def _group_plots(table: Table, known: dict[str, Run], drawn: set[tuple[str, str]], fly: bool) -> Iterator[Plot]:
    for group in groups(table):
        fresh = {(run, cell.suite) for cell in group.cells for run in cell.runs} - drawn
        if fresh:
            yield from _trajectories(group, known, drawn, fly)
            drawn |= fresh
            yield flights_plot(_flown(group, known), f"{group.name}-flights", group.title, group.cells[0].t_ref_s)
            if group.suite == table.experiment.suites[0]:  # the runs of other suites are the same
                yield from _learning(group, known)


def write_figures(report: Report, runs: Sequence[Run], folder: Path, fly: bool = False) -> list[Path]:
    """Write every figure there is data for; what cannot be read is logged and left out. Returns the files."""
    known = {run.id: run for run in runs}
    written = []
    with styled():
        plots = [plot for _, found in report_plots(report, runs, fly) for plot in found]
        for other in report.others:
            course = find_course(known[other.run], other.suite)
            if course:
                name = f"{other.run}-{other.suite}"
                plots.append(trajectory_plot({other.run: course}, f"{name}-trajectories", name))
        for plot in plots:
            written += save(figure_of(plot), folder / plot.name)
    return written


def save(figure: Figure, path: Path) -> list[Path]:
    """Write a figure in every format, beside each other.

    Drawn in memory: where the disk fails, Matplotlib leaves half a file, and may hide why behind an error of its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    targets = []
    for suffix, metadata in FORMATS.items():
        drawing = io.BytesIO()
        figure.savefig(drawing, format=suffix, dpi=RESOLUTION, metadata=metadata)
        targets.append(path.with_name(f"{path.name}.{suffix}"))
        atomic_write(targets[-1], drawing.getvalue())
    return targets


def _trajectories(group: Group, known: dict[str, Run], drawn: set[tuple[str, str]], fly: bool) -> Iterator[Plot]:
    """Draw the first seed of each cell: flights of several would hide each other."""
    cells = [cell for cell in group.cells if (cell.runs[0], cell.suite) not in drawn]
    found = {cell.method: find_course(known[cell.runs[0]], cell.suite, fly) for cell in cells}
    courses = {method: course for method, course in found.items() if course}
    if courses:
        yield trajectory_plot(courses, f"{group.name}-trajectories", group.title)


def _flown(group: Group, known: dict[str, Run]) -> dict[str, list[Evaluation]]:
    return {cell.method: [known[run].evaluations[cell.suite] for run in cell.runs] for cell in group.cells}


def _learning(group: Group, known: dict[str, Run]) -> Iterator[Plot]:
    progress: dict[str, list[pd.DataFrame]] = {}
    evaluated: dict[str, list[pd.DataFrame]] = {}
    for cell in group.cells:
        for run in cell.runs:
            frame = read_progress(known[run])
            if frame is not None:
                progress.setdefault(cell.method, []).append(frame)
                flown = read_learning(known[run], cell.suite, frame)
                if flown is not None:
                    evaluated.setdefault(cell.method, []).append(flown)
    if evaluated:
        yield evaluated_plot(evaluated, f"{group.name}-evaluated", group.title)
    if progress:
        yield learning_plot(progress, f"{group.name}-learning", group.title)
        yield reward_plot(progress, f"{group.name}-reward", group.title)


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
