"""Build the report: which runs stand in which cell of which table, and what they show."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from srlrace.config import method_name
from srlrace.report.collect import Run, preset
from srlrace.report.experiments import Experiment, Paper, Row
from srlrace.report.groups import Group, common_group, groups
from srlrace.report.model import Cell, Comparison, OtherRun, Report, Table
from srlrace.report.notes import cell_notes, table_notes
from srlrace.report.numbers import cell_numbers, paired_difference, single_numbers
from srlrace.report.reference import compare
from srlrace.runs import State
from srlrace.schema import Config
from srlrace.suites import describe_suite

Compose = Callable[[tuple[str, ...]], Config]
Alike = Mapping[tuple[object, ...], list[Run]]  # by preset: a comparison of every run with every row takes too long


class Place(NamedTuple):
    """A cell to be filled, and the groups of runs that could fill it, best first."""

    row: Row
    suite: str
    config: Config
    candidates: list[Group]


def build_report(
    runs: Sequence[Run], experiments: Sequence[Experiment], paper: Paper, compose: Compose, problems: Sequence[str] = ()
) -> Report:
    """Fill every table from the runs; ``compose`` turns a row's overrides into its configuration."""
    alike: Alike = defaultdict(list)
    for run in runs:
        alike[run.preset].append(run)
    tables = tuple(_table(alike, experiment, paper, compose) for experiment in experiments if experiment.report)
    used = {(run, cell.suite) for table in tables for cell in table.cells for run in cell.runs}
    left = [(run, suite) for run in runs for suite in run.evaluations if (run.id, suite) not in used]
    numbers = single_numbers([(run.config.seed, run.evaluations[suite]) for run, suite in left])
    others = (
        OtherRun(run.id, method_name(run.config), suite, each) for (run, suite), each in zip(left, numbers, strict=True)
    )
    return Report(tables, tuple(others), tuple(problems))


def _table(alike: Alike, experiment: Experiment, paper: Paper, compose: Compose) -> Table:
    places = [_place(alike, row, suite, compose) for suite in experiment.suites for row in experiment.rows]
    chosen = _choose(places, experiment)
    cells = tuple(_cell(alike, experiment, paper, place, group) for place, group in zip(places, chosen, strict=True))
    return Table(experiment, cells, _comparisons(experiment, places, chosen), table_notes(experiment, paper, chosen))


def _place(alike: Alike, row: Row, suite: str, compose: Compose) -> Place:
    config = compose(row.overrides)
    wanted = preset(config)
    return Place(row, suite, config, groups(alike.get(wanted, []), wanted, suite))


def _choose(places: Sequence[Place], experiment: Experiment) -> list[Group | None]:
    """Take each place's best group; paired cells take the same algorithm on both sides where they can."""
    chosen = [next(iter(place.candidates), None) for place in places]
    for first, second in _pairs(experiment):
        common = common_group(places[first].candidates, places[second].candidates)
        if common:
            chosen[first], chosen[second] = common
    return chosen


def _pairs(experiment: Experiment) -> list[tuple[int, int]]:
    """Return the places that are compared; those of a suite stand together, in the order of rows."""
    if not experiment.paired:
        return []
    rows, places = len(experiment.rows), range(len(experiment.rows) * len(experiment.suites))
    if experiment.pairs == "last_row":
        return [(place, place - place % rows + rows - 1) for place in places if place % rows < rows - 1]
    if experiment.pairs == "suites":
        return [(rows + row, row) for row in range(rows)]
    return [(place, place + 1) for place in places[::2]]


def _cell(alike: Alike, experiment: Experiment, paper: Paper, place: Place, group: Group | None) -> Cell:
    reference = compare(place.config, place.suite, [flown for _, flown in group.evaluations] if group else ())
    return Cell(
        environment=_environment(place),
        method=place.row.method,
        suite=place.suite,
        paper=paper.cell(experiment, place.row, place.suite),
        command=_command(alike, experiment, place, group),
        numbers=cell_numbers(group.evaluations) if group else None,
        t_ref_s=reference.t_ref_s,
        compared_s=reference.flown_s,
        runs=tuple(group.runs[seed].id for seed in sorted(group.runs)) if group else (),
        notes=(*cell_notes(experiment, place.candidates, group), *reference.notes) if group else (),
    )


def _environment(place: Place) -> str:
    return ", ".join(filter(None, (place.row.environment, describe_suite(place.suite))))


def _command(alike: Alike, experiment: Experiment, place: Place, group: Group | None) -> str:
    """Return what fills the cell: an evaluation if finished runs wait for one, else the sweep, at its runs' budget."""
    trained = (run for run in alike.get(preset(place.config), []) if run.state is State.FINISHED)
    waiting = [run.id for run in trained if place.suite not in run.evaluations]
    if waiting and not place.candidates:
        return f"srlrace eval {' '.join(waiting)} --episodes {experiment.episodes} --suite {place.suite}"
    steps = group.algo.total_steps if group else place.config.algo.total_steps
    option = f" --steps {steps}" if steps != place.config.algo.total_steps else ""
    return f"srlrace sweep {experiment.name}{option}"


def _comparisons(
    experiment: Experiment, places: Sequence[Place], chosen: Sequence[Group | None]
) -> tuple[Comparison, ...]:
    found = []
    for first, second in _pairs(experiment):
        a, b = chosen[first], chosen[second]
        if a is None or b is None or a.algo != b.algo:
            continue
        seeds = sorted(a.runs.keys() & b.runs.keys())
        evaluations = [(a.runs[seed].evaluations[a.suite], b.runs[seed].evaluations[b.suite]) for seed in seeds]
        result = paired_difference(evaluations, experiment.paired)
        if result:
            words = _compared(experiment, places[first], places[second])
            found.append(Comparison(*words, experiment.paired, *result))
    return tuple(found)


def _compared(experiment: Experiment, first: Place, second: Place) -> tuple[str, str, str]:
    """Return what two cells have in common, and what each of them is."""
    if experiment.pairs != "suites":
        return _environment(first), first.row.method, second.row.method
    a, b = (describe_suite(place.suite) or "training maps" for place in (first, second))
    return f"{first.row.environment}, {first.row.method}", a, b
