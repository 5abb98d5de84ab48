"""The report in a terminal of 80 columns or more."""

from __future__ import annotations

from itertools import groupby

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from srlrace.report.layout import NOT_RUN, OTHERS_TITLE, footnotes, heading, marks, number, others_grid
from srlrace.report.model import Cell, Estimate, Numbers, OtherRun, Report, Table
from srlrace.text import clean

LONG = 1000  # runs outside the tables that nobody reads from top to bottom


def print_report(report: Report, console: Console) -> None:
    """Print the tables, the runs outside them, and what could not be read."""
    for table in report.tables:
        console.print(terminal_table(table))
    if len(report.others) > LONG:
        console.print(Text(OTHERS_TITLE, style="bold"))
        console.out(_lines(report.others), highlight=False)
    elif report.others:
        console.print(_others(report.others))
    for line in report.problems:
        console.print(Text(f"! {line}", style="yellow"))


def terminal_table(table: Table) -> RenderableType:
    """Return one table: the paper's number beside ours in brackets, the interval under them."""
    if not table.experiment.paper_table and not any(cell.numbers for cell in table.cells):
        line = Text(f"  {NOT_RUN}; to run: {table.cells[0].command}", style="dim")
        return Group(Text(heading(table), style="bold"), line, Text())
    paper = " (paper)" if table.experiment.paper_table else ""
    names = ("Method", f"Time (s)\nours{paper}", f"Crash (%)\nours{paper}", "Finished\nCrashed")
    view = _table(heading(table), (*names, "Penalised\ntime (s)", "Seeds"))
    numbered = zip(marks(len(table.cells)), table.cells, strict=True)
    for environment, cells in groupby(numbered, key=lambda entry: entry[1].environment):
        view.add_row(Text(environment, style="bold"))
        for mark, cell in cells:
            view.add_row(*map(_text, _values(cell, mark, table.experiment.seeds)))
        view.add_section()
    notes = [Text(f"  {line}", style="dim", overflow="fold") for line in footnotes(table)]
    return Group(view, *notes, Text())


def _lines(others: tuple[OtherRun, ...]) -> str:
    """Return what `_others` shows, as plain lines: laying out thousands of rows takes longer than their statistics."""
    table = others_grid(others)
    rows = [[clean(cell) for cell in row] for row in (table.head, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows) + "\n"


def _others(others: tuple[OtherRun, ...]) -> RenderableType:
    view = _table(OTHERS_TITLE, ("Run", "Time (s)", "Crash (%)", "Finished\nCrashed"))
    for other in others:
        name = Text(other.run, overflow="fold").append(f"\n{other.method}, {other.suite}", style="dim")
        numbers = other.numbers
        view.add_row(name, *map(_text, (_interval(numbers.time_s), _interval(numbers.crash_pct), _counts(numbers))))
    return Group(view, Text())


def _table(title: str, names: tuple[str, ...]) -> RichTable:
    style = {"title": Text(title, style="bold"), "title_justify": "left", "box": box.SIMPLE_HEAD}
    view = RichTable(**style, padding=(0, 1, 0, 0))  # type: ignore[arg-type]
    view.add_column(Text(names[0]), min_width=16, overflow="fold")
    for name in names[1:]:
        view.add_column(Text(name), justify="right", no_wrap=True)
    return view


def _values(cell: Cell, mark: str, seeds: int) -> tuple[str, ...]:
    numbers, name = cell.numbers, f"{mark}  {cell.method}"
    if numbers is None:
        papers = (cell.paper.time_s, cell.paper.crash_pct)
        return (name, *(_beside(NOT_RUN, paper, "\n") for paper in papers), "-", "-", f"0/{seeds}")
    return (
        name,
        _interval(numbers.time_s, cell.paper.time_s),
        _interval(numbers.crash_pct, cell.paper.crash_pct),
        _counts(numbers),
        number(numbers.penalised_time_s),
        f"{len(numbers.seeds)}/{seeds}",
    )


def _interval(value: Estimate | None, paper: float | None = None) -> str:
    if value is None:
        return _beside("-", paper)
    return f"{_beside(number(value.value), paper)}\n[{value.low:.2f}, {value.high:.2f}]"


def _beside(ours: str, paper: float | None, separator: str = " ") -> str:
    return ours if paper is None else f"{ours}{separator}({paper:.2f})"


def _counts(numbers: Numbers) -> str:
    return f"{numbers.finished}/{numbers.episodes}\n{numbers.crashed}/{numbers.episodes}"


def _text(value: str) -> Text:
    """Return the value as it is, never read as markup."""
    return Text(value, style="dim italic" if value.startswith(NOT_RUN) else "")
