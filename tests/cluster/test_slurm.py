"""Sweeps on a Slurm of this machine: killed, told to stop, out of time, repeated; the results are those without."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from clusters import STEPS, Engine, assert_same, at_work, attempts, await_, console_lines

SWEEP = ("sweep", "smoke", "--steps", str(STEPS), "--launcher", "slurm", "--memory", "1")


def queue(slurm: Engine) -> list[str]:
    """The jobs that wait or run."""
    return slurm.run("squeue", "--noheader", "--array", "--format=%i").split()


def test_killed_stopped_and_out_of_time(slurm: Engine, reference: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    sweep = (*SWEEP, "--seeds", "3", "--runs", str(runs))
    said = slurm.srlrace(*sweep)
    assert "submitted 3 runs as Slurm job" in said
    jobs = sorted(queue(slurm))
    assert len(jobs) == 3  # the command has returned, they have not
    assert slurm.srlrace(*sweep, "--dry-run").count("in Slurm's queue as") == 3
    assert "already" in slurm.srlrace(*sweep)
    assert sorted(queue(slurm)) == jobs

    await_(lambda: at_work(runs, 0))
    slurm.run("scancel", "--signal=KILL", jobs[0])  # a worker that dies
    await_(lambda: at_work(runs, 1))
    slurm.run("scancel", "--signal=USR2", jobs[1])  # what Slurm sends before the time is up
    await_(lambda: at_work(runs, 2))
    slurm.run("scancel", jobs[2])  # SIGTERM to every process of the job
    await_(lambda: not queue(slurm))

    [killed], [requeued], [cancelled] = (list(runs.glob(f"*-s{seed}-*")) for seed in range(3))
    assert (requeued / "policy.safetensors").exists()  # nobody had to repeat anything
    assert attempts(requeued) == 2
    done = (requeued / "policy.safetensors").stat().st_mtime_ns
    left = slurm.srlrace(*sweep, "--dry-run")
    assert [run.name in left for run in (killed, requeued, cancelled)] == [True, False, True]

    assert "submitted 2 runs" in slurm.srlrace(*sweep)
    await_(lambda: not queue(slurm))
    assert_same(runs, reference, 3)
    assert (attempts(killed), attempts(requeued), attempts(cancelled)) == (2, 2, 2)
    assert (requeued / "policy.safetensors").stat().st_mtime_ns == done
    assert "nothing is missing" in slurm.srlrace(*sweep)
    assert not list((runs / ".leases").iterdir())


@pytest.mark.parametrize("partition", ["debug", "graced"])
def test_preempted(slurm: Engine, reference: Path, tmp_path: Path, partition: str) -> None:
    """Killed at once in favour of a job that is more urgent, or told so and given time."""
    runs = tmp_path / "runs"
    sweep = (*SWEEP, "--seeds", "1", "--partition", partition, "--runs", str(runs))
    slurm.srlrace(*sweep)
    await_(lambda: at_work(runs, 0))
    slurm.run("sbatch", "--partition=urgent", f"--cpus-per-task={os.cpu_count()}", "--output=/dev/null", "--wrap=true")
    [run] = runs.glob("*-s0-*")
    await_(lambda: attempts(run) == 2)  # nobody had to repeat anything
    await_(lambda: not queue(slurm))
    assert_same(runs, reference, 1)
    assert attempts(run) == 2
    assert "nothing is missing" in slurm.srlrace(*sweep)


def test_out_of_time(slurm: Engine, tmp_path: Path) -> None:
    """Slurm itself sends the signal, and the job puts itself into the queue again."""
    runs, undisturbed = tmp_path / "runs", tmp_path / "undisturbed"
    sweep = ("sweep", "smoke", "--steps", str(2 * STEPS), "--seeds", "1", "--runs")  # Slurm looks every 30 s
    slurm.srlrace(*sweep, str(runs), "--launcher", "slurm", "--memory", "1")
    [job] = queue(slurm)
    await_(lambda: at_work(runs, 0))
    slurm.run("scontrol", "update", f"JobId={job}", "TimeLimit=1")
    await_(lambda: "PENDING" in slurm.run("squeue", "--noheader", "--format=%T"))
    slurm.run("scontrol", "update", f"JobId={job}", "TimeLimit=30")
    await_(lambda: not queue(slurm))
    slurm.srlrace(*sweep, str(undisturbed))
    assert_same(runs, undisturbed, 1)
    [run] = runs.glob("*-s0-*")
    assert attempts(run) == 2


def test_a_sweep_here_beside_one_in_slurm(slurm: Engine, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    sweep = ("sweep", "smoke", "--seeds", "4", "--steps", "100000", "--runs", str(runs))
    slurm.srlrace(*sweep, "--launcher", "slurm", "--memory", "1")
    slurm.srlrace(*sweep)
    await_(lambda: not queue(slurm))
    folders = [path.parents[2] for path in runs.glob("*/eval/train_map/summary.json")]
    assert [attempts(run) for run in folders] == [1, 1, 1, 1]
    assert not list((runs / ".leases").iterdir())


def test_multirun_of_hydra(slurm: Engine, reference: Path, tmp_path: Path) -> None:
    launcher = ("hydra/launcher=submitit_slurm", "hydra.launcher.mem_gb=1", "hydra.launcher.cpus_per_task=1")
    words = ("env=forest", "level=none", f"algo.total_steps={STEPS}")
    slurm.srlrace("train", "-m", "seed=0,1", *words, *launcher, "--runs", str(tmp_path / "runs"))
    assert_same(tmp_path / "runs", reference, 2)


def test_from_a_laptop_to_slurm_in_five_lines(slurm: Engine, tmp_path: Path) -> None:
    lines = console_lines("cluster.md", "Slurm")
    assert len(lines) <= 5
    slurm.variables |= {"SRLRACE_RUNS": str(tmp_path / "runs")}
    for line in lines:
        if line.startswith("srlrace"):
            slurm.srlrace(*line.split()[1:])
    await_(lambda: not queue(slurm))
    assert len(list((tmp_path / "runs").glob("*/eval/train_map/summary.json"))) == 2
