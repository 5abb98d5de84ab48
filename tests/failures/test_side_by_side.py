"""Several processes at one runs folder: one trains, the others say so or wait; looking never fails."""

from __future__ import annotations

import io
import json
import os
import signal
import time

from invariants import check_root, results
from kinds import words
from rich.console import Console

from srlrace.config import run_id, to_dict
from srlrace.files import write_sealed
from srlrace.hydra_bridge import compose
from srlrace.learn.checkpoint import Checkpoint, save_checkpoint
from srlrace.runs import RunFolder, State, list_runs
from srlrace.tables import run_page, runs_table

EIGHT = 8


def eight_words(place) -> list[str]:
    """The command of eight identical trainings."""
    command = ["train", *words("curriculum"), "algo.total_steps=25600", "--runs", str(place / "runs")]
    command.remove("algo.total_steps=3840")
    return command


def start_eight(zygote, place, env=None) -> tuple[list[int], list]:
    """Eight identical trainings at once: their processes, and the files of what they say."""
    outs = [place / f"out{i}" for i in range(EIGHT)]
    return [zygote.start(eight_words(place), out=out, env=env) for out in outs], outs


def test_of_eight_one_trains_and_the_others_say_who(zygote, tmp_path):
    processes, outs = start_eight(zygote, tmp_path)
    ended = [(zygote.wait(process).status, out.read_text()) for process, out in zip(processes, outs, strict=True)]
    assert sorted(status for status, _ in ended)[0] == 0
    trained = [text for status, text in ended if "is finished after" in text]
    assert len(trained) == 1
    for status, text in ended:
        held = status == 2 and " is held by process " in text
        assert status == 0 or (held and len(text.splitlines()) == 1), text
    [run] = list_runs(tmp_path / "runs")
    assert run.state is State.FINISHED
    check_root(tmp_path / "runs")


def test_of_eight_that_wait_one_trains_and_all_succeed(zygote, tmp_path):
    """They find the run held by this process, which lets go when all of them wait."""
    run = RunFolder(tmp_path / "runs" / run_id(compose(eight_words(tmp_path)[1:-2])))
    with run.lock():
        processes, outs = start_eight(zygote, tmp_path, env={"SRLRACE_WAIT": "1"})
        waiting = f"{run.id} is held by process {os.getpid()} on "
        give_up = time.monotonic() + 120
        while not all(has_said(out, "; waiting") for out in outs) and time.monotonic() < give_up:
            time.sleep(0.01)
    statuses, texts = [zygote.wait(process).status for process in processes], [out.read_text() for out in outs]
    assert statuses == [0] * EIGHT, texts
    assert all(waiting in text and "; waiting" in text for text in texts), texts
    assert sum("is finished after" in text for text in texts) == 1
    assert sum("is finished; skipped" in text for text in texts) == EIGHT - 1


def has_said(out, text) -> bool:
    return out.exists() and text in out.read_text()


def test_looking_while_others_write_never_fails(tmp_path, much, say):
    folder = tmp_path / "forest-srl-s0-00000000"
    folder.mkdir()
    config = json.dumps(to_dict(compose([])))
    writer = os.fork()
    if writer == 0:
        write_for_ever(folder, config)
    looks, seen = much(100, 1000), set()
    try:
        while not (folder / "config.json").exists():
            time.sleep(0.01)
        for _ in range(looks):
            runs = list_runs(tmp_path)
            console = Console(file=io.StringIO(), width=200)
            console.print(runs_table(runs))
            for part in run_page(runs[0]):
                console.print(part)
            seen.add(runs[0].info.get("steps"))
    finally:
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
    say(f"{looks} looks while {max(step for step in seen if step)} states were written")
    assert None not in seen


def write_for_ever(folder, config) -> None:
    import numpy as np

    from srlrace.files import atomic_write

    write_sealed(folder / "run.json", {"steps": 0})
    (folder / "eval" / "train_map").mkdir(parents=True)
    for steps in range(1, 10**9):
        atomic_write(folder / "config.json", config)
        write_sealed(folder / "run.json", {"steps": steps})
        write_sealed(folder / "eval" / "train_map" / "summary.json", {"episodes": steps, "suite": "train_map"})
        save_checkpoint(folder / "checkpoint", Checkpoint(steps, {"a": np.zeros(9)}, {}))
        with (folder / "progress.csv").open("w") as stream:
            stream.write(f"steps,success_ratio\n{steps},0.5\n{steps + 1},")


def test_two_evaluations_of_one_suite(zygote, undisturbed, tmp_path):
    """The second is told who is at it, or waits; what is left is one evaluation, whole."""
    runs = ("--runs", tmp_path / "runs")
    assert zygote.run(["train", *words("buffers"), *runs], out=tmp_path / "out").status == 0
    [run] = list_runs(tmp_path / "runs")
    long, short = (["eval", "--episodes", str(n), *runs] for n in (200, 12))
    first = zygote.start(long, out=tmp_path / "first")
    lock = run.path / "eval" / ".train_map.lock"
    while not lock.exists() or not lock.read_bytes():
        time.sleep(0.002)
    os.kill(first, signal.SIGSTOP)
    try:
        assert zygote.run(short, out=tmp_path / "second").status == 2
    finally:
        os.kill(first, signal.SIGCONT)
    said = (tmp_path / "second").read_text()
    assert f"the evaluation of {run.id} on train_map is held by process {first} on" in said
    second = zygote.start(short, out=tmp_path / "third", env={"SRLRACE_WAIT": "1"})
    assert zygote.wait(first).status == 0, (tmp_path / "first").read_text()
    assert zygote.wait(second).status == 0, (tmp_path / "third").read_text()
    assert results(run.path) == undisturbed("buffers")
