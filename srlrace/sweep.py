"""Sweeps: every run of an experiment file that is missing is trained and evaluated, several side by side.

A cell of a table means a configuration, and a configuration has one id: runs that several tables share are
trained once, and repeating a sweep continues it. Each run is trained and evaluated in processes of its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import IO

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from srlrace.confdir import conf_dir
from srlrace.config import Config, ConfigError, run_id
from srlrace.console import clean, err, fail, out, say
from srlrace.hydra_bridge import compose
from srlrace.parse import nearest, show
from srlrace.report.experiments import Experiment, load_experiment
from srlrace.runs import RunFolder, State
from srlrace.signals import handling

PROGRAM = (sys.executable, "-m", "srlrace")
POLL = 0.2  # s between looks at the processes
LOG_TAIL = 4096  # bytes of a failed process's output that are searched for its last line


@dataclass(frozen=True)
class Plan:
    """What a sweep adds to the experiment files."""

    root: Path
    seeds: int | None = None
    steps: int | None = None
    record: str = "10"


@dataclass
class Job:
    """One run: how it is trained, and on which suites it is to fly how many episodes."""

    config: Config
    folder: RunFolder
    overrides: tuple[str, ...]
    suites: dict[str, int] = field(default_factory=dict)

    @property
    def untrained(self) -> bool:
        """Whether training is still to be done."""
        return self.folder.state is not State.FINISHED

    @property
    def missing(self) -> list[str]:
        """The suites without an evaluation of enough episodes."""
        done = self.folder.evaluations
        return [suite for suite, episodes in self.suites.items() if not _covers(done.get(suite), episodes)]

    @property
    def fraction(self) -> float:
        """How much of the training is done."""
        return min(1.0, self.folder.progress.get("steps", 0.0) / self.config.algo.total_steps)

    def next_command(self, plan: Plan) -> list[str] | None:
        """The arguments of ``srlrace`` that bring this run further; None when it is complete."""
        if self.untrained:
            return ["train", *self.overrides, "--runs", str(plan.root)]
        if not self.missing:
            return None
        suite = self.missing[0]
        options = ["--episodes", str(self.suites[suite]), "--suite", suite, "--record", plan.record]
        return ["eval", self.folder.id, *options, "--runs", str(plan.root)]


def _covers(summary: dict[str, object] | None, episodes: int) -> bool:
    flown = (summary or {}).get("episodes")
    return isinstance(flown, int) and flown >= episodes


def experiments(names: Sequence[str]) -> list[Experiment]:
    """The experiments with these names, ``paper`` being the paper's tables; raises `ConfigError`."""
    files = {path.stem: path for path in sorted((conf_dir() / "experiment").glob("*.yaml"))}
    for name in names:
        if name not in (*files, "paper"):
            takes = ", ".join((*files, "paper"))
            raise ConfigError(f"experiment: got {show(name)}; takes {takes}{nearest(name, (*files, 'paper'))}")
    loaded = [load_experiment(path) for path in files.values()]
    return [one for one in loaded if one.name in names or ("paper" in names and one.paper_table)]


def plan_jobs(chosen: Sequence[Experiment], plan: Plan) -> list[Job]:
    """One job for each different run of the experiments, first seeds first."""
    jobs: dict[str, Job] = {}
    steps = [f"algo.total_steps={plan.steps}"] if plan.steps else []
    for experiment in chosen:
        for row in experiment.rows:
            words = (*_without(row.overrides, steps), *steps)
            drawn = compose(words)
            for seed in range(plan.seeds or experiment.seeds):
                config = replace(drawn, seed=seed)
                folder = RunFolder(plan.root / run_id(config))
                job = jobs.setdefault(folder.id, Job(config, folder, (*words, f"seed={seed}")))
                for suite in experiment.suites:
                    job.suites[suite] = max(experiment.episodes, job.suites.get(suite, 0))
    return sorted(jobs.values(), key=lambda job: job.config.seed)


def _without(overrides: Sequence[str], replaced: Sequence[str]) -> list[str]:
    keys = {word.partition("=")[0] for word in replaced}
    return [word for word in overrides if word.partition("=")[0] not in keys]


def sweep_experiments(names: Sequence[str], plan: Plan, jobs: int, dry_run: bool) -> int:
    """Do what is missing of the experiments; returns the exit status."""
    todo = [job for job in plan_jobs(experiments(names), plan) if job.untrained or job.missing]
    if dry_run:
        for job in todo:
            train = f"train {' '.join(job.overrides)}; " if job.untrained else ""
            out.print(clean(f"{job.folder.id}: {train}evaluate {', '.join(job.missing)}"), markup=False, soft_wrap=True)
        say(f"{len(todo)} runs to train or evaluate")
        return 0
    status = Crew(plan, todo, jobs).work() if todo else 0
    if not status:
        from srlrace.report.command import report

        report(plan.root)
    return status


@dataclass
class Worker:
    """A process at work for a job, and what it says."""

    job: Job
    process: subprocess.Popen[bytes]
    log: IO[bytes]

    def last_words(self) -> str:
        """The last line of the process's output."""
        self.log.seek(max(0, self.log.seek(0, 2) - LOG_TAIL))
        lines = self.log.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


class Crew:
    """So many processes side by side until every job is complete, has failed, or a signal says stop."""

    def __init__(self, plan: Plan, jobs: Sequence[Job], size: int) -> None:
        self.plan, self.size, self.total = plan, size, len(jobs)
        self.waiting = deque(jobs)
        self.working: list[Worker] = []
        self.failed: list[str] = []
        self.signum: int | None = None

    def work(self) -> int:
        """Run all jobs; returns 0, 1 when one failed, 128 + signal when stopped."""
        with self._listening(), self._display() as display:
            while self.working or (self.waiting and self.signum is None):
                while self.signum is None and self.waiting and len(self.working) < self.size:
                    self._advance(self.waiting.popleft())
                time.sleep(POLL)
                for worker in [worker for worker in self.working if worker.process.poll() is not None]:
                    self._collect(worker)
                self._show(display)
        if self.signum is not None:
            say("stopped; the same command continues")
            return 128 + self.signum
        return int(bool(self.failed))

    def _advance(self, job: Job) -> None:
        command = job.next_command(self.plan)
        if command is None:
            say(f"{job.folder.id}: complete")
            return
        say(f"{job.folder.id}: {'training' if command[0] == 'train' else 'evaluating ' + job.missing[0]}")
        log = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the process has ended
        # A session of its own: Ctrl-C reaches the process once, from here, and not from the terminal as well.
        process = subprocess.Popen([*PROGRAM, *command], stdin=subprocess.DEVNULL,
                                   stdout=log, stderr=log, start_new_session=True)  # fmt: skip
        self.working.append(Worker(job, process, log))

    def _collect(self, worker: Worker) -> None:
        self.working.remove(worker)
        status = worker.process.returncode
        if status and self.signum is None:
            self.failed.append(worker.job.folder.id)
            fail(f"{worker.job.folder.id}: {clean(worker.last_words()).removeprefix('error: ')}")
        elif self.signum is None:
            self._advance(worker.job)
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

    def _display(self) -> Progress:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
                   TimeRemainingColumn())  # fmt: skip
        return Progress(*columns, console=err, transient=True, disable=not err.is_terminal)

    def _show(self, display: Progress) -> None:
        if not err.is_terminal:
            return
        rows = {worker.job.folder.id: worker.job.fraction for worker in self.working}
        done = self.total - len(self.waiting) - len(self.working)
        rows = {f"{done} of {self.total} runs": (done + sum(rows.values())) / self.total} | rows
        for task in display.tasks:
            if task.description not in rows:
                display.remove_task(task.id)
        for name, fraction in rows.items():
            found = next((task.id for task in display.tasks if task.description == name), None)
            display.update(display.add_task(name, total=1.0) if found is None else found, completed=fraction)
