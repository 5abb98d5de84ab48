"""``srlrace bound`` from the command line: what it prints, keeps and writes, and what it says when it cannot."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from typer.testing import CliRunner

from srlrace.bound import command
from srlrace.bound.problem import problem_of
from srlrace.bound.store import load
from srlrace.cli import app
from srlrace.config import ConfigError
from srlrace.recording import read_flight, read_metadata


@pytest.fixture
def track(short, tmp_path):
    config = short()
    return config, f"env={tmp_path / 'short.yaml'}"


def test_solve_print_keep_and_record(track, tmp_path, monkeypatch):
    config, env = track
    out = tmp_path / "flight.mcap"
    words = ["bound", env, "level=none", "--restarts", "1", "--out", str(out)]
    first = CliRunner().invoke(app, words)
    assert first.exit_code == 0, first.output
    reference = load(problem_of(config))
    assert f"{reference.time:.3f} s" in first.output
    flight = read_flight(out, 0)
    assert flight.outcome == "finished"
    assert flight.finish_time == pytest.approx(reference.time)
    assert flight.time[-1] == pytest.approx(reference.time)
    assert np.asarray(flight.waypoints) == pytest.approx(np.array(config.env.waypoints))
    for waypoint in config.env.waypoints:
        assert np.linalg.norm(flight.position_w - waypoint, axis=1).min() <= 0.3
    assert float(read_metadata(out)["t_ref_s"]) == pytest.approx(reference.time, abs=1e-5)

    monkeypatch.setattr(command, "solve", None)  # a second time nothing is solved
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0
    assert f"{reference.time:.3f} s" in again.output


def test_without_the_solver_one_line_names_the_extra(track, monkeypatch):
    config, _ = track
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'srlrace\[bound\]'"):
        command.bound(config, False, False, 1, True, None)


def test_a_lap_has_no_end_to_stop_at():
    from srlrace.hydra_bridge import compose

    with pytest.raises(ConfigError, match="--race"):
        command.bound(compose(["env=split_s"]), False, True, 1, False, None)


def test_a_demonstration_is_found_kept_and_taught(track, tmp_path, monkeypatch):
    _, env = track
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = [env, "level=none", "randomization=none"]
    first = CliRunner().invoke(app, ["bound", *words, "--demonstrate"])
    assert first.exit_code == 0, first.output
    [path] = (tmp_path / "cache" / "srlrace" / "bound" / "demonstrations").glob("*.npz")
    assert str(path) in first.output.replace("\n", "")
    monkeypatch.setattr(command, "_demonstrated", None)  # a second time nothing is solved
    again = CliRunner().invoke(app, ["bound", *words, "--demonstrate"])
    assert again.exit_code == 0, again.output
    small = ["algo.n_envs=8", "algo.n_steps=16", "algo.batch_size=64", "algo.total_steps=256"]
    taught = CliRunner().invoke(
        app,
        ["train", *words, "curriculum=taught", "curriculum.polish_rounds=0", *small, "--runs", str(tmp_path / "runs")],
    )
    assert taught.exit_code == 0, taught.output


def test_a_demonstration_goes_without_options_of_the_reference(track, tmp_path):
    _, env = track
    refused = CliRunner().invoke(app, ["bound", env, "--demonstrate", "--out", str(tmp_path / "flight.mcap")])
    assert isinstance(refused.exception, ConfigError)
    assert not (tmp_path / "flight.mcap").exists()


def test_a_demonstration_is_of_a_single_map():
    from srlrace.hydra_bridge import compose

    with pytest.raises(ConfigError, match="--demonstrate: there are 100 maps"):
        command.demonstrate(compose(["env=forest", "level=mixed"]), False)
