"""Following runs from their files: what is told, what is shown, and how it ends."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from srlrace.config import Config, run_id, to_dict
from srlrace.runs import RunFolder, list_runs
from srlrace.watch import look, picture, watch


@pytest.fixture
def thousand(config) -> Config:
    whole = config("env=forest")
    return replace(whole, algo=replace(whole.algo, total_steps=1000))


def make(root: Path, config: Config, seed: int, steps: int) -> RunFolder:
    seeded = replace(config, seed=seed)
    folder = root / run_id(seeded)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(seeded)))
    go_on(folder, steps)
    return RunFolder(folder)


def go_on(folder: Path, steps: int) -> None:
    rows = f"steps,wall_s,success_ratio,time_s\n{steps},{steps / 10},0.5,6.25\n"
    (folder / "progress.csv").write_text(rows)


def evaluate(folder: Path) -> None:
    (folder / "policy.safetensors").touch()
    target = folder / "eval" / "train_map"
    target.mkdir(parents=True)
    summary = {"episodes": 10, "outcomes": {"finished": 9}, "time_mean_s": 5.5}
    (target / "summary.json").write_text(json.dumps(summary))


class Clock:
    """Stands in for waiting: does what the script says happens between looks, then presses Ctrl-C."""

    def __init__(self, *events):
        self.events = list(events)

    def __call__(self, seconds: float) -> None:
        if not self.events:
            raise KeyboardInterrupt
        self.events.pop(0)()


def followed(root: Path, clock: Clock, terminal: bool = False) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100, height=20, color_system=None)
    watch(lambda: list_runs(root), console, clock)
    return console.file.getvalue()


def test_without_a_terminal_each_change_is_one_line(thousand, tmp_path):
    run = make(tmp_path, thousand, 0, 100)
    with run.lock():
        told = followed(
            tmp_path,
            Clock(
                lambda: None,  # nothing happens: nothing is said
                lambda: go_on(run.path, 150),  # not enough to speak of
                lambda: go_on(run.path, 400),
                lambda: evaluate(run.path),
            ),
        )
    lines = told.splitlines()
    states = [["training", "10 %"], ["training", "40 %"], ["finished", "40 %"]]
    assert [line.split("  ")[1:3] for line in lines] == states
    assert lines[0].endswith("1:30 left  50 % finished, 6.25 s")  # 10 steps a second, 900 to go
    assert lines[2] == f"{run.id}  finished  40 %  train_map 9/10 in 5.50 s"


def test_new_runs_join(thousand, tmp_path):
    make(tmp_path, thousand, 0, 100)
    lines = followed(tmp_path, Clock(lambda: make(tmp_path, thousand, 1, 0) and None)).splitlines()
    assert [line.split("-")[2] for line in lines] == ["s0", "s1"]


def test_the_live_table_shows_what_trains_first_and_what_fits(thousand, tmp_path):
    runs = [make(tmp_path, thousand, seed, 100 * seed) for seed in range(8)]
    evaluate(runs[0].path)
    with runs[5].lock():
        console = Console(file=io.StringIO(), width=120, color_system=None)
        console.print(picture([look(run) for run in runs], height=8))
    text = console.file.getvalue()
    assert text.startswith("8 runs: 1 training, 6 interrupted, 1 finished; 35 % trained, 0:50 until")
    rows = [line for line in text.splitlines() if line.startswith("forest-")]
    assert "-s5-" in rows[0]
    assert "50 %" in rows[0]
    assert "... and 5 more" in text


def test_on_a_terminal_the_table_is_drawn_anew_and_ctrl_c_just_ends_it(thousand, tmp_path):
    run = make(tmp_path, thousand, 0, 100)
    shown = followed(tmp_path, Clock(lambda: go_on(run.path, 700)), terminal=True)
    assert "10 %" in shown
    assert "70 %" in shown


def test_a_hostile_name_and_summary_stay_text(thousand, tmp_path):
    run = make(tmp_path, replace(thousand, name="x"), 0, 10)
    evaluate(run.path)
    (run.path / "eval" / "train_map" / "summary.json").write_text('{"episodes": "[red]\\u001b[2J"}')
    text = followed(tmp_path, Clock())
    assert "\x1b" not in text
    assert "[red]" in text
