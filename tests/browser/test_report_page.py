"""The report as a page: its numbers are the CSV's, its controls work, and whatever is hostile stays text."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srlrace.confdir import conf_dir
from srlrace.config import Config, run_id, to_dict
from srlrace.report.command import read_report
from srlrace.report.csv_tables import render_csv
from srlrace.report.experiments import load_paper
from srlrace.report.model import Report
from srlrace.report.page import render_page
from srlrace.report.presets import row_config

HEADER = "episode,map,outcome,time_s,lap_time_s,gates_passed,min_clearance_m"
HOSTILE = "</code><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'>"
SIZES = {"phone": (390, 844), "laptop": (1280, 900), "4K": (3840, 2160)}
ROWS = {  # of the tables: the presets, the mean time of a flight and how many of sixty crash
    ("env=forest", "randomization=init", "reward=srl"): (6.0, 3),
    ("env=forest", "randomization=init", "reward=no_safety"): (5.8, 6),
    ("env=forest", "randomization=init", "baseline=song"): (5.5, 0),
    ("env=split_s", "randomization=init", "reward=srl"): (7.0, 1),
}


def write_run(root: Path, config: Config, time: float, crashes: int) -> None:
    random = np.random.default_rng(config.seed)
    folder = root / run_id(config)
    evaluation = folder / "eval" / "train_map"
    evaluation.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    facts = {"argv": ["srlrace", "train", HOSTILE], "versions": {"numpy": HOSTILE}, "git": {"commit": HOSTILE}}
    (folder / "run.json").write_text(json.dumps({**facts, "cpu": HOSTILE, "steps": 1000}))
    (folder / "policy.safetensors").touch()
    times = time + 0.2 * random.standard_normal(60) + 0.1 * config.seed
    rows = [
        f"{i},0,crashed,,,{i % 3},0.0" if i < crashes + config.seed else f"{i},0,finished,{t:.4f},{t:.4f},9,0.4"
        for i, t in enumerate(times)
    ]
    (evaluation / "episodes.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    (evaluation / "summary.json").write_text(json.dumps({"suite": "train_map", "evaluation_seed": 7}))
    steps = np.arange(1, 31)
    learning = [f"{1000 * k},{6 * k},{k / 30},{1 - k / 30},{12 - k / 5},{k / 100},{-k / 500}" for k in steps]
    head = "steps,wall_s,success_ratio,crash_ratio,time_s,reward/progress,reward/collision"
    (folder / "progress.csv").write_text("\n".join([head, *learning]) + "\n")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Report]:
    """The page of four rows of the tables, three seeds each, and what it was made from."""
    root = tmp_path_factory.mktemp("study")
    for overrides, (time, crashes) in ROWS.items():
        for seed in range(3):
            write_run(root / "runs", replace(row_config(overrides), seed=seed), time, crashes)
    runs, report = read_report(root / "runs")
    page = root / "report.html"
    page.write_text(render_page(report, runs, load_paper(conf_dir() / "paper.yaml"), fly=False))
    return page, report


Visit = Callable[..., Any]


def test_every_number_of_the_csv_is_on_the_page(visit: Visit, study: tuple[Path, Report]) -> None:
    file, report = study
    page = visit(file).page
    compared = 0
    for table in report.tables:
        rows = list(csv.DictReader(io.StringIO(render_csv(table))))
        for index, row in enumerate(rows):
            place = f"table[data-table={table.experiment.name}] tr[data-row='{index}']"
            if not page.locator(place).count():
                assert not any(each["runs"] for each in rows)  # a table of ours that has not been run
                continue
            shown = page.locator(f"{place} data").evaluate_all(
                "all => all.map(d => [d.dataset.column, d.value, d.innerText])"
            )
            for column, value, words in shown:
                assert value == row[column], (table.experiment.name, index, column)
                decimals = len(words.partition(".")[2])
                assert words == f"{float(value):.{decimals}f}"
                compared += 1
            prints = {"paper_time_s": "time", "paper_crash_pct": "crash"}
            expected = {c for c, v in row.items() if v and c not in ("environment", "method", "runs", "episodes")}
            expected = {c for c in expected if prints.get(c, table.experiment.columns[0]) in table.experiment.columns}
            assert expected <= {column for column, _, _ in shown}
            origin = page.locator(f"#cell-{table.experiment.name}-{index} tbody a").all_text_contents()
            assert [name.strip() for name in origin] == row["runs"].split()
    assert compared > 100


def test_the_summary_tells_what_the_tables_say(visit: Visit, study: tuple[Path, Report]) -> None:
    file, report = study
    words = visit(file).page.locator("#summary").inner_text()
    cells = {
        (c.environment, c.method): c for t in report.tables if t.experiment.name == "minimum_time" for c in t.cells
    }
    song = cells["Forest", "Song et al."].numbers
    assert song is not None
    assert song.time_s is not None
    assert (
        f"Song et al. is fastest at {song.time_s.value:.2f} s [{song.time_s.low:.2f}, {song.time_s.high:.2f}]" in words
    )
    assert "Cells rest on 3 of 5 planned training seeds" in words
    assert "Forest, with safety reward against without safety reward" in words


def test_a_number_leads_to_its_runs_and_a_run_to_its_settings(visit: Visit, study: tuple[Path, Report]) -> None:
    page = visit(study[0]).page
    number = page.locator("table[data-table=minimum_time] a.number").first
    number.click()
    drawer = page.locator("#drawer")
    assert drawer.evaluate("d => d.open")
    run = drawer.locator("tbody a").first
    name = run.inner_text()
    page.keyboard.press("Escape")
    assert not drawer.evaluate("d => d.open")
    number.focus()
    page.keyboard.press("Enter")
    assert drawer.evaluate("d => d.open")
    drawer.locator("tbody a").first.click()
    assert not drawer.evaluate("d => d.open")
    details = page.locator(f"#run-{name}[open]")  # once the page has heard of its new address
    details.wait_for()
    details.locator("details > summary").click()
    assert "algo.gamma = " in details.locator("pre").inner_text()
    number.click()
    page.locator("#close").click()
    assert not drawer.evaluate("d => d.open")


def test_the_theme_can_be_chosen_and_print_is_on_white(visit: Visit, study: tuple[Path, Report]) -> None:
    page = visit(study[0], scheme="dark").page

    def colours() -> tuple[str, str]:
        line = "svg [stroke^='var']"
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return background, page.locator(line).first.evaluate("e => getComputedStyle(e).stroke")

    dark = colours()
    button = page.locator("#theme")
    button.click()
    assert button.inner_text() == "Theme: light"
    assert colours() == ("rgb(255, 255, 255)", "rgb(220, 225, 230)")
    button.click()
    assert colours() == dark
    assert dark[0] == "rgb(20, 24, 28)"
    page.emulate_media(media="print", color_scheme="dark")
    assert colours() == ("rgb(255, 255, 255)", "rgb(220, 225, 230)")
    assert len(page.pdf()) > 50_000


def test_what_a_stranger_wrote_stays_text(visit: Visit, study: tuple[Path, Report]) -> None:
    visited = visit(study[0])
    page = visited.page
    page.evaluate("for (const d of document.querySelectorAll('details')) d.open = true")
    assert page.evaluate("window.hacked") is None
    assert page.locator("img").count() == 0
    assert HOSTILE in page.locator("details.run code").all_inner_texts()[1]
    refused: list[str] = []
    page.on("console", lambda message: refused.append(message.text))
    page.evaluate(
        "document.body.appendChild(Object.assign(document.createElement('script'), {text: 'window.hacked = 1'}))"
    )
    assert page.evaluate("window.hacked") is None  # the page's own policy holds
    assert any("Content Security Policy" in text for text in refused)
    visited.errors.clear()  # they were provoked


@pytest.mark.parametrize(("size", "scheme"), [("phone", "dark"), ("laptop", "light"), ("4K", "light")])
def test_it_is_accessible_and_fits_at_every_size(
    visit: Visit, study: tuple[Path, Report], size: str, scheme: str
) -> None:
    visited = visit(study[0], size=SIZES[size], scheme=scheme)
    page = visited.page
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    figure = page.locator("#figure-minimum_time-forest-learning")
    figure.scroll_into_view_if_needed()
    heights = figure.locator("svg text").evaluate_all("all => all.map(t => t.getBoundingClientRect().height)")
    assert min(heights) >= 8  # CSS pixels: what a panel says can be read
    assert page.locator("figure svg[role=img]:not([aria-label])").count() == 0
    if size != "4K":  # the same elements in the same colours
        assert visited.violations() == []
