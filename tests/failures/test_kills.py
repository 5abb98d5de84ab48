"""SIGKILL at any moment: nothing is lost, and the end is the same to the bit."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from statistics import median

import pytest
from invariants import check_root, leftovers, results, saved, wait_for_progress
from kinds import KINDS, ROLLOUT, words
from soak import SOAKED

from srlrace.hydra_bridge import compose
from srlrace.learn.checkpoint import load_checkpoint
from srlrace.learn.train import Training, train
from srlrace.recording import read_states, recover

FEW = ("buffers", "randomized", "mixed", "laps", "roomy")  # between them, all that a training remembers
LONGEST = 0.9  # s that a process is left alone before it is killed, at most
SAVE_OFTEN = {"srlrace.learn.train:SAVE_EVERY": 0.0}


@pytest.mark.parametrize("kind", KINDS if SOAKED else FEW)
def test_killed_again_and_again_it_ends_the_same(zygote, undisturbed, tmp_path, chance, much, say, kind):
    expected, kills, rounds, steps, resumed = undisturbed(kind), 0, 0, set(), 0
    wanted = much(5, 20)
    while kills < wanted or rounds == 0:
        rounds += 1
        root = tmp_path / f"runs{rounds}"
        command = (["train", *words(kind), "--runs", root], ["eval", "--episodes", "12", "--runs", root])
        while True:
            before = saved(root)
            process = zygote.start(*command, out=tmp_path / "out", set=SAVE_OFTEN)
            evaluates = bool(list(root.glob("*/policy.safetensors")))
            if kills < wanted and not (evaluates and chance.random() < 0.5):
                if kills % 3 == 0 or evaluates:
                    time.sleep(chance.uniform(0, LONGEST))  # anywhere, also while it starts or evaluates
                else:
                    wait_for_progress(root, before + chance.randrange(1, 4) * ROLLOUT)
                    time.sleep(chance.uniform(0, 0.01))
                os.kill(process, signal.SIGKILL)
            status = zygote.wait(process).status
            assert status in (0, -9), (tmp_path / "out").read_text()
            check_root(root)
            if status == 0:
                break
            kills += 1
            for folder in root.glob("*/checkpoint"):
                kept = load_checkpoint(folder)
                steps.add(kept.steps if kept else 0)
                resumed += kept is not None and kept.steps > before
        [folder] = [path for path in root.iterdir() if not path.name.startswith(".")]
        assert results(folder) == expected
        assert leftovers(root) == []
    say(f"{kind}: {kills} kills over {rounds} runs, {resumed} after progress, at {len(steps)} different checkpoints;"
        " all ended the same")  # fmt: skip
    assert resumed >= wanted // 4  # else it was killed while it started, which shows little


def test_killed_within_a_save_nothing_is_unreadable(tmp_path, chance, much, say):
    """The process says what it saved: that, or one that it was about to say, is what must be there."""
    kills, known = much(12, 100), 0
    for _ in range(kills):
        output, child = os.pipe()
        process = os.fork()
        if process == 0:
            save_for_ever(tmp_path, known, child)
        os.close(child)
        first = os.read(output, 100)
        time.sleep(chance.uniform(0, 0.05))
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        with os.fdopen(output, "rb") as stream:
            said = int((first + stream.read()).split()[-1])
        kept = load_checkpoint(tmp_path / "checkpoint")
        assert kept is None or (kept.arrays["a"] == kept.steps).all()
        assert said <= (kept.steps if kept else 0) <= said + 1
        known = kept.steps if kept else 0
    say(f"{kills} kills within {known} saves: none unreadable")
    assert known > kills


def test_a_save_syncs_each_of_three_files_once(tmp_path, monkeypatch, say):
    """What a save takes is what the disk takes for that; the rest of it is a few milliseconds."""
    config, syncs, times = compose(["env=forest", "algo.total_steps=200_000"]), [], []
    save, sync = Training._save, os.fsync

    def timed_sync(descriptor):
        begun = time.perf_counter()
        sync(descriptor)
        syncs[-1].append((Path(f"/proc/self/fd/{descriptor}").readlink().name, time.perf_counter() - begun))

    def timed_save(self):
        syncs.append([])
        begun, busy = time.perf_counter(), time.process_time()
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", timed_sync)
            save(self)
        times.append((time.perf_counter() - begun, time.process_time() - busy))

    monkeypatch.setattr(Training, "_save", timed_save)
    monkeypatch.setattr("srlrace.learn.train.SAVE_EVERY", 0.0)
    train(config, tmp_path)
    for names in ([name for name, _ in one] for one in syncs):
        assert len(names) == 3
        assert sum(".safetensors" in name for name in names) == sum(".json" in name for name in names) == 1
        assert "progress.csv" in names
    disk = [sum(seconds for _, seconds in one) for one in syncs]
    whole, busy = zip(*times, strict=True)
    figures = [f"{1e3 * median(values):.1f}" for values in (whole, disk, busy)]
    say(f"{len(times)} saves: {figures[0]} ms in the median, {figures[1]} of it the disk's; {figures[2]} of CPU")


def save_for_ever(folder, steps, output) -> None:
    """What a killed process was doing."""
    import numpy as np

    from srlrace.learn.checkpoint import Checkpoint, save_checkpoint

    while True:
        steps += 1
        save_checkpoint(folder / "checkpoint", Checkpoint(steps, {"a": np.full(20_000, steps)}, {}))
        os.write(output, b"%d " % steps)


def test_a_killed_evaluation_is_recovered_and_completed(zygote, undisturbed, tmp_path, chance, much, say):
    """Killed while it writes, at sizes that are drawn: what is whole is kept, and repeating completes the rest."""
    root, out = tmp_path / "runs", tmp_path / "out"
    words_ = [*words("plain"), "env.horizon=0.5"]
    evaluation = ["eval", "--episodes", "400", "--runs", root]
    assert zygote.run(["train", *words_, "--runs", root], evaluation, out=out).status == 0, out.read_text()
    [folder] = root.glob("*/eval/train_map")
    recording = folder / "trajectories.mcap"
    part = recording.with_name("trajectories.mcap.part")
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    truth = read_states(recording)
    recovered, killed = [], 0
    for _ in range(much(4, 20)):
        recording.unlink()
        size = chance.randrange(len(whole["trajectories.mcap"]))
        process = zygote.start(evaluation, out=out)
        while size_of(part) < size and not recording.exists():
            pass
        os.kill(process, signal.SIGKILL)
        killed += zygote.wait(process).status == -9
        check_root(root)
        if part.exists() and part.stat().st_size > 20_000:
            states = read_states(recover(part))
            assert states.equals(truth[: len(states)])
            recovered.append(states["episode"].nunique())
        assert zygote.run(evaluation, out=out).status == 0, out.read_text()
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole
    say(f"{killed} evaluations killed; episodes recovered: {sorted(recovered)}")
    assert killed


def size_of(path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1
