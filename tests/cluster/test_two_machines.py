"""Two sweeps of one folder on machines that know each other from nothing but its files, their clocks minutes apart."""

from __future__ import annotations

import sys
from pathlib import Path

from clusters import STEPS, Engine, assert_same, at_work, attempts, await_, family, kill

# What a process on another machine finds: its own kernel, whose locks reach nobody here, and another time of day.
ELSEWHERE = """
import fcntl, pathlib, time
here, now = pathlib.Path.read_text, time.time
fcntl.flock = lambda descriptor, operation: None
time.time = lambda: now() + 300.0
pathlib.Path.read_text = lambda path, *a, **k: "elsewhere" if path.name == "boot_id" else here(path, *a, **k)
"""


def test_a_machine_that_dies_is_succeeded(reference: Path, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(ELSEWHERE)
    here, there = Engine({}), Engine({"PYTHONPATH": str(tmp_path)})
    runs = tmp_path / "runs"
    sweep = (sys.executable, "-m", "srlrace", "sweep", "smoke", "--steps", str(STEPS), "--seeds", "2", "--jobs", "1")
    first = there.start(*sweep, "--runs", str(runs))
    await_(lambda: at_work(runs, 0))
    second = here.start(*sweep, "--runs", str(runs))
    await_(lambda: at_work(runs, 1))  # it takes what nobody has
    [left], [taken] = (list(runs.glob(f"*-s{seed}-*")) for seed in range(2))
    assert (attempts(left), attempts(taken)) == (1, 1)
    kill(family(first.pid))  # a power cut
    assert second.wait(900) == 0
    assert (attempts(left), attempts(taken)) == (2, 1)
    assert_same(runs, reference, 2)
    assert not list((runs / ".leases").iterdir())
