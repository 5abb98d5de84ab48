"""`srlrace report` on run folders in the documented format: every format, hostile content, damaged files."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from srlrace.config import run_id
from srlrace.report import collect
from srlrace.report.command import FORMATS, read_report, report
from srlrace.report.csv_tables import COLUMNS
from srlrace.report.experiments import ExperimentError
from srlrace.runs import list_runs

COUNTED = b"episode,map,outcome,time_s,gates_passed,min_clearance_m\n"
TABLES = ("minimum_time", "generalization", "ablation_safety", "ablation_terminal")


@pytest.fixture(scope="module")
def runs(lab: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five seeds of srl, one run that fits no cell, one with an unfriendly label."""
    root = tmp_path_factory.mktemp("runs")
    srl = lab.compose(("env=forest",))
    for seed in range(5):
        lab.write_run(root, lab.with_seed(srl, seed), {"train_map": [5.0 + 0.1 * seed] * 19 + [None]})
    lab.write_run(root, replace(srl, reward=replace(srl.reward, body_rate=0.5)), {"train_map": [6.0, None]})
    return root


def shown(root: Path, format: str, out: Path | None = None, width: int = 80) -> str:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    report(root, format, out, console)
    stream = console.file
    assert isinstance(stream, io.StringIO)
    return stream.getvalue()


@pytest.mark.parametrize("format", [format for format in FORMATS if format != "html"])
def test_every_format_shows_ours_the_papers_and_what_is_missing(runs: Path, format: str) -> None:
    text = shown(runs, format)
    assert "5.2" in text
    assert "7.31" in text
    assert "90.2" in text
    if format != "csv":
        assert "not run" in text
        assert "srlrace sweep" in text


def test_the_terminal_names_runs_outside_the_tables_and_fits_80_columns(runs: Path) -> None:
    text = shown(runs, "rich")
    _, others = text.split("Evaluated runs outside these tables")
    assert "forest-srl-s0-" in others
    assert "1/2" in others
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert "…" not in text


def test_csv_files_have_the_documented_columns_and_one_row_per_cell(runs: Path, tmp_path: Path) -> None:
    shown(runs, "csv", tmp_path)
    cells = {}
    for name in TABLES:
        with (tmp_path / f"{name}.csv").open(newline="") as stream:
            reader = csv.DictReader(stream)
            cells[name] = list(reader)
            assert tuple(reader.fieldnames or ()) == COLUMNS
    assert [len(cells[name]) for name in TABLES] == [8, 18, 4, 4]
    (row,) = [row for row in cells["minimum_time"] if row["environment"] == "Forest" and row["runs"]]
    assert float(row["time_s"]) == pytest.approx(5.2)
    assert float(row["crash_pct"]) == pytest.approx(5.0)
    assert (row["finished"], row["crashed"], row["episodes"], row["seeds"]) == ("95", "5", "100", "5")
    assert float(row["penalised_time_s"]) == pytest.approx(0.95 * 5.2 + 0.05 * 20)
    assert (row["paper_time_s"], row["paper_crash_pct"]) == ("7.31", "0")
    assert float(row["gap_pct"]) == pytest.approx(100 * (5.2 / float(row["t_ref_s"]) - 1), rel=1e-4)
    assert len(row["runs"].split()) == 5


def test_without_runs_every_cell_is_empty_but_the_papers(tmp_path: Path) -> None:
    _, built = read_report(tmp_path)
    papers = [cell.paper.time_s for table in built.tables for cell in table.cells if cell.paper.time_s]
    assert all(cell.numbers is None for table in built.tables for cell in table.cells)
    assert sorted(set(papers)) == [6.49, 7.11, 7.12, 7.31, 7.33, 7.34, 7.46, 8.57]


def test_the_papers_tables_are_complete_and_in_order(tmp_path: Path) -> None:
    _, built = read_report(tmp_path)
    assert tuple(table.experiment.name for table in built.tables)[:4] == TABLES
    crash = {cell.paper.crash_pct for table in built.tables for cell in table.cells}
    assert crash == {None, 0.0, 1.96, 33.33, 90.2}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (b"", "episodes.csv|No columns|eval/train_map"),
        (b"\xff\xfe\x00garbage", "eval/train_map"),
        (COUNTED + b"0,1,finished,,9,0.4\n", "without time_s"),
        (COUNTED + b"0,1,landed,5.0,9,0.4\n", "unknown outcome"),
        (COUNTED + b"0,1,finished,5.0,-1,0.4\n", "gates_passed"),
        (b"episode,map,outcome,time_s\n0,1,finished,5.0\n", "eval/train_map"),
        (COUNTED + b"0,99999999999999999999999,finished,5.0,9,0.4\n", "eval/train_map"),
    ],
)
def test_a_damaged_evaluation_is_reported_and_the_rest_is_shown(
    lab: SimpleNamespace, tmp_path: Path, damage: bytes, message: str
) -> None:
    config = lab.compose(("env=forest",))
    lab.write_run(tmp_path, config, {"train_map": [5.0]})
    broken = lab.write_run(tmp_path, lab.with_seed(config, 1), {"train_map": [5.0]})
    (broken / "eval" / "train_map" / "episodes.csv").write_bytes(damage)
    _, built = read_report(tmp_path)
    (problem,) = built.problems
    assert any(part in problem for part in message.split("|"))
    assert any(cell.runs == (run_id(config),) for cell in built.tables[0].cells)


def test_many_runs_are_read_as_few_are(lab: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, srl = tmp_path, lab.compose(("env=forest",))
    for seed in range(5):
        lab.write_run(runs, lab.with_seed(srl, seed), {"train_map": [5.0 + seed, None]})
    (runs / "broken").mkdir()
    (runs / "broken" / "config.json").write_text("{")
    read = list(map(_facts, collect._read_all(list_runs(runs))))
    monkeypatch.setattr(collect, "MANY", 2)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert list(map(_facts, collect._read_all(list_runs(runs)))) == read
    assert sum(found is None for found, _ in read) == 1


def _facts(read: tuple[collect.Run | None, list[str]]) -> tuple[object, list[str]]:
    run, problems = read
    flown = {suite: evaluation.time_s.tobytes() for suite, evaluation in run.evaluations.items()} if run else {}
    return run and (run.id, run.config, run.state, flown), problems


def test_a_link_out_of_the_run_is_not_followed(lab: SimpleNamespace, tmp_path: Path) -> None:
    folder = lab.write_run(tmp_path / "runs", lab.compose(("env=forest",)), {"train_map": [5.0]})
    target = folder / "eval" / "train_map" / "episodes.csv"
    target.rename(tmp_path / "elsewhere.csv")
    target.symlink_to(tmp_path / "elsewhere.csv")
    _, built = read_report(tmp_path / "runs")
    assert len(built.problems) == 1
    assert not any(cell.runs for table in built.tables for cell in table.cells)


def test_an_unknown_format_is_refused_with_those_that_exist(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="rich, md, csv, tex, html, not 'xls'"):
        report(tmp_path, "xls")
