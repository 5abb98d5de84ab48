"""What a person sees of a training: the panel, the lines, the log, the phase of the curriculum."""

from __future__ import annotations

import io
import logging
import re
from dataclasses import replace

import pytest
from rich.console import Console

from srlrace.learn.display import BLOCKS, Display, phase_text, trend
from srlrace.text import duration


def row(steps, wall_s, **values):
    outcomes = {"success_ratio": 0.5, "crash_ratio": 0.25, "time_s": None, "gates_passed": 3.0, "reward": 0.1}
    return {"steps": steps, "wall_s": wall_s, "steps_per_s": 50_000.0, **outcomes, **values}


@pytest.fixture
def hundred(config):
    """A training of a hundred thousand steps."""
    whole = config("env=forest")
    return replace(whole, algo=replace(whole.algo, total_steps=100_000))


def show(config, folder, rows, terminal):
    """What a console gets to see of these rows."""
    console = Console(file=io.StringIO(), force_terminal=terminal, width=80, color_system=None)
    with Display(config, folder, console) as display:
        for each in rows:
            display.show(each)
        picture = Console(file=io.StringIO(), width=80, color_system=None)
        picture.print(display.panel())
    return console.file.getvalue(), picture.file.getvalue()


def test_the_panel_says_how_far_how_fast_and_how_well(hundred, tmp_path):
    rows = [row(steps, steps / 50_000, success_ratio=steps / 1e5) for steps in range(10_000, 50_001, 10_000)]
    seen, panel = show(hundred, tmp_path, rows, terminal=True)
    assert tmp_path.name in seen
    assert "50 %" in panel
    assert "0.1/0.1 M" in panel
    assert "0:01 left" in panel  # 50 000 steps at 50 000 a second
    assert re.search(r"finished +50\.0 % +▁.*█", panel)
    assert re.search(r"time of finished +-", panel)
    assert max(map(len, panel.splitlines())) <= 80


def test_what_comes_after_the_last_step_is_left_as_well(config, tmp_path, caplog):
    caplog.set_level(logging.INFO, "srlrace")
    whole = config("env=split_s", "curriculum=taught", "algo=taught_lap", "curriculum.polish_rounds=18")
    total = whole.algo.total_steps
    _, panel = show(whole, tmp_path, [row(total // 4, 1.0), row(total, 1000.0)], terminal=False)
    assert caplog.messages[-1].endswith("  0:00 left, then 18 rounds of polish")
    assert ", then 18 rounds of polish" in " ".join(panel.split())
    assert max(map(len, panel.splitlines())) <= 80


@pytest.mark.parametrize("terminal", [True, False])
def test_the_log_is_dated_plain_and_appended_to(hundred, tmp_path, terminal, caplog):
    caplog.set_level(logging.INFO, "srlrace")
    for last in (60_000, 100_000):
        show(hundred, tmp_path, [row(20_000, 0.5), row(25_000, 0.6), row(last, 20.0)], terminal)
    logging.getLogger("srlrace").warning("after it has ended")
    lines = (tmp_path / "train.log").read_text().splitlines()
    assert len(lines) == 4  # the second row of each came too soon after the first
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ INFO    ", line) for line in lines)
    assert "100%  0.10 M steps  50 k/s  finished 50 %  crashed 25 %" in lines[3]
    assert "\x1b" not in "".join(lines)


def test_what_else_is_said_is_in_the_log_without_control_characters(hundred, tmp_path):
    console = Console(file=io.StringIO(), force_terminal=True)
    with Display(hundred, tmp_path, console):
        logging.getLogger("srlrace.learn.train").warning("a \x1b[31mred\nname")
    assert (tmp_path / "train.log").read_text().endswith("WARNING a \ufffd[31mred name\n")


def test_the_log_follows_no_link(hundred, tmp_path):
    target = tmp_path / "elsewhere"
    (tmp_path / "train.log").symlink_to(target)
    with pytest.raises(OSError, match=r"train\.log"):
        Display(hundred, tmp_path).__enter__()
    assert not target.exists()


def test_the_phase_is_what_the_race_does(hundred):
    curriculum = replace(
        hundred.curriculum, cost_initial=0.2, cost_hold=0.25, cost_ramp=0.75, gate_starts=0.25, memory_starts=0.25,
        staged_hold=0.5, staged_end=1.0, obstacle_ease=0.5, waypoint_ease=1.0, ease_hold=0.0, ease_end=0.4,
    )  # fmt: skip
    sizes = "obstacles 0.38 m smaller, waypoints 0.75 m larger"
    assert phase_text(curriculum, 0.1) == f"curriculum: costs at 20 %, {sizes}, 50 % of starts along the course"
    assert phase_text(curriculum, 0.5) == "curriculum: costs at 60 %, 50 % of starts along the course"
    assert phase_text(curriculum, 0.75) == "curriculum: costs in full, 25 % of starts along the course"
    assert phase_text(curriculum, 1.0) == "curriculum: costs in full"
    hard = replace(curriculum, hard_starts=0.8)
    assert phase_text(hard, 0.5) == phase_text(curriculum, 0.5)
    along = "25 % of starts along the course, 40 % before earlier crashes"
    assert phase_text(hard, 0.75) == f"curriculum: costs in full, {along}"
    assert phase_text(hard, 1.0) == "curriculum: costs in full, 80 % before earlier crashes"
    late = replace(hard, hard_begin=0.9, escape_starts=0.06)
    assert phase_text(late, 0.75) == "curriculum: costs in full, 25 % of starts along the course, 6 % at hard starts"
    assert phase_text(late, 1.0) == "curriculum: costs in full, 80 % before earlier crashes, 6 % at hard starts"


def test_a_trend_reaches_from_the_lowest_to_the_highest_with_gaps():
    assert trend([0.0, None, 1.0]) == BLOCKS[0] + " " + BLOCKS[-1]
    assert trend([None]) == ""
    assert trend([2.0, 2.0]) == BLOCKS[0] * 2
    long = trend([float(i) for i in range(1000)])
    assert list(long) == sorted(long)
    assert len(long) == 32


def test_times_read_as_on_a_clock():
    assert [duration(s) for s in (0.4, 61, 3661)] == ["0:00", "1:01", "1:01:01"]
