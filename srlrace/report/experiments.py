"""The experiment files, one per table, and the paper's printed cells."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from srlrace.parse import ConfigError
from srlrace.suites import check_suite

QUANTITIES = ("time", "crash")
# What is compared: consecutive rows of each suite; each row with the last; the second suite of a row with the first.
PAIRS = ("rows", "last_row", "suites")


class ExperimentError(Exception):
    """An experiment file or the paper's numbers cannot be read; the text is a message to a person."""


@dataclass(frozen=True)
class PaperCell:
    """What the paper prints in one cell; None where its table has no such column."""

    time_s: float | None = None
    crash_pct: float | None = None


@dataclass(frozen=True)
class Row:
    """One row of an experiment: a method in an environment, and the overrides that train it."""

    environment: str
    method: str
    overrides: tuple[str, ...]
    paper: str = ""  # key into the paper's cells, empty where the paper has none


@dataclass(frozen=True)
class Experiment:
    """One table: rows x suites, each cell replicated over training seeds."""

    name: str
    title: str
    rows: tuple[Row, ...]
    suites: tuple[str, ...]
    columns: tuple[str, ...] = QUANTITIES
    seeds: int = 5
    episodes: int = 1000
    paper_table: str = ""
    paired: str = ""  # quantity compared within pairs of cells, first minus second, on the seeds that both have
    pairs: str = "rows"  # which cells, one of PAIRS
    notes: tuple[str, ...] = ()
    report: bool = True  # False: a sweep that makes no table


def load_experiment(path: Path) -> Experiment:
    """Read one experiment file; raises ExperimentError naming the file and what is wrong with it."""
    data = _mapping(path)
    try:
        rows = tuple(_row(row) for row in data.pop("rows"))
        data |= {key: tuple(data[key]) for key in ("suites", "columns", "notes") if key in data}
        experiment = Experiment(name=path.stem, rows=rows, **data)
    except (KeyError, TypeError, AttributeError) as error:
        raise ExperimentError(f"{path}: not an experiment file ({error})") from None
    _check(experiment, path)
    return experiment


def load_experiments(folder: Path) -> tuple[Experiment, ...]:
    """Read every experiment file of a folder, the paper's tables first, in the paper's order."""
    loaded = (load_experiment(path) for path in sorted(folder.glob("*.yaml")))
    return tuple(sorted(loaded, key=lambda experiment: (experiment.paper_table or "~", experiment.name)))


@dataclass(frozen=True)
class Paper:
    """The paper's numbers: cells by table, row key and suite."""

    cells: dict[str, dict[str, dict[str, PaperCell]]]
    episodes: int  # inferred from the printed ratios

    def cell(self, experiment: Experiment, row: Row, suite: str) -> PaperCell:
        """Return the paper's cell, empty where the paper has none; an unknown key raises ExperimentError."""
        if not row.paper:
            return PaperCell()
        try:
            return self.cells[experiment.name][row.paper].get(suite, PaperCell())
        except KeyError:
            raise ExperimentError(f"{experiment.name}: the paper's cells have no {row.paper!r}") from None


def load_paper(path: Path) -> Paper:
    """Read the paper's printed cells; raises ExperimentError if the file is not what it should be."""
    data = _mapping(path)
    try:
        episodes = int(data.pop("inferred_episodes"))
        cells = {
            table: {key: {suite: PaperCell(**cell) for suite, cell in suites.items()} for key, suites in keys.items()}
            for table, keys in data.items()
        }
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ExperimentError(f"{path}: not a file of the paper's cells ({error})") from None
    return Paper(cells, episodes)


def _mapping(path: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ExperimentError(f"{path}: cannot be read ({error})") from None
    if not isinstance(data, dict):
        raise ExperimentError(f"{path}: holds no settings")
    return data


def _row(data: dict[str, Any]) -> Row:
    overrides = tuple(str(override) for override in data["overrides"])
    return Row(str(data["environment"]), str(data["method"]), overrides, str(data.get("paper", "")))


def _check(experiment: Experiment, path: Path) -> None:
    for suite in experiment.suites:
        try:
            check_suite(suite)
        except ConfigError as error:
            raise ExperimentError(f"{path}: {error}") from None
    for quantity in (*experiment.columns, *filter(None, [experiment.paired])):
        if quantity not in QUANTITIES:
            raise ExperimentError(f"{path}: column {quantity!r} is none of {', '.join(QUANTITIES)}")
    if experiment.pairs not in PAIRS:
        raise ExperimentError(f"{path}: pairs: {experiment.pairs!r} is none of {', '.join(PAIRS)}")
    if experiment.paired and experiment.pairs == "suites" and len(experiment.suites) < 2:
        raise ExperimentError(f"{path}: paired suites are two, but there is one")
    if experiment.paired and experiment.pairs == "rows" and len(experiment.rows) % 2:
        raise ExperimentError(f"{path}: paired rows come in pairs, but there are {len(experiment.rows)}")
