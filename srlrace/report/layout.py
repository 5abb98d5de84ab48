"""Lay a table out as plain text cells and sentences; each format only escapes and aligns them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from string import ascii_lowercase

from srlrace.report.model import Cell, Comparison, Estimate, Numbers, OtherRun, Table

NOT_RUN = "not run"
OTHERS_TITLE = "Evaluated runs outside these tables"
OTHERS_HEAD = ("Run", "Method", "Suite", "Time (s)", "Crash (%)", "Finished", "Crashed")


@dataclass(frozen=True)
class Grid:
    """Column headings and rows of text, all of one length."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def grid(table: Table) -> Grid:
    """Return every cell of a table as one row: ours with intervals, the paper's beside it, counts, and a run mark."""
    prints = table.experiment.columns if table.experiment.paper_table else ()
    referenced = any(cell.t_ref_s is not None for cell in table.cells)
    head = ["Environment", "Method", "Time (s)", *(["Paper (s)"] if "time" in prints else [])]
    head += ["Crash (%)", *(["Paper (%)"] if "crash" in prints else [])]
    head += ["Finished", "Crashed", "Penalised (s)", *(["T_ref (s)", "Gap (%)"] if referenced else []), "Seeds", "Runs"]
    rows = []
    for mark, cell in zip(marks(len(table.cells)), table.cells, strict=True):
        values = _values(cell, table.experiment.seeds, mark)
        rows.append(tuple(values[name] for name in head))
    return Grid(tuple(head), tuple(rows))


def footnotes(table: Table) -> tuple[str, ...]:
    """Return the sentences under a table: runs and remarks by mark, comparisons, what fills the gaps, general notes."""
    marked = list(zip(marks(len(table.cells)), table.cells, strict=True))
    filled = [(mark, cell) for mark, cell in marked if cell.numbers]
    short = [(mark, cell) for mark, cell in marked if _seed_count(cell) < table.experiment.seeds]
    lines = [f"Runs of {cells}: {runs}" for runs, cells in _by_text((m, ", ".join(c.runs)) for m, c in filled)]
    lines += [f"{cells}: {note}." for note, cells in _by_text((m, note) for m, c in filled for note in c.notes)]
    iqms = [f"{mark} {_iqm(cell.numbers)}" for mark, cell in filled if cell.numbers and cell.numbers.time_iqm_s]
    lines += [f"Interquartile means over seeds: {'; '.join(iqms)}."] if iqms else []
    lines += [_comparison(comparison) for comparison in table.comparisons]
    lines += [f"To run or complete {cells}: {command}" for command, cells in _by_text((m, c.command) for m, c in short)]
    return (*lines, *table.notes)


def _by_text(marked: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return each distinct text with the marks that it belongs to."""
    found: dict[str, list[str]] = {}
    for mark, text in marked:
        found.setdefault(text, []).append(mark)
    return [(text, ", ".join(together)) for text, together in found.items()]


def _seed_count(cell: Cell) -> int:
    return len(cell.numbers.seeds) if cell.numbers else 0


def heading(table: Table) -> str:
    """Return the table's title with its number in the paper."""
    source = f" (the paper's {table.experiment.paper_table})" if table.experiment.paper_table else ""
    return f"{table.experiment.title}{source}"


def others_grid(others: Sequence[OtherRun]) -> Grid:
    """Return the runs that stand in no table, one row per run and suite."""
    return Grid(OTHERS_HEAD, tuple(_other(other) for other in others))


def marks(count: int) -> list[str]:
    """Return a, b, ... z, aa, ab, ...: the marks that tie a row to its footnote."""
    letters = len(ascii_lowercase)
    return [ascii_lowercase[i // letters - 1] * (i >= letters) + ascii_lowercase[i % letters] for i in range(count)]


def estimate(value: Estimate | None) -> str:
    """Return ``5.02 [4.98, 5.07]``, or a dash."""
    return "-" if value is None else f"{value.value:.2f} [{value.low:.2f}, {value.high:.2f}]"


def number(value: float | None) -> str:
    """Return two decimals, or a dash."""
    return "-" if value is None else f"{value:.2f}"


def _values(cell: Cell, seeds: int, mark: str) -> dict[str, str]:
    values = {
        "Environment": cell.environment,
        "Method": cell.method,
        "Paper (s)": number(cell.paper.time_s),
        "Paper (%)": number(cell.paper.crash_pct),
        "T_ref (s)": number(cell.t_ref_s),
        "Gap (%)": number(cell.gap_pct),
        "Runs": mark,
    }
    numbers = cell.numbers
    if numbers is None:
        empty = dict.fromkeys(("Time (s)", "Crash (%)"), NOT_RUN)
        return values | empty | dict.fromkeys(("Finished", "Crashed", "Penalised (s)"), "-") | {"Seeds": f"0/{seeds}"}
    return values | {
        "Time (s)": estimate(numbers.time_s),
        "Crash (%)": estimate(numbers.crash_pct),
        "Finished": f"{numbers.finished}/{numbers.episodes}",
        "Crashed": f"{numbers.crashed}/{numbers.episodes}",
        "Penalised (s)": number(numbers.penalised_time_s),
        "Seeds": f"{len(numbers.seeds)}/{seeds}",
    }


def _other(other: OtherRun) -> tuple[str, ...]:
    n = other.numbers
    counts = f"{n.finished}/{n.episodes}", f"{n.crashed}/{n.episodes}"
    return other.run, other.method, other.suite, estimate(n.time_s), estimate(n.crash_pct), *counts


def _iqm(numbers: Numbers) -> str:
    return f"{estimate(numbers.time_iqm_s)} s, {estimate(numbers.crash_iqm_pct)} %"


def _comparison(comparison: Comparison) -> str:
    unit = "s" if comparison.quantity == "time" else "percentage points"
    seeds = "1 common seed (within-run interval)" if comparison.seeds == 1 else f"{comparison.seeds} common seeds"
    return (
        f"{comparison.environment}, {comparison.quantity} {comparison.first} minus {comparison.second}: "
        f"{estimate(comparison.difference)} {unit}, paired on {seeds}."
    )
