"""Put the page together: sections, style and script, under a policy that lets nothing else in."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path

from srlrace import __version__
from srlrace.report.collect import Run
from srlrace.report.experiments import Paper
from srlrace.report.figures import report_plots
from srlrace.report.layout import heading
from srlrace.report.model import Report, Table
from srlrace.report.page.findings import findings
from srlrace.report.page.html import Html, join, tag
from srlrace.report.page.methods import methods_html
from srlrace.report.page.provenance import cells_html, runs_html
from srlrace.report.page.svg import figure_html
from srlrace.report.page.tables import comparison_text, others_html, table_html
from srlrace.report.plots import Plot
from srlrace.report.style import DARK, NAMES

TITLE = "Time-optimal flight through clutter: results beside the paper's"
NO_FLIGHTS = "No flights are drawn: there is no recording, and none could be flown again that ends as it was evaluated."
HERE = Path(__file__).parent


def render_page(report: Report, runs: Sequence[Run], paper: Paper, fly: bool = True) -> str:
    """Return the page; with ``fly``, runs without a recording fly a few episodes again for the pictures."""
    known = {run.id: run for run in runs}
    used = {run: known[run] for table in report.tables for cell in table.cells for run in cell.runs}
    used |= {other.run: known[other.run] for other in report.others}
    sections = [
        _section(
            "summary", "Summary", tag("ul", *(tag("li", line) for line in findings(report, runs)), class_="findings")
        )
    ]
    sections += [_table_section(table, plots) for table, plots in report_plots(report, runs, fly)]
    if report.others:
        sections.append(_section("others", "Runs outside the tables", others_html(report.others)))
    if report.problems:
        lines = tag("ul", *(tag("li", line) for line in report.problems))
        sections.append(_section("problems", "Files that could not be read", lines))
    sections.append(_section("methods", "Methods and caveats", methods_html(paper)))
    cells = tag("details", tag("summary", "Every cell, seed by seed"), cells_html(report, known), class_="all")
    origin = join((tag("p", "A number in a table leads to its cell here, a cell to its runs."), cells, runs_html(used)))
    sections.append(_section("provenance", "Provenance", origin))
    return _document(_header(report, used), _contents(report), sections)


def _table_section(table: Table, plots: Sequence[Plot]) -> Html:
    name = table.experiment.name
    if not any(cell.numbers for cell in table.cells):
        command = tag("code", f"srlrace sweep {name}")
        empty = tag("p", "Not run yet. ", command, " trains and evaluates it.", class_="missing")
        return _section(name, heading(table), empty, table_html(table) if table.experiment.paper_table else "")
    results = [plot for plot in plots if plot.name.endswith("-results")]
    compared = (
        [tag("ul", *(tag("li", comparison_text(each)) for each in table.comparisons))] if table.comparisons else []
    )
    notes = [tag("ul", *(tag("li", note) for note in table.notes), class_="notes")] if table.notes else []
    figures = [figure_html(plot) for plot in (*results, *(plot for plot in plots if plot not in results))]
    if len(results) < len(plots) and not any(plot.name.endswith("-trajectories") for plot in plots):
        notes.append(tag("p", NO_FLIGHTS, class_="notes"))
    return _section(name, heading(table), table_html(table), *compared, *notes, *figures)


def _section(name: str, title: str, *parts: object) -> Html:
    return tag("section", tag("h2", title, id=f"{name}-title"), *parts, id=name, aria_labelledby=f"{name}-title")


def _header(report: Report, runs: dict[str, Run]) -> Html:
    flights = sum(len(evaluation.episode) for run in runs.values() for evaluation in run.evaluations.values())
    filled = sum(cell.numbers is not None for table in report.tables for cell in table.cells)
    facts = ((len(runs), "trained policies"), (f"{flights:,}", "evaluated flights"), (filled, "cells filled"))
    numbers = tag("ul", *(tag("li", tag("b", value), f" {name}") for value, name in facts), class_="facts")
    words = (
        "Ours with 95 % intervals beside the numbers of Xiao et al., “Time-optimal Flight in Cluttered Environments "
        "via Safe Reinforcement Learning”. Click a number to see the runs behind it."
    )
    theme = tag("button", "Theme: auto", type="button", id="theme", hidden=True)
    top = tag("p", tag("span", f"srlrace {__version__} · report"), theme, class_="kicker")
    return tag("header", top, tag("h1", TITLE), tag("p", words, class_="lede"), numbers)


def _contents(report: Report) -> Html:
    entries = [("summary", "Summary"), *((table.experiment.name, _short(table)) for table in report.tables)]
    entries += [("others", "Other runs")] if report.others else []
    entries += [("problems", "Problems")] if report.problems else []
    entries += [("methods", "Methods and caveats"), ("provenance", "Provenance")]
    links = (tag("li", tag("a", title, href=f"#{name}")) for name, title in entries)
    return tag("nav", tag("ol", *links), aria_label="Contents")


def _short(table: Table) -> str:
    title = table.experiment.title.removesuffix(" (beyond the paper)")
    return f"{table.experiment.paper_table}: {title}" if table.experiment.paper_table else title


def _document(header: Html, contents: Html, sections: Sequence[Html]) -> str:
    style = f"{(HERE / 'page.css').read_text(encoding='utf-8')}\n{_palette()}"
    script = (HERE / "page.js").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}; base-uri 'none'; form-action 'none'"
    )
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", TITLE),
        tag("style", Html(style)),
    )
    dialog = tag(
        "dialog", tag("button", "Close", type="button", id="close"), tag("div", id="origin"), id="drawer",
        aria_label="Where this number comes from",
    )  # fmt: skip
    skip = tag("a", "To the summary", href="#summary", class_="skip")
    footer = tag(
        "footer", tag("p", f"Made by srlrace {__version__} from the files of the runs named; no network, no tracking.")
    )
    main = tag("main", header, *sections, footer)
    body = tag("body", skip, contents, main, dialog, tag("script", Html(script)))
    return f"<!doctype html>\n{tag('html', head, body, lang='en')}\n"


def _hash(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def _palette() -> str:
    """Return the figures' colours in both themes, and a class for each that colours text."""
    light = "".join(f"{name}:{colour};" for colour, name in NAMES.items())
    dark = "".join(f"{NAMES[colour]}:{other};" for colour, other in DARK.items())
    marks = "".join(f".{name[2:]}{{color:var({name})}}" for name in NAMES.values())
    return (
        f":root{{{light}}}\n@media screen and (prefers-color-scheme:dark){{:root:not([data-theme=light]){{{dark}}}}}\n"
        f"@media screen{{:root[data-theme=dark]{{{dark}}}}}\n{marks}\n"
    )
