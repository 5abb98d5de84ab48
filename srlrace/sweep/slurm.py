"""Slurm: an array of jobs, submitted by submitit; submitting returns, and the files say how far they are."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from srlrace.config import ConfigError
from srlrace.files import FileError, atomic_write, read_limited
from srlrace.sweep.plan import Job, Plan
from srlrace.sweep.resources import Resources
from srlrace.sweep.unit import Unit

FOLDER = ".slurm"  # below the runs folder: submitit's files and logs, and which job has which run
ARRAY_LIMIT = 1000  # jobs of one array; Slurm's default MaxArraySize is 1001
WARNING = 90  # s before the end of a job's time at which it is told to save
REQUEUES = 1000  # how often a job may go on after its time limit
PATIENCE = 30  # s for an answer of squeue


def submit(plan: Plan, jobs: Sequence[Job], resources: Resources, side_by_side: int | None) -> list[str]:
    """Submit a Slurm job for each job of a plan; returns the arrays' ids. Raises `ConfigError` when Slurm refuses."""
    executor = _executor(plan.root / FOLDER)
    words = {name: value or True for name, value in resources.extra.items()}
    executor.update_parameters(
        name="srlrace",
        cpus_per_task=resources.cores,
        mem_gb=resources.memory_gb,
        timeout_min=resources.minutes,
        slurm_array_parallelism=side_by_side or len(jobs),
        slurm_signal_delay_s=WARNING,
        slurm_additional_parameters={"requeue": True, **words},
        **({"slurm_partition": resources.partition} if resources.partition else {}),
    )
    arrays = []
    for start in range(0, len(jobs), ARRAY_LIMIT):
        part = jobs[start : start + ARRAY_LIMIT]
        submitted = _submitted(executor, [Unit(plan, job) for job in part])
        for job, ticket in zip(part, submitted, strict=True):
            atomic_write(plan.root / FOLDER / job.folder.id, ticket.job_id)
        arrays.append(submitted[0].job_id.partition("_")[0])
    return arrays


def queued(root: Path, jobs: Sequence[Job]) -> dict[str, str]:
    """The runs that wait or run in Slurm already, with their job's id; none where Slurm does not answer."""
    submitted = {}
    for job in jobs:
        try:
            submitted[job.folder.id] = read_limited(root / FOLDER / job.folder.id).decode()
        except (FileError, ValueError):
            continue
    alive = _alive() if submitted else set()
    return {run: ticket for run, ticket in submitted.items() if ticket in alive}


def _alive() -> set[str]:
    command = ["squeue", "--me", "--noheader", "--array", "--format=%i"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
    except (OSError, subprocess.SubprocessError):
        return set()
    return set(done.stdout.split())


def _executor(folder: Path) -> Any:
    try:
        import submitit
    except ImportError:
        raise ConfigError("--launcher: slurm needs submitit; install it with: pip install 'srlrace[slurm]'") from None
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)  # what lies there is executed by the jobs
    try:
        return submitit.AutoExecutor(folder / "%A", cluster="slurm", slurm_max_num_timeout=REQUEUES)
    except RuntimeError:
        raise ConfigError(
            "--launcher: slurm needs sbatch and srun, which are not here; submit from a login node"
        ) from None


def _submitted(executor: Any, units: Sequence[Unit]) -> list[Any]:
    from submitit.core.utils import FailedJobError

    try:
        return list(executor.submit_array(list(units)))
    except FailedJobError as error:
        raise ConfigError(f"Slurm refuses the jobs: {' '.join(str(error).split())[-300:]}") from None
