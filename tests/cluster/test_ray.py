"""Sweeps on a Ray of two nodes: a worker, a node and the sweep itself killed, then repeated."""

from __future__ import annotations

import sys
from pathlib import Path

from clusters import STEPS, Engine, assert_same, at_work, attempts, await_, console_lines, family, kill, processes

SWEEP = ("sweep", "smoke", "--steps", str(STEPS), "--seeds", "3", "--launcher", "ray", "--memory", "0.5")


def test_a_worker_a_node_and_the_sweep_killed(ray_cluster: Engine, reference: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    sweep = (*SWEEP, "--runs", str(runs))
    first = ray_cluster.start(sys.executable, "-m", "srlrace", *sweep)

    await_(lambda: at_work(runs, 0))
    [killed] = runs.glob("*-s0-*")
    kill(processes("ray::", killed.name))  # a worker
    await_(lambda: any(at_work(runs, seed) for seed in (1, 2)))
    kill(family(ray_cluster.processes[1].pid))  # the second node
    # Ray starts what they had anew, after the others, on the node that is left; nobody had to repeat anything.
    await_(lambda: attempts(killed) > 1 and at_work(runs, 0), 1800)
    first.kill()  # the sweep
    await_(lambda: not processes("srlrace", str(runs)), 180)  # nobody trains on for a sweep that is gone
    done = {path: path.stat().st_mtime_ns for path in runs.glob("*/policy.safetensors")}
    left = ray_cluster.srlrace(*sweep, "--dry-run")
    assert f"{killed.name}: train" in left
    assert not any(f"{path.parent.name}: train" in left for path in done)

    ray_cluster.srlrace(*sweep)
    assert_same(runs, reference, 3)
    assert attempts(killed) > 2
    assert all(path.stat().st_mtime_ns == written for path, written in done.items())
    assert not list((runs / ".leases").iterdir())


def test_from_a_laptop_to_ray_in_five_lines(ray_cluster: Engine, tmp_path: Path) -> None:
    lines = console_lines("cluster.md", "Ray")
    assert len(lines) <= 5
    ray_cluster.variables |= {"SRLRACE_RUNS": str(tmp_path / "runs")}
    for line in lines:
        if line.startswith("srlrace"):
            ray_cluster.srlrace(*line.split()[1:], "--memory", "0.5")
    assert len(list((tmp_path / "runs").glob("*/eval/train_map/summary.json"))) == 2
