"""The report as GitHub-flavoured Markdown."""

from __future__ import annotations

import re

from srlrace.report.layout import OTHERS_TITLE, Grid, footnotes, grid, heading, others_grid
from srlrace.report.model import Report, Table

SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|~$&])")
TEXT_COLUMNS = ("Environment", "Method", "Runs", "Run", "Suite")  # aligned left, the others right


def render_markdown(report: Report) -> str:
    """Return the whole report: tables, runs outside them, and what could not be read."""
    parts = [markdown_table(table) for table in report.tables]
    if report.others:
        parts.append(f"## {OTHERS_TITLE}\n\n{_grid(others_grid(report.others))}\n")
    if report.problems:
        parts.append("## Not readable\n\n" + "".join(f"- {escape(line)}\n" for line in report.problems))
    return "\n".join(parts)


def markdown_table(table: Table) -> str:
    """Return one table with its heading and footnotes."""
    notes = "".join(f"- {escape(line)}\n" for line in footnotes(table))
    return f"## {escape(heading(table))}\n\n{_grid(grid(table))}\n\n{notes}"


def escape(text: str) -> str:
    """Return text that Markdown and the HTML made from it show as it is, on one line."""
    return SPECIAL.sub(r"\\\1", " ".join(text.split()))


def _grid(grid: Grid) -> str:
    rules = (":--" if name in TEXT_COLUMNS else "--:" for name in grid.head)
    lines = [map(escape, grid.head), rules, *(map(escape, row) for row in grid.rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
