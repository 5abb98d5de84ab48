"""The tables of the page: every number carries its value as in the CSV and leads to where it comes from."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby

from srlrace.report.csv_tables import fields
from srlrace.report.layout import NOT_RUN, estimate
from srlrace.report.model import Cell, Comparison, Estimate, OtherRun, Table
from srlrace.report.page.html import Html, join, scrolling, tag

DASH = "\N{EN DASH}"
NONE = tag("span", DASH)
COUNTED = ("Finished", "Crashed", "Penalised|s")
MINUS = "\N{MINUS SIGN}"


def cell_anchor(table: Table, index: int) -> str:
    """Return the id of the section that says where a cell's numbers come from."""
    return f"cell-{table.experiment.name}-{index}"


def table_html(table: Table) -> Html:
    """Return a table's cells by environment."""
    columns = _columns(table)
    head = tag("thead", tag("tr", *(tag("th", *_title(name), scope="col") for name in ("Method", *columns))))
    numbered = list(enumerate(table.cells))
    bodies = []
    for environment, cells in groupby(numbered, key=lambda entry: entry[1].environment):
        name = tag("tr", tag("th", environment, scope="rowgroup", colspan=len(columns) + 1), class_="environment")
        bodies.append(tag("tbody", name, *(_row(table, index, cell, columns) for index, cell in cells)))
    title = f"{table.experiment.title}: means over training seeds with 95 % intervals"
    return scrolling(tag("table", tag("caption", title), head, *bodies, data_table=table.experiment.name), title)


def _columns(table: Table) -> list[str]:
    prints = table.experiment.columns if table.experiment.paper_table else ()
    referenced = any(cell.t_ref_s is not None for cell in table.cells)
    columns = ["Time|s", *(["Paper|s"] if "time" in prints else []), *(["T_ref|s", "Gap|%"] if referenced else [])]
    columns += [
        "Crash|%",
        *(["Paper|%"] if "crash" in prints else []),
    ]
    return [*columns, *COUNTED, "Seeds"]


def _title(name: str) -> tuple[object, ...]:
    word, _, unit = name.partition("|")
    shown = Html("T<sub>ref</sub>") if word == "T_ref" else word
    return (shown, Html(" "), tag("span", unit, class_="unit")) if unit else (shown,)


def _row(table: Table, index: int, cell: Cell, columns: list[str]) -> Html:
    values = _values(table, cell, cell_anchor(table, index))
    name = tag("th", cell.method, scope="row")
    return tag("tr", name, *(tag("td", values[column]) for column in columns), data_row=index)


def _values(table: Table, cell: Cell, anchor: str) -> dict[str, object]:
    written, numbers = fields(cell), cell.numbers

    def value(column: str, shown: str) -> Html:
        return tag("data", shown, value=written[column], data_column=column) if written[column] else NONE

    def linked(*parts: object) -> Html:
        return tag("a", *parts, href=f"#{anchor}", class_="number")

    shown: dict[str, object] = {
        "Paper|s": value("paper_time_s", f"{cell.paper.time_s or 0:.2f}"),
        "Paper|%": value("paper_crash_pct", f"{cell.paper.crash_pct or 0:.2f}"),
        "T_ref|s": value("t_ref_s", f"{cell.t_ref_s or 0:.2f}"),
        "Gap|%": value("gap_pct", f"{cell.gap_pct or 0:.1f}".replace("-", MINUS)),
        "Seeds": join((value("seeds", str(len(numbers.seeds) if numbers else 0)), f"/{table.experiment.seeds}")),
    }
    if numbers is None:
        missing = tag("a", NOT_RUN, href=f"#{anchor}", class_="missing")
        return shown | {"Time|s": missing, "Crash|%": missing, **dict.fromkeys(COUNTED, NONE)}
    total = (tag("span", "/", value("episodes", str(numbers.episodes)), class_="unit"),)
    return shown | {
        "Time|s": linked(*_estimate(value, "time", numbers.time_s)),
        "Crash|%": linked(*_estimate(value, "crash", numbers.crash_pct)),
        "Finished": linked(value("finished", str(numbers.finished)), *total),
        "Crashed": linked(value("crashed", str(numbers.crashed)), *total),
        "Penalised|s": linked(value("penalised_time_s", f"{numbers.penalised_time_s:.2f}")),
    }


def _estimate(value: Callable[[str, str], Html], name: str, found: Estimate | None) -> tuple[object, ...]:
    if found is None:
        return (DASH,)
    unit = "s" if name == "time" else "pct"
    ends = (value(f"{name}_lo", f"{found.low:.2f}"), ", ", value(f"{name}_hi", f"{found.high:.2f}"))
    return value(f"{name}_{unit}", f"{found.value:.2f}"), tag("span", " [", *ends, "]", class_="interval")


def in_sentence(method: str) -> str:
    """Return a method's name in quotes where its commas would be taken for those of the sentence around it."""
    return f"\N{LEFT DOUBLE QUOTATION MARK}{method}\N{RIGHT DOUBLE QUOTATION MARK}" if "," in method else method


def comparison_text(comparison: Comparison) -> str:
    """Return a paired difference as a sentence that says what it is evidence of."""
    first, second = in_sentence(comparison.first), in_sentence(comparison.second)
    difference, unit = comparison.difference, "s" if comparison.quantity == "time" else "percentage points"
    seeds = "one common seed, so within-run only" if comparison.seeds == 1 else f"{comparison.seeds} common seeds"
    what = "time" if comparison.quantity == "time" else "crash ratio"
    verdict = "no evidence of a difference"
    if difference.low > 0 or difference.high < 0:
        verdict = f"{first} has the {'higher' if difference.low > 0 else 'lower'} {what}"
    value = estimate(difference).replace("-", MINUS)
    return (
        f"{comparison.environment}, {first} against {second}: a difference in {what} of {value} "
        f"{unit}, paired on {seeds}: {verdict}."
    )


def others_html(others: tuple[OtherRun, ...]) -> Html:
    """Return the evaluated runs that stand in no table."""
    head = ("Run", "Method", "Suite", "Time (s)", "Crash (%)", "Finished")
    rows = (
        tag(
            "tr",
            tag("th", tag("a", other.run, href=f"#run-{other.run}"), scope="row"),
            *(tag("td", part) for part in (other.method, other.suite, estimate(other.numbers.time_s))),
            *(
                tag("td", part)
                for part in (estimate(other.numbers.crash_pct), f"{other.numbers.finished}/{other.numbers.episodes}")
            ),
        )
        for other in others
    )
    title = "Evaluated runs that stand in no table"
    heads = tag("thead", tag("tr", *(tag("th", name, scope="col") for name in head)))
    return scrolling(tag("table", tag("caption", title), heads, tag("tbody", *rows)), title)
