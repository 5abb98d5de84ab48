"""Write the report's figures, each as PNG for the screen and PDF for a paper."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, groupby
from pathlib import Path

from matplotlib.figure import Figure

from srlrace.recording.archive import CorruptRecording
from srlrace.report.collect import Run
from srlrace.report.learning_figure import learning_figure, read_progress
from srlrace.report.model import Cell, Report, Table
from srlrace.report.trajectory_figure import read_course, trajectory_figure
from srlrace.runs import RunError, RunFolder

RESOLUTION = 160  # dots per inch of the PNG

logger = logging.getLogger(__name__)


def write_figures(report: Report, runs: Sequence[Run], folder: Path) -> list[Path]:
    """Write learning curves per table and environment, and trajectories of runs whose evaluation was recorded.

    Of a cell's runs the first seed is drawn. Returns the files; what cannot be read is logged and left out.
    """
    known = {run.id: run for run in runs}
    shown = [(cell.runs[0], cell.suite) for table in report.tables for cell in table.cells if cell.runs]
    shown += [(other.run, other.suite) for other in report.others]
    figures = chain(
        chain.from_iterable(_learning_figures(table, known) for table in report.tables),
        _trajectory_figures(dict.fromkeys(shown), known),
    )
    return [path for name, figure in figures for path in save(figure, folder / name)]


def save(figure: Figure, path: Path) -> list[Path]:
    """Write a figure as PNG and PDF beside each other, without dates, so that the same figure is the same file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    targets = [path.with_name(f"{path.name}.{suffix}") for suffix in ("png", "pdf")]
    figure.savefig(targets[0], dpi=RESOLUTION)
    figure.savefig(targets[1], metadata={"CreationDate": None})
    return targets


def _learning_figures(table: Table, known: dict[str, Run]) -> Iterator[tuple[str, Figure]]:
    filled = [cell for cell in table.cells if cell.runs and cell.suite == table.experiment.suites[0]]
    for environment, cells in groupby(filled, key=_environment):
        methods = {cell.method: [known[run] for run in cell.runs] for cell in cells}
        frames = {method: [read_progress(run) for run in runs] for method, runs in methods.items()}
        drawn = {method: [frame for frame in found if frame is not None] for method, found in frames.items()}
        drawn = {method: found for method, found in drawn.items() if found}
        if drawn:
            name = f"{table.experiment.name}-{_slug(environment)}-learning"
            yield name, learning_figure(drawn, f"{table.experiment.title}, {environment}")


def _trajectory_figures(chosen: Iterable[tuple[str, str]], known: dict[str, Run]) -> Iterator[tuple[str, Figure]]:
    for run_id, suite in chosen:
        run = known[run_id]
        try:
            recording = RunFolder(run.path).file("eval", suite, "trajectories.mcap")
            if recording.is_file():
                course = read_course(recording)
                title = f"{run.id}, {suite}: {len(course.flights)} flights"
                yield f"{run.id}-{suite}", trajectory_figure(course, run.config, title)
        except (CorruptRecording, RunError, OSError) as error:
            logger.warning("no trajectories of %s, %s: %s", run_id, suite, error)


def _environment(cell: Cell) -> str:
    return cell.environment.split(", unseen level")[0]


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
