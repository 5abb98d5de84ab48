"""What hostile names may do to each format: nothing."""

from __future__ import annotations

import csv
import io

import pytest
from rich.console import Console

from srlrace.report import latex, markdown
from srlrace.report.csv_tables import render_csv
from srlrace.report.experiments import Experiment, PaperCell, Row
from srlrace.report.layout import grid, marks
from srlrace.report.model import Cell, Estimate, Numbers, OtherRun, Report, Table
from srlrace.report.terminal import LONG, print_report, terminal_table

NUMBERS = Numbers(
    time_s=Estimate(5.0, 4.9, 5.1), time_iqm_s=None, crash_pct=Estimate(0.0, 0.0, 0.37), crash_iqm_pct=None,
    penalised_time_s=5.0, finished=1000, crashed=0, episodes=1000, seeds=(0,),
)  # fmt: skip


def table(method: str, **cell: object) -> Table:
    experiment = Experiment("t", "T", (Row("Forest", method, ()),), ("train_map",), paper_table="Table II")
    settings = {"numbers": NUMBERS, "runs": ("r-s0-1",)} | cell
    paper = PaperCell(7.31, 0.0)
    return Table(experiment, (Cell("Forest", method, "train_map", paper, "srlrace sweep t", **settings),))  # type: ignore[arg-type]


@pytest.mark.parametrize("method", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"])
def test_csv_never_begins_a_field_with_a_formula(method: str) -> None:
    (row,) = csv.DictReader(io.StringIO(render_csv(table(method))))
    assert row["method"] == f"'{method.strip()}"


def test_csv_keeps_commas_and_quotes_in_their_field_and_a_name_on_one_line() -> None:
    (row,) = csv.DictReader(io.StringIO(render_csv(table('a,"b"\nc'))))
    assert row["method"] == 'a,"b" c'
    assert row["episodes"] == "1000"


def test_markdown_shows_markup_as_text() -> None:
    text = markdown.markdown_table(table("a|b <script> [x](y) `z`\n# h"))
    assert r"a\|b \<script\> \[x\](y) \`z\` \# h" in text
    body = [line for line in text.splitlines() if line.startswith("| Forest")]
    assert len(body) == 1


def test_latex_escapes_every_special_character() -> None:
    escaped = latex.escape(r"\input{/etc/passwd} 5% a_b #1 $x$ & ~ ^ [6]")
    assert escaped == (
        r"\textbackslash{}input\{/etc/passwd\} 5\% a\_b \#1 \$x\$ \& \textasciitilde{} \textasciicircum{} {[}6{]}"
    )
    text = latex.latex_table(table("a & b"))
    assert r"a \& b" in text
    assert text.count(r"\toprule") == text.count(r"\bottomrule") == 1


def test_the_terminal_prints_markup_as_text() -> None:
    console = Console(width=80, file=io.StringIO())
    console.print(terminal_table(table("[red]x[/]")))
    assert "[red]x[/]" in console.file.getvalue()  # type: ignore[attr-defined]


def test_a_gap_appears_only_with_a_reference() -> None:
    assert "Gap (%)" not in grid(table("m")).head
    referenced = grid(table("m", t_ref_s=4.0))
    assert dict(zip(referenced.head, referenced.rows[0], strict=True))["Gap (%)"] == "25.00"


def test_marks_go_on_after_z() -> None:
    assert marks(28)[:2] + marks(28)[25:] == ["a", "b", "z", "aa", "ab"]


def test_the_terminal_lists_thousands_of_runs_line_by_line() -> None:
    others = tuple(OtherRun(f"run{i}", "[red]x[/]\x1b", "train_map", NUMBERS) for i in range(LONG + 1))
    few, many = (io.StringIO() for _ in range(2))
    for stream, shown in ((few, others[:LONG]), (many, others)):
        print_report(Report((), shown, ("unreadable",)), Console(file=stream, width=80))
    lines = many.getvalue().splitlines()
    assert "Evaluated runs outside these tables" in lines[0]
    assert lines[2].split() == ["run0", "[red]x[/]\ufffd", "train_map", "5.00", "[4.90,", "5.10]", "0.00", "[0.00,",
                                "0.37]", "1000/1000", "0/1000"]  # fmt: skip
    assert [line.split()[0] for line in lines[2 : LONG + 3]] == [other.run for other in others]
    assert lines[-1] == "! unreadable"
    assert "run0 " in few.getvalue()
    assert len(few.getvalue().splitlines()) > 2 * LONG
