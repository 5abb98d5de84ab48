"""One job of a scheduler: a run's training and evaluations, in the process that the scheduler started."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Any

from srlrace.console import setup_logging
from srlrace.signals import pass_on, preempted
from srlrace.sweep.crew import LEAVE, Crew
from srlrace.sweep.pace import Pace
from srlrace.sweep.plan import Job, Plan


class JobFailed(RuntimeError):
    """A job that did not come to its end; the scheduler shows it as failed."""


@dataclass(frozen=True)
class Unit:
    """What is sent to a node: everything that the job needs besides the runs folder and srlrace itself."""

    plan: Plan
    job: Job

    def __call__(self) -> str:
        """Do what is missing; returns the run's id. Raises `JobFailed`."""
        setup_logging()
        status = Crew(self.plan, [self.job], 1, Pace({}, 0), LEAVE).work()
        if status > 128:
            # Everything is saved: now the scheduler's own handler may requeue the job.
            pass_on(signal.SIGUSR2 if preempted() else status - 128)
        if status:
            raise JobFailed(f"{self.job.folder.id}: status {status}")
        return self.job.folder.id

    def checkpoint(self) -> Any:
        """What submitit is to start when the job is requeued: the same, which continues the run."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)
