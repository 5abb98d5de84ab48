"""Policies kept along a training: which, that each evaluates like a last one, and what the report makes of them."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from srlrace.config import run_id, to_dict
from srlrace.evaluation import evaluate_run, evaluate_snapshots
from srlrace.evaluation.snapshots import snapshots
from srlrace.files import FileError, write_sealed
from srlrace.learn import train as training
from srlrace.learn.policy import build_policy, save_policy
from srlrace.report.collect import Run
from srlrace.report.learning_figure import evaluated_plot, first_good, read_learning
from srlrace.runs import RunError, RunFolder, State

SMALL = ("level=1", "env.horizon=1.0", "algo.n_envs=16", "algo.n_steps=8", "algo.batch_size=64", "algo.n_epochs=1")
ROLLOUT = 128


@pytest.fixture
def kept(config, tmp_path):
    """A run with an untrained policy after 1000 steps, another after 20 000, and the last one."""
    settings = config("level=1", "env.horizon=0.5")
    run = RunFolder(tmp_path / run_id(settings))
    (run.path / "snapshots").mkdir(parents=True)
    (run.path / "config.json").write_text(json.dumps(to_dict(settings)))
    for seed, name in enumerate(("snapshots/20000", "snapshots/1000", "policy")):
        torch.manual_seed(seed)
        save_policy(build_policy(settings), run.path / f"{name}.safetensors")
    return run


@pytest.mark.parametrize(("rollouts", "snapshots_expected"), [(6, 6), (50, 20)])
def test_training_keeps_policies_along_the_way(config, tmp_path, rollouts, snapshots_expected):
    settings = config(*SMALL, f"algo.total_steps={rollouts * ROLLOUT}")
    run = RunFolder(training.train(settings, tmp_path))
    steps = list(snapshots(run))
    assert len(steps) == snapshots_expected
    assert np.diff([0, *steps]).max() < 2 * rollouts * ROLLOUT / snapshots_expected
    assert steps[-1] == rollouts * ROLLOUT
    last = run.path / "snapshots" / f"{steps[-1]}.safetensors"
    assert last.read_bytes() == (run.path / "policy.safetensors").read_bytes()


def test_a_snapshot_is_evaluated_as_a_last_policy_is(kept):
    rows = evaluate_snapshots(kept, 30)
    assert [row["steps"] for row in rows] == [1000, 20000]
    (kept.path / "snapshots" / "20000.safetensors").replace(kept.path / "policy.safetensors")
    summary = evaluate_run(kept, 30, record="none")
    assert rows[1]["finished"] == summary["outcomes"]["finished"]
    assert rows[1]["crashed"] == pytest.approx(30 * summary["crash_ratio"])
    assert rows[1]["time_s"] == summary["time_mean_s"]


def test_other_files_are_no_snapshots(kept):
    for name in ("0.safetensors", "01.safetensors", "final.safetensors", "5.safetensors.tmp"):
        (kept.path / "snapshots" / name).write_bytes(b"")
    assert list(snapshots(kept)) == [1000, 20000]


def test_what_cannot_be_flown_is_said(kept, tmp_path):
    (kept.path / "snapshots" / "1000.safetensors").write_bytes(b"not a policy")
    with pytest.raises(FileError, match=r"1000\.safetensors"):
        evaluate_snapshots(kept, 3)
    for path in (kept.path / "snapshots").iterdir():
        path.unlink()
    with pytest.raises(RunError, match="no snapshots"):
        evaluate_snapshots(kept, 3)
    (kept.path / "snapshots").rmdir()
    (kept.path / "snapshots").symlink_to(tmp_path)
    with pytest.raises(RunError, match="a link out of the run folder"):
        evaluate_snapshots(kept, 3)


def learning(kept, rows, progress):
    run = Run(kept.id, kept.path, kept.load_config(), State.FINISHED)
    (kept.path / "eval" / "train_map").mkdir(parents=True, exist_ok=True)
    write_sealed(kept.path / "eval" / "train_map" / "learning.json", {"episodes": 50, "snapshots": rows})
    return read_learning(run, "train_map", progress)


def test_the_report_joins_them_with_the_wall_clock(kept):
    progress = pd.DataFrame({"steps": [1000, 3000], "wall_s": [10.0, 20.0]})
    rows = [
        {"steps": 1000, "finished": 0, "crashed": 50, "time_s": None},
        {"steps": 2000, "finished": 50, "crashed": 0, "time_s": 7.0},
    ]
    frame = learning(kept, rows, progress)
    assert frame is not None
    assert frame["wall_s"].tolist() == [10.0, 15.0]
    assert frame["finished_pct"].tolist() == [0.0, 100.0]
    assert np.isnan(frame["time_s"][0])
    assert frame["time_s"][1] == 7.0
    assert "ours in 1 of 2 seeds after 15 to 15 s" in first_good({"ours": [frame, frame.iloc[:1]]})
    assert len(evaluated_plot({"ours": [frame]}, "name", "title").panels) == 2


@pytest.mark.parametrize("rows", ["text", [{"steps": "many"}], [[1, 2, 3, 4]]])
def test_a_strange_learning_file_is_passed_over(kept, rows, caplog):
    progress = pd.DataFrame({"steps": [1000, 3000], "wall_s": [10.0, 20.0]})
    frame = learning(kept, rows, progress)
    assert frame is None or frame["steps"].dtype == float
    if frame is None:
        assert "no evaluated learning curve" in caplog.text


def test_what_a_kill_left_of_a_snapshot_goes_when_training_goes_on(kept):
    leftover = kept.path / "snapshots" / ".3000.safetensors.77-0123abcd.tmp"
    leftover.write_bytes(b"half")
    with kept.lock():
        assert not leftover.exists()
    assert list(snapshots(kept)) == [1000, 20000]
