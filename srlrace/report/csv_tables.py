"""The report as CSV: one file per table, one row per cell."""

from __future__ import annotations

import csv
import io

from srlrace.report.model import Cell, Estimate, Table

COLUMNS = (
    "environment", "method", "time_s", "time_lo", "time_hi", "crash_pct", "crash_lo", "crash_hi", "finished", "crashed",
    "episodes", "seeds", "penalised_time_s", "t_ref_s", "gap_pct", "paper_time_s", "paper_crash_pct", "runs",
)  # fmt: skip
FORMULA_STARTS = ("=", "+", "-", "@")  # a spreadsheet would run what begins so

Value = str | int | float | None


def render_csv(table: Table) -> str:
    """Return the table as CSV; fields that do not apply are empty, run ids are separated by blanks."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(map(fields, table.cells))
    return text.getvalue()


def fields(cell: Cell) -> dict[str, str]:
    """Return a cell's fields by column, as they are written."""
    return {key: _field(value) for key, value in zip(COLUMNS, _row(cell), strict=True)}


def _row(cell: Cell) -> tuple[Value, ...]:
    numbers = cell.numbers
    paper = (cell.paper.time_s, cell.paper.crash_pct)
    if numbers is None:
        return (cell.environment, cell.method, *(None,) * 6, None, None, None, 0, None, cell.t_ref_s, None, *paper, "")
    return (
        cell.environment,
        cell.method,
        *_ends(numbers.time_s),
        *_ends(numbers.crash_pct),
        numbers.finished,
        numbers.crashed,
        numbers.episodes,
        len(numbers.seeds),
        numbers.penalised_time_s,
        cell.t_ref_s,
        cell.gap_pct,
        *paper,
        " ".join(cell.runs),
    )


def _ends(value: Estimate | None) -> tuple[Value, Value, Value]:
    return (None, None, None) if value is None else (value.value, value.low, value.high)


def _field(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    text = " ".join(str(value).split())  # one line: readers disagree about a bare carriage return
    return f"'{text}" if text.startswith(FORMULA_STARTS) else text
