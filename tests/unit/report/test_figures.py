"""Figures from recordings and progress files: they are written, hold what was flown, and survive damage."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace

import matplotlib.colors
import numpy as np
import pandas as pd
import pytest

from srlrace.config import run_id
from srlrace.files import atomic_write
from srlrace.recording import Flight, RecordingWriter, SceneObstacle
from srlrace.report import courses
from srlrace.report.command import read_report
from srlrace.report.courses import Trajectory, agreeing, read_course
from srlrace.report.figures import write_figures
from srlrace.report.learning_figure import learning_plot
from srlrace.report.plots import figure_of, panel_figure
from srlrace.report.projection import nearness, project
from srlrace.report.results_figure import flights_plot
from srlrace.report.style import OUTCOME, SPEEDS
from srlrace.report.trajectory_figure import pieces, trajectory_plot
from srlrace.schema import Config

KINDS = ("trajectories", "flights", "learning")
SCENE = (
    SceneObstacle("cylinder", (-12.0, -4.0, 4.0), radius=0.3, height=8.0),
    SceneObstacle("sphere", (0.0, 2.0, 2.0), radius=1.0),
    SceneObstacle("box", (8.0, -8.0, 1.0), edge=2.0),
)


def flight(config: Config, episode: int, map_seed: int, outcome: str = "finished") -> Flight:
    """A flight along straight legs between the waypoints, 250 states in 5 s."""
    corners = np.array([config.env.start, *config.env.waypoints])
    at = np.linspace(0, len(corners) - 1, 250)
    position = np.stack([np.interp(at, np.arange(len(corners)), axis) for axis in corners.T], axis=1)
    time = np.linspace(0, 5, 250)
    return Flight(
        episode=episode, seed=episode, map_seed=map_seed, outcome=outcome,
        finish_time=5.0 if outcome == "finished" else None, time=time, position_w=position + 0.05 * episode,
        velocity_w=np.gradient(position, time, axis=0), quaternion_wb=np.tile([1.0, 0, 0, 0], (250, 1)),
        body_rate_b=np.zeros((250, 3)), rotor_thrust=np.ones((250, 4)), action=np.zeros((250, 4)),
        reward_terms=np.zeros((250, 1)), clearance=np.ones(250), target=np.zeros(250, int),
        waypoints=corners[1:], scene=SCENE,
    )  # fmt: skip


def record(path: Path, config: Config, flights: list[Flight], rows: int | None = None) -> None:
    """Write a recording whose table of episodes has ``rows`` rows, one per flight unless said otherwise."""
    lines = [f"{i},{flights[min(i, len(flights) - 1)].map_seed},finished" for i in range(rows or len(flights))]
    with RecordingWriter(path, metadata={}, reward_terms=("progress",), horizon=20.0, config_json=b"{}") as writer:
        for each in flights:
            writer.write(each)
        writer.finish("\n".join(["episode,map,outcome", *lines]).encode())


@pytest.fixture
def forest(lab: SimpleNamespace) -> Config:
    return lab.compose(("env=forest",))


def test_a_course_holds_the_flights_of_its_first_map(forest: Config, tmp_path: Path) -> None:
    path = tmp_path / "trajectories.mcap"
    record(path, forest, [flight(forest, i, map_seed=i % 2) for i in range(6)])
    course = read_course(path, forest)
    assert len(course.flights) == 3
    assert sorted(course.obstacles, key=str) == sorted(SCENE, key=str)
    np.testing.assert_allclose(course.waypoints, sorted(forest.env.waypoints))
    assert len(read_course(path, forest, flights=2).flights) == 2


def test_an_evaluation_recorded_in_part_is_drawn_in_part(forest: Config, tmp_path: Path) -> None:
    path = tmp_path / "trajectories.mcap"
    record(path, forest, [flight(forest, i, map_seed=0) for i in range(2)], rows=9)
    assert len(read_course(path, forest).flights) == 2


def test_the_top_view_draws_obstacles_as_they_collide(forest: Config, tmp_path: Path) -> None:
    path = tmp_path / "trajectories.mcap"
    record(path, forest, [flight(forest, 0, 0), flight(forest, 1, 0, outcome="crashed")])
    plot = trajectory_plot({"srl": read_course(path, forest)}, "name", "title")
    above = panel_figure(plot.panels[1]).axes[0]
    radii = sorted(patch.get_radius() for patch in above.patches if hasattr(patch, "get_radius"))
    margin = forest.keep_out
    gates = [forest.env.passing_radius] * len(forest.env.waypoints)
    assert radii == pytest.approx(sorted([0.3, 0.3 + margin, 1.0, 1.0 + margin, *gates]))
    assert margin == pytest.approx(forest.quad.arm_length + forest.level.safety_margin)
    (mark,) = [line for line in above.lines if line.get_label() == "did not finish"]
    np.testing.assert_allclose(mark.get_xydata(), [np.array(forest.env.waypoints[-1][:2]) + 0.05])


def test_flights_flown_again_count_if_they_end_as_evaluated(lab: SimpleNamespace, forest: Config) -> None:
    flown = [flight(forest, 0, 0), flight(forest, 1, 0), flight(forest, 2, 0, outcome="crashed"), flight(forest, 3, 0)]
    run = lab.run(forest, lab.evaluation([5.0, 5.03, None, None]))  # seconds; a control period is 0.02
    assert agreeing(run, flown) == 2


def test_the_view_in_space_keeps_lengths_across_the_line_of_sight() -> None:
    turn = np.array([project(np.eye(3)[i]) for i in range(3)])
    towards = nearness(np.eye(3))
    np.testing.assert_allclose(
        np.column_stack([turn, towards]) @ np.column_stack([turn, towards]).T, np.eye(3), atol=1e-12
    )
    assert nearness(np.array([0.0, 0.0, 1.0])) > 0  # seen from above


def test_a_path_is_cut_where_its_colour_changes_and_drawn_to_a_few_centimetres() -> None:
    turn = np.linspace(0, np.pi, 400)
    path = np.stack([5 * np.cos(turn), 5 * np.sin(turn), np.full(400, 2.0)], axis=1)
    speed = np.linspace(0.0, 19.9, 400)
    drawn = list(pieces(Trajectory(path, speed, crashed=False), top=20.0))
    assert [colour for _, colour in drawn] == list(SPEEDS)
    corners = np.concatenate([piece for piece, _ in drawn])
    np.testing.assert_array_equal(corners[[0, -1]], path[[0, -1]])
    assert len(corners) < 100
    middles = (corners[1:] + corners[:-1]) / 2
    assert np.abs(np.linalg.norm(middles[:, :2], axis=1) - 5).max() < 0.03


def test_learning_curves_average_over_seeds_on_common_steps() -> None:
    frames = [
        pd.DataFrame({"steps": [0, 100], "success_ratio": [0.0, 1.0], "wall_s": [0, 60]}),
        pd.DataFrame({"steps": [0, 50], "success_ratio": [0.0, 0.0], "wall_s": [0, 60]}),
    ]
    plot = learning_plot({"srl": frames}, "name", "title")
    figure = figure_of(plot)
    (line,) = figure.axes[0].lines
    x, y = line.get_data()
    assert x[-1] == pytest.approx(50e-6)
    assert y[-1] == pytest.approx(25.0)
    assert "srl ends at 25.0" in plot.panels[0].alt
    assert not figure.axes[4].lines  # no time column, no curve


def test_failures_are_counted_where_they_happened(lab: SimpleNamespace) -> None:
    flown = lab.evaluation([5.0] * 6 + [None] * 4)
    flown.gates_passed[-1] = 2
    plot = flights_plot({"srl": [flown, lab.evaluation([5.0] * 10)]}, "name", "title")
    bars = panel_figure(plot.panels[2]).axes[0].patches
    crashed = [bar for bar in bars if bar.get_facecolor()[:3] == matplotlib.colors.to_rgb(OUTCOME["crashed"])]
    heights = {round(bar.get_x() + bar.get_width() / 2): bar.get_height() for bar in crashed if bar.get_height()}
    assert heights == {2: pytest.approx(50.0), 4: pytest.approx(150.0)}  # of twenty flights, per 1000
    assert "4 flights did not finish, 0 of them passed no waypoint" in plot.panels[2].alt


def test_figures_are_written_and_what_is_damaged_is_left_out(
    lab: SimpleNamespace, forest: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = tmp_path / "runs"
    folders = [lab.write_run(root, lab.with_seed(forest, seed), {"train_map": [5.0, None]}) for seed in (0, 1)]
    other = lab.write_run(root, lab.compose(("env=forest", "reward.body_rate=0.5")), {"train_map": [5.0]})
    record(folders[0] / "eval" / "train_map" / "trajectories.mcap", forest, [flight(forest, 0, 0)])
    atomic_write(other / "eval" / "train_map" / "trajectories.mcap", b"not a recording")
    atomic_write(folders[0] / "progress.csv", "steps,wall_s,success_ratio,time_s\n1,1,0.1,\n2,2,0.9,5.0\n")
    atomic_write(folders[1] / "progress.csv", b"\x00\xff")
    runs, built = read_report(root)
    with caplog.at_level(logging.WARNING):
        written = write_figures(built, runs, tmp_path / "figures")
    names = {path.name for path in written}
    run = run_id(forest)
    assert {f"minimum_time-forest-{kind}.{suffix}" for kind in KINDS for suffix in ("png", "pdf", "svg")} <= names
    assert not any(run in name for name in names)  # it stands in a table
    assert all(path.stat().st_size > 5000 for path in written)
    assert f"no trajectories of {other.name}" in caplog.text


@pytest.mark.parametrize(
    ("words", "flies"),
    [
        (("level=2",), True),
        (("level=mixed",), True),
        (("level=mixed", "level.maps=1000"), False),
        (("level=endless",), False),
    ],
)
def test_runs_on_maps_that_would_take_minutes_are_not_flown_again(
    lab: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], flies: bool
) -> None:
    flown: list[object] = []
    monkeypatch.setattr(courses, "fly_course", flown.append)
    assert courses.find_course(lab.run(lab.compose(words)), "train_map", fly=True) is None
    assert bool(flown) == flies
