"""`srlrace sweep`: what is missing is planned, then done here, on Slurm or on Ray."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from srlrace.config import ConfigError
from srlrace.console import out, say
from srlrace.parse import nearest, show
from srlrace.sweep.crew import Crew
from srlrace.sweep.lease import Leases, describe
from srlrace.sweep.pace import Pace, read_pace, roughly, together
from srlrace.sweep.plan import Job, Plan, experiments, plan_jobs
from srlrace.sweep.resources import Resources
from srlrace.sweep.slurm import queued, submit
from srlrace.text import clean

LAUNCHERS = ("local", "slurm", "ray")
LOCAL_JOBS = 2  # runs side by side on one machine, unless --jobs says otherwise
LOGS = ".sweep"  # below the runs folder: output of detached sweeps


def check_launcher(name: str) -> str:
    """Check ``--launcher``; raises `ConfigError`."""
    if name not in LAUNCHERS:
        takes = ", ".join(LAUNCHERS)
        raise ConfigError(f"--launcher: got {show(name)}; takes one of {takes}{nearest(name, LAUNCHERS)}")
    return name


def sweep(
    names: Sequence[str], plan: Plan, launcher: str, jobs: int | None, resources: Resources, dry_run: bool
) -> int:
    """Do what is missing of the experiments; returns the exit status. Raises `ConfigError`."""
    todo = [job for job in plan_jobs(experiments(names), plan) if not job.complete]
    pace = read_pace(plan.root)
    waiting = queued(plan.root, todo)
    if dry_run:
        _show(todo, pace, jobs or (LOCAL_JOBS if launcher == "local" else len(todo)), plan.root, waiting)
        return 0
    status = 0
    if launcher == "slurm":
        return _submit(plan, [job for job in todo if job.folder.id not in waiting], resources, jobs, pace, waiting)
    if todo and launcher == "ray":
        from srlrace.sweep import ray_cluster

        status = ray_cluster.run(plan, todo, resources.fill(todo, pace), jobs, pace)
    elif todo:
        status = Crew(plan, todo, jobs or LOCAL_JOBS, pace).work()
    if not status:
        from srlrace.report.command import report

        report(plan.root)
    return status


def _submit(
    plan: Plan, todo: Sequence[Job], resources: Resources, jobs: int | None, pace: Pace, waiting: dict[str, str]
) -> int:
    runs = "" if plan.root == Path("runs").absolute() else f" --runs {plan.root}"
    if waiting:
        say(f"{len(waiting)} runs are in Slurm's queue already")
    if todo:
        filled = resources.fill(todo, pace)
        arrays = submit(plan, todo, filled, jobs)
        asked = f"{filled.cores} core(s), {filled.memory_gb:g} GB, {filled.minutes} min each"
        say(f"submitted {len(todo)} runs as Slurm job {', '.join(arrays)} ({asked})")
        say(f"stop them with: scancel {' '.join(arrays)}")
    if todo or waiting:
        say(f"follow them with: srlrace runs --watch{runs}; then: srlrace report{runs}")
    else:
        say(f"nothing is missing; see: srlrace report{runs}")
    return 0


def _show(todo: Sequence[Job], pace: Pace, size: int, root: Path, waiting: dict[str, str]) -> None:
    """Say what would be done, and how long that is expected to take."""
    left = [pace.left(job) for job in todo]
    leases = Leases(root)
    for job, seconds in zip(todo, left, strict=True):
        train = f"train {' '.join(job.overrides)}; " if job.untrained else ""
        missing = f"evaluate {', '.join(job.missing)}" if job.missing else "no evaluation"
        seen = leases.current(job.folder.id)
        holder = job.folder.holder() or (describe(seen) if seen else "")
        held = f"; held by {holder}" if holder else ""
        held = f"; in Slurm's queue as {waiting[job.folder.id]}" if job.folder.id in waiting else held
        line = f"{job.folder.id}: {train}{missing}; {roughly(seconds)}{held}"
        out.print(clean(line), markup=False, soft_wrap=True)
    size = max(1, min(size, len(todo)))
    expected = f", about {roughly(together(left, size))} with {size} at a time ({pace.source})" if todo else ""
    say(f"{len(todo)} runs to train or evaluate{expected}")


def detach(root: Path) -> int:
    """Start this very command again, detached from the terminal, with its output in a file; returns at once."""
    folder = root / LOGS
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"{datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}.log"
    words = [word for word in sys.argv[1:] if word != "--detach"]
    with log.open("wb") as stream:
        process = subprocess.Popen([sys.executable, "-m", "srlrace", *words], stdin=subprocess.DEVNULL, stdout=stream,
                                   stderr=stream, start_new_session=True)  # fmt: skip
    say(f"started as process {process.pid}; it writes to {log}")
    say(f"follow it with: srlrace runs --watch; stop it with: kill {process.pid}")
    return 0
