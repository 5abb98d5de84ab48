"""The user's commands in a row, with trainings of a second: train, evaluate, report, list, show."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from srlrace import cli
from srlrace.recording import read_states
from srlrace.runs import State, list_runs

TINY = (
    "algo.total_steps=2000", "algo.n_envs=10", "algo.n_steps=50", "algo.batch_size=100",
    "algo.policy_layers=[16]", "algo.value_layers=[16]",
)  # fmt: skip


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SRLRACE_RUNS", raising=False)
    monkeypatch.setenv("COLUMNS", "240")
    return tmp_path


def run(monkeypatch, *words) -> int:
    """A command in this process: starting one takes longer than all the rest of it."""
    monkeypatch.setattr(sys, "argv", ["srlrace", *words])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    return leaving.value.code or 0


def test_from_training_to_report(place, monkeypatch, capfd):
    program = Path(sys.executable).with_name("srlrace")
    command = [program, "train", "env=forest", "reward=no_safety", *TINY]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    [trained] = list_runs(place / "runs")
    assert trained.state is State.FINISHED
    assert trained.id.startswith("forest-no_safety-s0-")
    weights = (trained.path / "policy.safetensors").read_bytes()
    capfd.readouterr()

    assert run(monkeypatch, "train", "env=forest", "reward=no_safety", *TINY) == 0
    assert f"{trained.id} is finished; skipped" in capfd.readouterr().err
    assert (trained.path / "policy.safetensors").read_bytes() == weights

    assert run(monkeypatch, "eval", "--episodes", "20") == 0
    assert trained.id in "".join(capfd.readouterr())
    suite = trained.path / "eval/train_map"
    assert len((suite / "episodes.csv").read_text().splitlines()) == 21
    assert json.loads((suite / "summary.json").read_text())["episodes"] == 20
    assert read_states(suite / "trajectories.mcap")["episode"].nunique() == 20

    assert run(monkeypatch, "report") == 0
    printed = capfd.readouterr().out
    for title in ("Table II", "Table III", "Table IV", "Table V"):
        assert title in printed
    assert "not run" in printed

    assert run(monkeypatch, "runs") == 0
    assert trained.id in capfd.readouterr().out
    assert run(monkeypatch, "show", trained.id[:20]) == 0
    shown = capfd.readouterr().out
    assert "no_safety" in shown
    assert "train_map" in shown
    assert {path.name for path in place.iterdir()} == {"runs"}


def test_several_runs_in_one_command(place, monkeypatch, capfd):
    words = ("-m", "env=forest,split_s", "reward=srl,no_safety", "seed=0,1", *TINY)
    assert run(monkeypatch, "train", *words) == 0
    runs = list_runs(place / "runs")
    assert [trained.state for trained in runs] == [State.FINISHED] * 8
    names = {tuple(trained.id.split("-")[:3]) for trained in runs}
    assert names == {(e, m, s) for e in ("forest", "split_s") for m in ("srl", "no_safety") for s in ("s0", "s1")}
    assert len({(trained.path / "policy.safetensors").read_bytes() for trained in runs}) == 8
    assert {path.name for path in (place / "runs").iterdir()} == {trained.id for trained in runs}
    capfd.readouterr()
    assert run(monkeypatch, "train", *words) == 0
    assert capfd.readouterr().err.count("is finished; skipped") == 8
    assert run(monkeypatch, "runs", "--filter", "env=split_s") == 0
    assert capfd.readouterr().out.count("split_s-") == 4


@pytest.mark.parametrize(
    "choice", ["env=split_s", "baseline=song", "observation=rays", "level=mixed", "algo=flightmare"]
)
def test_every_kind_of_run_trains_and_flies(place, monkeypatch, choice):
    """One rollout each, through the whole chain; mixed with three maps instead of a hundred."""
    words = [choice, *TINY, *(["level.maps=3"] if choice == "level=mixed" else [])]
    assert run(monkeypatch, "train", *words) == 0
    assert run(monkeypatch, "eval", "--episodes", "5", "--record", "1") == 0
    [trained] = list_runs(place / "runs")
    assert trained.evaluations["train_map"]["episodes"] == 5


def test_a_failed_training_says_so_in_one_line(place, monkeypatch, capfd):
    monkeypatch.setattr("srlrace.learn.train.build_ppo", lambda *_: 1 / 0)
    assert run(monkeypatch, "train", "level=none", *TINY) == 1
    [failed] = list_runs(place / "runs")
    assert failed.state is State.FAILED
    errors = [line for line in capfd.readouterr().err.splitlines() if "error" in line.lower()]
    assert len(errors) == 1
    assert f"{failed.id}: ZeroDivisionError" in errors[0]
    assert "error.txt" in errors[0]
    monkeypatch.undo()
    monkeypatch.chdir(place)
    assert run(monkeypatch, "train", "level=none", *TINY) == 0
    assert failed.state is State.FINISHED
