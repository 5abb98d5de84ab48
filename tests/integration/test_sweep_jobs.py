"""Sweeps: what is missing is done once, in processes side by side; failures and signals are passed on."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from srlrace import cli
from srlrace.confdir import conf_dir
from srlrace.config import load_config
from srlrace.hydra_bridge import compose
from srlrace.runs import State, list_runs
from srlrace.sweep import crew
from srlrace.sweep.plan import Plan, experiments, plan_jobs

# Stands in for `python -m srlrace`: writes what train and eval would leave, and a line for each call.
STUB = """
import json, os, pathlib, signal, sys, time
from srlrace.config import run_id, to_dict
from srlrace.hydra_bridge import compose
from srlrace.orphans import follow_parent
follow_parent()
words = sys.argv[1:]
root = pathlib.Path(words[words.index("--runs") + 1])
with (root.parent / "calls").open("a") as stream:
    stream.write(" ".join(words[:-2]) + "\\n")
if words[0] == "train":
    if "seed=1" in words and os.environ.get("STUB") == "fail":
        sys.exit("error: no luck with seed 1")
    config = compose(words[1 : words.index("--runs")])
    if os.environ.get("STUB") == "wait":
        signal.signal(signal.SIGINT, lambda *_: sys.exit(130))
        (root.parent / f"waiting{config.seed}").touch()
        time.sleep(60)
    if os.environ.get("STUB") == "idle":
        sys.exit("had no mind to" if "seed=1" in words else 0)
    if os.environ.get("STUB") == "slow":
        time.sleep(0.5)
    folder = root / run_id(config)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    (folder / "policy.safetensors").touch()
else:
    folder = root / words[1] / "eval" / words[words.index("--suite") + 1]
    folder.mkdir(parents=True)
    summary = {"suite": folder.name, "episodes": int(words[words.index("--episodes") + 1])}
    (folder / "summary.json").write_text(json.dumps(summary))
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    (tmp_path / "stub.py").write_text(STUB)
    monkeypatch.setattr(crew, "PROGRAM", (sys.executable, str(tmp_path / "stub.py")))
    monkeypatch.setattr("srlrace.report.command.report", lambda root: None)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["srlrace", "sweep", *arguments])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    return leaving.value.code or 0


def calls(place) -> list[str]:
    return sorted((place / "calls").read_text().splitlines())


def test_every_experiment_composes_and_shared_runs_are_planned_once(tmp_path):
    names = [path.stem for path in (conf_dir() / "experiment").glob("*.yaml")]
    jobs = plan_jobs(experiments(names), Plan(tmp_path, seeds=1))
    assert len({job.folder.id for job in jobs}) == len(jobs)
    rows = sum(len(experiment.rows) for experiment in experiments(names))
    assert len(jobs) < rows
    for job in jobs:
        assert compose(job.overrides) == job.config


def test_paper_is_its_four_tables():
    names = {experiment.name for experiment in experiments(["paper"])}
    assert names == {"minimum_time", "generalization", "ablation_safety", "ablation_terminal"}


def test_missing_runs_are_trained_and_evaluated_once(place, monkeypatch, capfd):
    assert run(monkeypatch, "smoke", "--seeds", "2", "--dry-run") == 0
    assert capfd.readouterr().out.count("evaluate train_map") == 2
    assert sorted(path.name for path in place.iterdir()) == ["stub.py"]

    assert run(monkeypatch, "smoke", "--seeds", "2", "--steps", "1000") == 0
    first = calls(place)
    assert [line.split()[0] for line in first] == ["eval", "eval", "train", "train"]
    assert first[2:] == [f"train env=forest level=none algo.total_steps=1000 seed={seed}" for seed in (0, 1)]
    assert [load_config(run.path / "config.json").seed for run in list_runs(place / "runs")] == [0, 1]

    assert run(monkeypatch, "smoke", "--seeds", "2", "--steps", "1000") == 0
    assert calls(place) == first

    summary = next((place / "runs").glob("*-s1-*/eval/train_map/summary.json"))
    summary.write_text(json.dumps({"episodes": 3}))
    summary.parent.rename(place / "gone")
    assert run(monkeypatch, "smoke", "--seeds", "2", "--steps", "1000") == 0
    assert len(calls(place)) == len(first) + 1


def test_a_failed_run_is_reported_and_the_others_go_on(place, monkeypatch, capfd):
    monkeypatch.setenv("STUB", "fail")
    assert run(monkeypatch, "smoke", "--seeds", "3", "--jobs", "1") == 1
    assert "no luck with seed 1" in capfd.readouterr().err
    assert len(list_runs(place / "runs")) == 2


def sweeping(place, stub, *arguments) -> subprocess.Popen:
    """A sweep of three runs in a process of its own, with the stub for a trainer."""
    code = (
        "import sys; from srlrace import cli; from srlrace.report import command; from srlrace.sweep import crew\n"
        f"crew.PROGRAM, command.report = (sys.executable, {str(place / 'stub.py')!r}), lambda root: None\n"
        f"sys.argv = ['srlrace', 'sweep', 'smoke', '--seeds', '3', *{arguments!r}]; cli.main()"
    )
    environment = {**os.environ, "STUB": stub}
    return subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, text=True)


def until(condition, seconds=60.0):
    give_up = time.monotonic() + seconds
    while not condition() and time.monotonic() < give_up:
        time.sleep(0.05)
    assert condition()


def test_sweeps_of_one_folder_share_the_work(place):
    crowd = [sweeping(place, "slow", "--jobs", "1") for _ in range(3)]
    said = [process.communicate(timeout=120)[1] for process in crowd]
    assert [process.returncode for process in crowd] == [0, 0, 0], said
    words = [line.split()[0] for line in calls(place)]
    assert (words.count("train"), words.count("eval")) == (3, 3)
    assert not list((place / "runs" / ".leases").iterdir())


def test_a_killed_sweep_leaves_no_training_behind_and_is_repeated(place):
    with sweeping(place, "wait") as process:
        until(lambda: len(list(place.glob("waiting*"))) == 2)
        process.kill()
    until(lambda: not any(str(place / "stub.py").encode() in line for line in command_lines()))
    with sweeping(place, "") as process:
        assert process.wait(timeout=120) == 0
    assert len(list_runs(place / "runs")) == 3


def command_lines() -> list[bytes]:
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            lines.append(path.read_bytes())
    return lines


def test_a_trainer_that_does_nothing_is_not_asked_for_ever(place, monkeypatch, capfd):
    monkeypatch.setenv("STUB", "idle")
    assert run(monkeypatch, "smoke", "--seeds", "2") == 1
    errors = capfd.readouterr().err
    assert "it said nothing" in errors
    assert "had no mind to" in errors
    assert len(calls(place)) == 2


def test_ctrl_c_reaches_every_process_once(place):
    with sweeping(place, "wait", "--jobs", "2") as process:
        until(lambda: len(list(place.glob("waiting*"))) == 2)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 130
        assert "the same command continues" in process.stderr.read()
    assert sorted(path.name for path in place.glob("waiting*")) == ["waiting0", "waiting1"]


def test_smoke_from_nothing_to_the_report(tmp_path):
    """The real thing, with the smallest training: train, evaluate, report, each in its own process."""
    command = [sys.executable, "-m", "srlrace", "sweep", "smoke", "--steps", "1000", "--runs", str(tmp_path / "runs")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Table II" in done.stdout
    [trained] = list_runs(tmp_path / "runs")
    assert trained.state is State.FINISHED
    assert trained.evaluations["train_map"]["episodes"] == 50
    assert [path.name for path in Path(tmp_path).iterdir()] == ["runs"]


def test_several_runs_in_processes_of_joblib(tmp_path):
    """Hydra's own multirun, with a launcher that pickles the task function into other processes."""
    words = ["level=none", "algo.total_steps=100", "algo.n_envs=2", "algo.n_steps=50", "algo.batch_size=50"]
    launcher = ["-m", "seed=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    command = [sys.executable, "-m", "srlrace", "train", *launcher, *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [run.state for run in list_runs(tmp_path / "runs")] == [State.FINISHED, State.FINISHED]
    assert list_runs(tmp_path / "runs")[0].info["argv"][:3] == ["srlrace", "train", "-m"]
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert len(list((tmp_path / "runs").iterdir())) == 2
