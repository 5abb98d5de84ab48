"""A training killed and stopped again and again, in real processes, against one that nothing disturbed."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest

from srlrace.config import run_id
from srlrace.evaluation import evaluate_run
from srlrace.hydra_bridge import compose
from srlrace.learn.checkpoint import load_checkpoint
from srlrace.learn.train import train
from srlrace.runs import RunFolder, State

WORDS = [
    "level=1", "algo.n_envs=16", "algo.n_steps=32", "algo.batch_size=128", "algo.n_epochs=2", "algo.policy_layers=[16]",
    "algo.value_layers=[16]", "algo.total_steps=61440", "curriculum.gate_starts=0.3", "curriculum.memory_starts=0.3",
]  # fmt: skip
# The command line as it is, with a checkpoint after every rollout instead of every five seconds.
PROGRAM = """
import sys
from srlrace import cli
from srlrace.learn import train
train.SAVE_EVERY = 0.0
sys.argv[0] = "srlrace"
cli.main()
"""


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return train(compose(WORDS), tmp_path_factory.mktemp("reference"))


def steps(run: RunFolder) -> int:
    """Newest checkpoint, by its name: reading it would race with the training."""
    return max((int(path.stem) for path in (run.path / "checkpoint").glob("*.json")), default=0)


def start(root) -> subprocess.Popen:
    command = [sys.executable, "-c", PROGRAM, "train", *WORDS, "--runs", str(root)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def stop_later(run, process, signum, rng) -> str:
    """Send a signal when the training has come at least 3 rollouts further, and a random moment more."""
    before, give_up = steps(run), time.monotonic() + 60
    while steps(run) < before + 3 * 512 and process.poll() is None and time.monotonic() < give_up:
        time.sleep(0.002)
    time.sleep(rng.uniform(0, 0.05))
    process.send_signal(signum)
    return process.communicate(timeout=60)[1]


def test_killed_and_stopped_it_ends_the_same(tmp_path, reference):
    rng = random.Random(os.getpid())  # another moment in every run of this test: all of them must do
    run = RunFolder(tmp_path / "runs" / run_id(compose(WORDS)))
    reached = []
    for signum, status in (
        (signal.SIGTERM, 143),
        (signal.SIGKILL, -9),
        (signal.SIGINT, 130),
        (signal.SIGKILL, -9),
        (signal.SIGKILL, -9),
    ):
        with start(tmp_path / "runs") as process:
            errors = stop_later(run, process, signum, rng)
        assert process.returncode == status, errors
        if status > 0:
            assert f"stopped by {signum.name}; resume with: srlrace resume {run.id} --runs" in errors
        assert run.state is State.INTERRUPTED
        reached.append(load_checkpoint(run.path / "checkpoint").steps)
        assert not list(run.path.glob("policy.safetensors*"))
    assert reached == sorted(set(reached))  # further each time
    assert reached[-1] < 61440
    with start(tmp_path / "runs") as process:
        assert process.wait(timeout=120) == 0, process.stderr.read()
    assert run.state is State.FINISHED
    assert len(json.loads((run.path / "run.json").read_text())["attempts"]) == 6
    same = [(folder / "policy.safetensors").read_bytes() for folder in (run.path, reference)]
    assert same[0] == same[1]
    rows = [(folder / "progress.csv").read_text().splitlines() for folder in (run.path, reference)]
    assert [untimed(row) for row in rows[0]] == [untimed(row) for row in rows[1]]
    for folder in (run.path, reference):
        evaluate_run(RunFolder(folder), 20, record="none")
    same = [(folder / "eval/train_map/episodes.csv").read_bytes() for folder in (run.path, reference)]
    assert same[0] == same[1]


def untimed(row: str) -> list[str]:
    """A row of progress.csv without wall-clock and speed."""
    fields = row.split(",")
    return [fields[0], *fields[3:]]


def test_a_second_process_is_told_who_trains(tmp_path):
    run = RunFolder(tmp_path / "runs" / run_id(compose(WORDS)))
    with start(tmp_path / "runs") as first:
        give_up = time.monotonic() + 60
        while run.state is not State.TRAINING and time.monotonic() < give_up:
            time.sleep(0.005)
        first.send_signal(signal.SIGSTOP)
        try:
            with start(tmp_path / "runs") as second:
                errors = second.communicate(timeout=60)[1]
        finally:
            first.send_signal(signal.SIGCONT)
            first.send_signal(signal.SIGKILL)
    assert second.returncode == 2
    assert f"{run.id} is held by process {first.pid} on" in errors
    assert len(errors.strip().splitlines()) == 1
