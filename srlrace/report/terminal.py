"""The report in a terminal."""

from __future__ import annotations

from itertools import groupby

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from srlrace.report.layout import NOT_RUN, OTHERS_TITLE, footnotes, grid, heading, others_grid
from srlrace.report.markdown import TEXT_COLUMNS
from srlrace.report.model import Report, Table


def print_report(report: Report, console: Console) -> None:
    """Print the tables, the runs outside them, and what could not be read."""
    for table in report.tables:
        console.print(terminal_table(table))
    if report.others:
        console.print(_others(report))
    for line in report.problems:
        console.print(Text(f"! {line}", style="yellow"))


def terminal_table(table: Table) -> RenderableType:
    """Return one table that fits 80 columns: intervals stand under their value, methods under their environment."""
    laid = grid(table)
    view = _table(heading(table))
    for name in laid.head[1:]:
        view.add_column(_narrow(name), justify="left" if name in TEXT_COLUMNS else "right", no_wrap=name != "Method")
    for environment, rows in groupby(laid.rows, key=lambda row: row[0]):
        view.add_row(Text(environment, style="bold"))
        for row in rows:
            view.add_row(*(_text(value) for value in row[1:]))
        view.add_section()
    notes = [Text(f"  {line}", style="dim", overflow="fold") for line in footnotes(table)]
    return Group(view, *notes, Text())


def _others(report: Report) -> RenderableType:
    laid = others_grid(report.others)
    view = _table(OTHERS_TITLE)
    for name in laid.head:
        view.add_column(_narrow(name), justify="left" if name in TEXT_COLUMNS else "right", overflow="fold")
    for row in laid.rows:
        view.add_row(*(_text(value) for value in row))
    return Group(view, Text())


def _table(title: str) -> RichTable:
    return RichTable(title=Text(title, style="bold"), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))


def _narrow(heading: str) -> Text:
    return Text(heading.replace(" (", "\n("))


def _text(value: str) -> Text:
    """Return the value as it is, never as markup: its interval and its count on a line of their own."""
    return Text(value.replace(" [", "\n["), style="dim italic" if value == NOT_RUN else "")
