"""Processes side by side on this machine until every job is complete, has failed, or a signal says stop.

Each run is trained and evaluated in processes of its own, under a lease, so that several crews may share a runs
folder. A job of a scheduler is a crew, too: of one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import IO

from rich.progress import BarColumn, Progress, TextColumn

from srlrace.console import err, fail, say
from srlrace.orphans import followed
from srlrace.signals import handling
from srlrace.sweep.lease import LOST, PATIENCE, Lease, Leases, describe
from srlrace.sweep.pace import Pace, roughly, together
from srlrace.sweep.plan import Job, Plan
from srlrace.text import clean

PROGRAM = (sys.executable, "-m", "srlrace")
POLL = 0.2  # s between looks at the processes
LOOK = 1.0  # s between looks at how far the runs are
RETRY = 2.0  # s between attempts at a run that somebody else has
LEAVE = 1.5 * PATIENCE  # s after which a job of a scheduler leaves a run to whoever has it
LOG_TAIL = 4096  # bytes of a failed process's output that are searched for its last line


@dataclass
class Worker:
    """A process at work for a job, under a lease, and what it says."""

    job: Job
    lease: Lease
    command: list[str]
    process: subprocess.Popen[bytes]
    log: IO[bytes]

    def last_words(self) -> str:
        """The last line of the process's output."""
        self.log.seek(max(0, self.log.seek(0, 2) - LOG_TAIL))
        lines = self.log.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


class Crew:
    """So many processes at a time, for the jobs of a plan; ``leave``: seconds to wait for others to let go of a run."""

    def __init__(self, plan: Plan, jobs: Sequence[Job], size: int, pace: Pace, leave: float = float("inf")) -> None:
        self.plan, self.size, self.leave = plan, size, leave
        self.leases = Leases(plan.root)
        self.waiting = deque(jobs)
        self.held: dict[str, float] = {}  # runs that somebody else has: when to try again
        self.working: list[Worker] = []
        self.failed: list[str] = []
        self.signum: int | None = None
        self.forecast = Forecast(jobs, size, pace)
        self._began = time.monotonic()

    def work(self) -> int:
        """Do all jobs; returns 0, 1 when one failed, 128 + signal when stopped."""
        with self._listening(), self.forecast.display() as display:
            while self.working or (self.waiting and self.signum is None):
                self._hire()
                time.sleep(POLL)
                for worker in [worker for worker in self.working if worker.process.poll() is not None]:
                    self._collect(worker)
                self.forecast.show(display, [worker.job for worker in self.working])
        if self.signum is not None:
            say("stopped; the same command continues")
            return 128 + self.signum
        return int(bool(self.failed))

    def _hire(self) -> None:
        """Begin with as many jobs as there is room for; those in other hands wait at the end of the queue."""
        for _ in range(len(self.waiting)):
            if self.signum is not None or len(self.working) >= self.size:
                return
            job = self.waiting.popleft()
            if time.monotonic() < self.held.get(job.folder.id, 0.0):
                self.waiting.append(job)
            else:
                self._begin(job)

    def _begin(self, job: Job) -> None:
        if job.complete:
            self._complete(job)
            return
        lease = self.leases.claim(job.folder.id)
        holder = job.folder.holder()  # a training that no sweep started, or the last seconds of one that was killed
        if lease is not None and holder is None:
            self._advance(job, lease)
            return
        if lease is not None:
            lease.release()
        seen = self.leases.current(job.folder.id)
        self._put_off(job, holder or (describe(seen) if seen else "another process"))

    def _put_off(self, job: Job, holder: str) -> None:
        if job.folder.id not in self.held:
            say(f"{job.folder.id}: held by {holder}; looking again later")
        elif time.monotonic() - self._began > self.leave:
            say(f"{job.folder.id}: left to {holder}")
            return
        self.held[job.folder.id] = time.monotonic() + RETRY
        self.waiting.append(job)

    def _complete(self, job: Job) -> None:
        self.forecast.complete(job)
        say(f"{job.folder.id}: complete{self.forecast.remark()}")

    def _advance(self, job: Job, lease: Lease) -> None:
        command = job.next_command(self.plan)
        if command is None:
            lease.release()
            self._complete(job)
            return
        say(f"{job.folder.id}: {'training' if command[0] == 'train' else 'evaluating ' + job.missing[0]}")
        log = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the process has ended
        # A session of its own: Ctrl-C reaches the process once, from here, and not from the terminal as well.
        environment = lease.child_environment(followed(os.environ))
        process = subprocess.Popen([*PROGRAM, *command], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                                   env=environment, start_new_session=True)  # fmt: skip
        self.working.append(Worker(job, lease, command, process, log))

    def _collect(self, worker: Worker) -> None:
        self.working.remove(worker)
        job, status = worker.job, worker.process.returncode
        if self.signum is not None:
            worker.lease.release()
        elif status == LOST or (status and job.folder.holder()):
            worker.lease.release()
            self._put_off(job, job.folder.holder() or "another machine")
        elif status or worker.command == job.next_command(self.plan):  # it did not do what it was started for
            worker.lease.release()
            self.failed.append(job.folder.id)
            fail(f"{job.folder.id}: {clean(worker.last_words()).removeprefix('error: ')}")
        else:
            self._advance(job, worker.lease)
        worker.log.close()

    @contextmanager
    def _listening(self) -> Iterator[None]:
        def forward(signum: int, frame: FrameType | None) -> None:
            self.signum = signum
            for worker in self.working:
                if worker.process.poll() is None:
                    worker.process.send_signal(signum)

        with handling(forward):
            yield


class Forecast:
    """How far a crew is, and when it will be done."""

    def __init__(self, jobs: Sequence[Job], size: int, pace: Pace) -> None:
        self.size, self.total = size, len(jobs)
        self.left = {job.folder.id: pace.left(job) for job in jobs}
        self.work = sum(self.left.values()) or 1.0
        self._pace, self._began, self._looked = pace, time.monotonic(), 0.0

    def complete(self, job: Job) -> None:
        """Count a job as done."""
        self.left.pop(job.folder.id, None)

    def remaining(self) -> float:
        """Seconds until everything is done: as expected at first, then as fast as it has gone so far."""
        left = sum(self.left.values())
        done, spent = self.work - left, time.monotonic() - self._began
        if done < 0.05 * self.work:
            return together(list(self.left.values()), self.size)
        return left * spent / done

    def remark(self) -> str:
        """What follows the news that a run is complete."""
        if not self.left or self.total == 1:
            return ""
        return f" ({self.total - len(self.left)} of {self.total} runs; {roughly(self.remaining())} to go)"

    def display(self) -> Progress:
        """Bars for the whole and for each run at work, on a terminal."""
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
                   TextColumn("{task.fields[eta]}"))  # fmt: skip
        return Progress(*columns, console=err, transient=True, disable=not err.is_terminal)

    def show(self, display: Progress, working: Sequence[Job]) -> None:
        """Look how far the jobs at work are, and move the bars on."""
        if time.monotonic() - self._looked < LOOK:
            return
        self._looked = time.monotonic()
        self.left |= {job.folder.id: self._pace.left(job) for job in working}
        if not err.is_terminal:
            return
        rows = {job.folder.id: job.fraction for job in working}
        whole = f"{self.total - len(self.left)} of {self.total} runs"
        rows = {whole: 1 - sum(self.left.values()) / self.work} | rows
        for task in display.tasks:
            if task.description not in rows:
                display.remove_task(task.id)
        for name, fraction in rows.items():
            found = next((task.id for task in display.tasks if task.description == name), None)
            eta = f"{roughly(self.remaining())} to go" if name == whole else ""
            bar = display.add_task(name, total=1.0, eta=eta) if found is None else found
            display.update(bar, completed=fraction, eta=eta)
