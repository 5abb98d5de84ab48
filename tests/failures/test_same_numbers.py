"""The same seed gives the same bytes wherever and whenever it runs; numbers that are none are caught in time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from hashlib import sha256

import numpy as np
import pytest
import torch
from invariants import results
from kinds import ROLLOUT, words
from soak import SOAKED

from srlrace.hydra_bridge import compose
from srlrace.learn import train as training
from srlrace.learn.checkpoint import load_checkpoint
from srlrace.learn.train import Diverged, train
from srlrace.provenance import changes, circumstances

TRAIN_AND_FLY = """
import sys
from srlrace import cli
root = sys.argv[1]
for words in (["train", *sys.argv[2:]], ["eval", "--episodes", "12"]):
    sys.argv = ["srlrace", *words, "--runs", root]
    try:
        cli.main()
    except SystemExit as leaving:
        if leaving.code:
            raise
"""


def test_nothing_around_it_changes_a_result(undisturbed, tmp_path):
    """Hash seed, locale, time zone, working directory, thread variables, umask."""
    strange = {"PYTHONHASHSEED": "4321", "LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8", "TZ": "Asia/Kathmandu",
               "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2", "PYTHONUTF8": "0", "COLUMNS": "40"}  # fmt: skip
    (tmp_path / "elsewhere").mkdir()
    command = [sys.executable, "-c", TRAIN_AND_FLY, str(tmp_path / "runs"), *words("mixed")]
    done = subprocess.run(command, cwd=tmp_path / "elsewhere", env={**os.environ, **strange}, capture_output=True,
                          text=True, umask=0o077, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    [folder] = (tmp_path / "runs").iterdir()
    assert results(folder) == undisturbed("mixed")


@pytest.mark.skipif(not SOAKED, reason="compiles everything anew, which takes a minute: in the soak")
def test_results_do_not_depend_on_what_is_compiled_already(undisturbed, tmp_path, chance, say):
    """An empty cache, a full one, and those that lack other halves: kernels that call kernels round the same."""
    cache, found = tmp_path / "cache", []
    for index in range(5):
        if index > 1:
            kernels = sorted(cache.rglob("*.nbi"))
            for kernel in chance.sample(kernels, len(kernels) // 2):
                kernel.unlink()
        command = [sys.executable, "-c", TRAIN_AND_FLY, str(tmp_path / f"runs{index}"), *words("mixed")]
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        [folder] = (tmp_path / f"runs{index}").iterdir()
        found.append(results(folder))
    assert len(list(cache.rglob("*.nbi"))) > 50
    assert found == [undisturbed("mixed")] * 5
    say(f"{len(list(cache.rglob('*.nbi')))} kernels from an empty cache, a full one, and three half full: the same")


def test_results_do_not_depend_on_the_clock(undisturbed, tmp_path, monkeypatch):
    """A clock that runs a thousand times faster, and backwards now and then: saves and rows move, results do not."""
    real, monotonic = time.time, time.monotonic
    monkeypatch.setattr(time, "time", lambda: 2e9 - 1000 * real() % 777)
    monkeypatch.setattr(time, "monotonic", lambda: 1000 * monotonic())
    folder = train(compose(words("laps")), tmp_path)
    monkeypatch.undo()
    policy = (folder / "policy.safetensors").read_bytes()
    assert sha256(policy).hexdigest() == undisturbed("laps")["policy.safetensors"]


def test_threads_are_pinned_and_recorded(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    config = compose(words("short"))
    folder = train(config, tmp_path)
    assert torch.get_num_threads() == config.algo.threads
    assert json.loads((folder / "run.json").read_text())["threads"] == config.algo.threads
    assert load_checkpoint(folder / "checkpoint").facts["threads"] == config.algo.threads
    (folder / "policy.safetensors").unlink()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    train(config, tmp_path)
    assert "threads was 1, now 7: the result will not be that of an undisturbed run" in caplog.text


def test_what_changed_around_a_run_is_named():
    now = circumstances(1)
    assert list(changes(now, now)) == []
    assert list(changes({}, now)) == []
    other = {**now, "cpu": "abacus", "versions": {**now["versions"], "torch": "0.1"}}
    found = list(changes(other, now))
    assert len(found) == 2
    assert found[0].startswith("cpu was 'abacus', now ")
    assert found[1].startswith("torch was '0.1', now ")


def spoil_environment(part, value):
    def spoil(model, env):
        inner, count = env.step_wait, iter(range(10**6))

        def step_wait():
            result = inner()
            if next(count) == 40:  # in the third rollout of 16 steps
                result[part].flat[1] = value
            return result

        env.step_wait = step_wait

    return spoil


def spoil_action(value):
    def spoil(model, env):
        collect = model.collect_rollouts

        def collect_and_spoil(*rest, **options):
            kept = collect(*rest, **options)
            if model.num_timesteps == 3 * ROLLOUT:
                model.rollout_buffer.actions.flat[1] = value
                training.check_rollout(model)
            return kept

        model.collect_rollouts = collect_and_spoil

    return spoil


def spoil_update(change):
    def spoil(model, env):
        update = model.train

        def train_and_spoil():
            update()
            if model.num_timesteps == 3 * ROLLOUT:
                change(model)

        model.train = train_and_spoil

    return spoil


def spoil_weight(value):
    def change(model):
        with torch.no_grad():
            next(model.policy.action_net.parameters())[0, 0] = value

    return spoil_update(change)


def spoil_loss(value):
    return spoil_update(lambda model: model.logger.record("train/loss", value))


SPOILT = {
    "observation": lambda value: spoil_environment(0, value),
    "reward": lambda value: spoil_environment(1, value),
    "action": spoil_action,
    "loss": spoil_loss,
    "weights": spoil_weight,
}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("part", SPOILT)
def test_what_is_no_number_is_caught_within_one_rollout(tmp_path, monkeypatch, part, value):
    build = training.build_ppo

    def build_and_spoil(config, env):
        model = build(config, env)
        SPOILT[part](value)(model, env)
        return model

    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(training, "build_ppo", build_and_spoil)
    config = compose([word for word in words("short") if "total_steps" not in word] + ["algo.total_steps=640"])
    with pytest.raises(Diverged, match=rf"{part}.* (not|are) .*finite.* step {3 * ROLLOUT}"):
        train(config, tmp_path)
    [folder] = tmp_path.iterdir()
    kept = load_checkpoint(folder / "checkpoint")
    assert kept.steps == 2 * ROLLOUT
    assert all(np.isfinite(array).all() for name, array in kept.arrays.items() if array.dtype == np.float32)
