"""Ray: a task for each job of a plan, on whatever nodes the cluster has; Ray starts a task anew where one is lost."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from types import FrameType
from typing import Any

from srlrace.config import ConfigError
from srlrace.console import fail, say
from srlrace.signals import handling
from srlrace.sweep.crew import Forecast
from srlrace.sweep.pace import Pace
from srlrace.sweep.plan import Job, Plan
from srlrace.sweep.resources import Resources
from srlrace.sweep.unit import Unit
from srlrace.text import clean

ATTEMPTS = 20  # how often a task may lose its worker or its node
GB = 10**9  # bytes
POLL = 5.0  # s within which a signal is noticed


def run(plan: Plan, jobs: Sequence[Job], resources: Resources, side_by_side: int | None, pace: Pace) -> int:
    """Do the jobs as tasks of a Ray cluster; returns 0, or 1 when one failed. Raises `ConfigError` without Ray."""
    ray = _connect()
    wanted = {"num_cpus": resources.cores, "memory": int((resources.memory_gb or 0) * GB)}
    task = ray.remote(**wanted, max_retries=ATTEMPTS)(_work)
    cores = int(ray.cluster_resources().get("CPU", 1)) // (resources.cores or 1)
    forecast = Forecast(jobs, min(side_by_side or cores, cores) or 1, pace)
    waiting, working, failed = deque(jobs), dict[Any, Job](), 0
    with ExitStack() as stack:
        stack.callback(ray.shutdown)  # the workers end with it, and what they train is saved
        stack.enter_context(handling(_leave))
        while waiting or working:
            while waiting and len(working) < (side_by_side or len(jobs)):
                job = waiting.popleft()
                working[task.options(name=job.folder.id).remote(Unit(plan, job))] = job
            for ended in ray.wait(list(working), timeout=POLL)[0]:
                failed += not _collect(ray, ended, working.pop(ended), forecast)
    return int(bool(failed))


def _leave(signum: int, frame: FrameType | None) -> None:
    say("stopped; the same command continues")
    raise SystemExit(128 + signum)


def _work(unit: Unit) -> str:
    return unit()


def _collect(ray: Any, ended: Any, job: Job, forecast: Forecast) -> bool:
    try:
        ray.get(ended)
    except ray.exceptions.RayError as error:
        fail(f"{job.folder.id}: {clean(str(error).strip().splitlines()[-1])}")
        return False
    forecast.complete(job)
    say(f"{job.folder.id}: {'complete' if job.complete else 'left to another sweep'}{forecast.remark()}")
    return True


def _connect() -> Any:
    """Connect to the cluster that ``RAY_ADDRESS`` names, or that runs on this machine, or start one of this machine."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no network unless asked for
    try:
        import ray
    except ImportError:
        raise ConfigError("--launcher: ray is not installed; install it with: pip install 'srlrace[ray]'") from None
    try:
        ray.init(address="auto")
    except ConnectionError:
        if os.environ.get("RAY_ADDRESS"):
            raise ConfigError(f"RAY_ADDRESS: no Ray cluster at {os.environ['RAY_ADDRESS']!r}") from None
        say("no Ray cluster here: starting one on this machine, for this sweep")
        ray.init(include_dashboard=False)
    return ray
