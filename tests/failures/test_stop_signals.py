"""SIGINT, SIGTERM and SIGHUP at any moment: the state is saved at once, and the way on is said."""

from __future__ import annotations

import os
import signal
import time

import pytest
from invariants import check_root, results, saved, wait_for_progress
from kinds import ROLLOUT, words

from srlrace.learn.checkpoint import load_checkpoint

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SLOW = {"srlrace.learn.train:SAVE_EVERY": 0.0}


@pytest.mark.parametrize("signum", SIGNALS, ids=lambda number: number.name)
def test_a_signal_at_any_moment(zygote, undisturbed, tmp_path, chance, much, say, signum):
    expected, delays, moments = undisturbed("buffers"), [], much(4, 20)
    root, rounds, advanced = tmp_path / "runs0", 0, 0
    while moments:
        out, before = tmp_path / f"out{moments}-{rounds}", saved(root)
        process = zygote.start(["train", *words("buffers"), "--runs", root], out=out, set=SLOW)
        if moments % 3:
            wait_for_progress(root, before + chance.randrange(1, 4) * ROLLOUT)
            time.sleep(chance.uniform(0, 0.01))  # a rollout, its update or a save
        else:
            time.sleep(chance.uniform(0.02, 0.6))  # anywhere
        os.kill(process, signum)
        begun = time.monotonic()
        ended = zygote.wait(process)
        delays.append(time.monotonic() - begun)
        text = out.read_text()
        check_root(root)
        if ended.status == 0:  # it had finished before
            rounds += 1
            root = tmp_path / f"runs{rounds}"
            continue
        assert ended.status in (128 + signum, -signum), text  # the latter: not begun to handle anything
        assert "Traceback" not in text
        if "training forest" in text:
            assert f"stopped by {signum.name}; resume with: srlrace resume " in text
            advanced += saved(root) > before
        moments -= 1
    assert advanced
    runs = ("--runs", root)
    assert zygote.run(["train", *words("buffers"), *runs], ["eval", "--episodes", "12", *runs], out=out).status == 0
    [folder] = [path for path in root.iterdir() if not path.name.startswith(".")]
    assert results(folder) == expected
    say(f"{signum.name}: {len(delays)} signals, {advanced} after progress; saved and gone in {max(delays):.2f} s")


def test_a_signal_does_not_wait_for_the_rollout(zygote, tmp_path, say):
    """A rollout and its update that would take minutes are given up; what came before them is saved."""
    big = ["level=1", "algo.n_envs=100", "algo.n_steps=2000", "algo.batch_size=1000", "algo.n_epochs=1000"]
    out = tmp_path / "out"
    process = zygote.start(["train", *big, "--runs", tmp_path / "runs"], out=out)
    give_up = time.monotonic() + 60
    while not (out.exists() and "training forest" in out.read_text()) and time.monotonic() < give_up:
        time.sleep(0.01)
    time.sleep(1.0)
    os.kill(process, signal.SIGTERM)
    begun = time.monotonic()
    assert zygote.wait(process).status == 143, out.read_text()
    say(f"within an update of minutes: gone after {time.monotonic() - begun:.2f} s")


def test_the_second_ctrl_c_leaves_at_once(zygote, tmp_path, chance, much):
    for index in range(much(3, 20)):
        root, out = tmp_path / f"runs{index // 5}", tmp_path / f"out{index}"
        before = saved(root)
        process = zygote.start(["train", *words("mixed"), "--runs", root], out=out, set=SLOW)
        wait_for_progress(root, before + ROLLOUT)
        time.sleep(chance.uniform(0, 0.01))
        os.kill(process, signal.SIGINT)
        time.sleep(chance.uniform(0, 0.004))
        os.kill(process, signal.SIGINT)
        assert zygote.wait(process).status in (130, -2, 0), out.read_text()
        check_root(root)
        for folder in root.glob("*/checkpoint"):
            load_checkpoint(folder)
