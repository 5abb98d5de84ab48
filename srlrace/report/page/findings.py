"""The report in sentences: what the tables say, worded from their numbers and from nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from srlrace.report.collect import Run
from srlrace.report.layout import number
from srlrace.report.model import Cell, Estimate, Report, Table
from srlrace.report.page.html import Html, tag
from srlrace.report.page.tables import comparison_text, in_sentence

NBSP = "\N{NO-BREAK SPACE}"


def findings(report: Report, runs: Sequence[Run]) -> list[Html]:
    """Return the summary, a sentence or a few each."""
    lines = [_coverage(report, runs)]
    for table in report.tables:
        link = tag("a", (table.experiment.paper_table or "table").replace(" ", NBSP), href=f"#{table.experiment.name}")
        lines += [tag("span", sentence, " (", link, ")") for sentence in _table(table)]
    lines += [_failures(report, runs), _seeds(report)]
    return [line for line in lines if line]


def _coverage(report: Report, runs: Sequence[Run]) -> Html:
    cells = [cell for table in report.tables for cell in table.cells]
    filled = [cell for cell in cells if cell.numbers]
    used = {run for cell in filled for run in cell.runs}
    flown = sum(len(evaluation.episode) for run in runs if run.id in used for evaluation in run.evaluations.values())
    missing = [table.experiment.name for table in report.tables if not all(cell.numbers for cell in table.cells)]
    rest = f" Still to be completed: {', '.join(missing)}." if missing else ""
    return tag(
        "span", f"{len(filled)} of {len(cells)} cells are filled, from {_count(len(used), 'trained run')} and "
        f"{flown:,} evaluated flights.{rest}",
    )  # fmt: skip


def _table(table: Table) -> Iterator[str]:
    filled = [cell for cell in table.cells if cell.numbers]
    for environment, group in groupby(filled, key=lambda cell: cell.environment):
        cells = list(group)
        if "time" in table.experiment.columns and len(cells) > 1 and not table.experiment.paired:
            yield f"{environment}: {_fastest(cells)} {_safest(cells)}{_paper(cells)}{_gap(cells)}"
    for comparison in table.comparisons:
        yield comparison_text(comparison)


def _fastest(cells: Sequence[Cell]) -> str:
    timed = sorted((cell for cell in cells if _time(cell)), key=lambda cell: _time(cell).value)  # type: ignore[union-attr]
    if not timed:
        return "no flight finished."
    first = timed[0]
    best, finished = _time(first), first.numbers
    assert best is not None
    assert finished is not None
    close = [in_sentence(cell.method) for cell in timed[1:] if _time(cell).low <= best.high]  # type: ignore[union-attr]
    versus = (
        f", not clearly ahead of {' and '.join(close)}"
        if close
        else ", clearly ahead of the others"
        if timed[1:]
        else ""
    )
    count = f"{finished.finished} of {finished.episodes} flights finished"
    sentence = f"{in_sentence(first.method)} is fastest at {_with_interval(best, 's')} ({count}){versus}"
    return sentence.removesuffix(".") + "."


def _safest(cells: Sequence[Cell]) -> str:
    crashes = {cell.method: cell.numbers.crash_pct for cell in cells if cell.numbers}
    least = min(estimate.value for estimate in crashes.values())
    names = [method for method, estimate in crashes.items() if estimate.value == least]
    who, verb = " and ".join(map(in_sentence, names)), "crash" if len(names) > 1 else "crashes"
    if least == 0:
        return f"{who} {verb} in none of the evaluated flights."
    least_often = _with_interval(crashes[names[0]], "%")
    return f"{who} {verb} least, in {least_often} of flights; no method is without crashes."


def _paper(cells: Sequence[Cell]) -> str:
    pairs = [(cell, _time(cell), cell.paper.time_s) for cell in cells if cell.paper.time_s is not None]
    sides = [(cell.method, time, paper) for cell, time, paper in pairs if time is not None and paper is not None]
    if not sides:
        return ""
    words = (f"{in_sentence(method)} is {_side(time, paper)} {paper:.2f} s" for method, time, paper in sides)
    return f" Beside the paper's times: {', '.join(words)}."


def _side(time: Estimate, paper: float) -> str:
    if time.high < paper:
        return "faster than its"
    return "slower than its" if time.low > paper else "level with its"


def _gap(cells: Sequence[Cell]) -> str:
    gaps = [f"{in_sentence(cell.method)} {cell.gap_pct:.0f} %" for cell in cells if cell.gap_pct is not None]
    # Over several maps a mean of those that a method finished on, so that methods may differ.
    references = sorted(
        {f"{cell.t_ref_s:.2f}" for cell in cells if cell.gap_pct is not None and cell.t_ref_s is not None}
    )
    known = f"time of {references[0]} s" if len(references) == 1 else f"times of {' or '.join(references)} s"
    return f" Slower than the best known {known} by: {', '.join(gaps)}." if gaps else ""


def _failures(report: Report, runs: Sequence[Run]) -> Html:
    """Say where flights of the first filled table ended that did not finish."""
    known = {run.id: run for run in runs}
    table = next((table for table in report.tables if any(cell.runs for cell in table.cells)), None)
    if table is None:
        return Html("")
    flown = [known[run].evaluations[cell.suite] for cell in table.cells for run in cell.runs]
    failed = sum(int((~evaluation.finished).sum()) for evaluation in flown)
    early = sum(int((~evaluation.finished & (evaluation.gates_passed == 0)).sum()) for evaluation in flown)
    if not failed:
        return Html("")
    share = 100 * early / failed
    return tag(
        "span", f"Of the {failed:,} flights behind {table.experiment.paper_table or 'the first table'} that did not "
        f"finish, {early:,} ({share:.0f} %) had not passed a single waypoint: they failed from their random start.",
    )  # fmt: skip


def _seeds(report: Report) -> Html:
    counts = [
        (len(cell.numbers.seeds), table.experiment.seeds)
        for table in report.tables
        for cell in table.cells
        if cell.numbers
    ]
    if not counts:
        return Html("")
    least, planned = min(counts)
    if least >= planned:
        return tag("span", f"Every filled cell rests on {planned} training seeds or more, the unit of replication.")
    most = max(count for count, _ in counts)
    span = str(least) if least == most else f"{least} to {most}"
    return tag(
        "span", f"Cells rest on {span} of {planned} planned training seeds. Intervals over so few are too narrow: read "
        "two that barely miss each other as undecided.",
    )  # fmt: skip


def _time(cell: Cell) -> Estimate | None:
    return cell.numbers.time_s if cell.numbers else None


def _with_interval(estimate: Estimate, unit: str) -> str:
    return f"{number(estimate.value)} {unit} [{number(estimate.low)}, {number(estimate.high)}]"


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def seeds_of(cell: Cell, runs: dict[str, Run]) -> list[tuple[int, Run, float | None, float]]:
    """Return seed, run, mean time of finished flights [s] and crash ratio [%] of each run of a cell."""
    found = []
    for run in (runs[name] for name in cell.runs):
        evaluation = run.evaluations[cell.suite]
        time = float(np.mean(evaluation.time_s[evaluation.finished])) if evaluation.finished.any() else None
        found.append((run.config.seed, run, time, 100 * float(evaluation.crashed.mean())))
    return found
