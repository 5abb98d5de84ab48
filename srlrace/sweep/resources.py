"""What a job asks a scheduler for."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from srlrace.checks import memory_estimate
from srlrace.config import ConfigError
from srlrace.parse import show
from srlrace.sweep.pace import Pace
from srlrace.sweep.plan import Job

BASE_GB = 1.5  # GB of a training with the default settings (0.6 resident, measured), kernels being compiled included
SLACK = 3.0  # ours: a node may be this much slower than what the expectation comes from
SHORTEST = 30  # min: compiling the kernels on a slow node, an evaluation with recordings
TIME = re.compile(r"(?:(\d{1,3})-)?(\d{1,6})(?::([0-5]?\d))?(?::([0-5]?\d))?")
EXTRA = re.compile(r"[a-z][a-z-]*(=[\w.,:/@%+-]+)?")


@dataclass(frozen=True)
class Resources:
    """Of one job: what the user asked for; None is for `fill` to decide."""

    cores: int | None = None
    memory_gb: float | None = None
    minutes: int | None = None
    partition: str | None = None
    extra: Mapping[str, str] = field(default_factory=dict)  # other options of sbatch, by long name

    def fill(self, jobs: Sequence[Job], pace: Pace) -> Resources:
        """The same with nothing left open, enough for each of the jobs."""
        estimates = [sum(memory_estimate(job.config).values()) for job in jobs]
        needed = math.ceil(BASE_GB + max(estimates, default=0) / 1e9)
        longest = max((pace.left(job) for job in jobs), default=0.0)
        return Resources(
            cores=self.cores or max((job.config.algo.threads for job in jobs), default=1),
            memory_gb=self.memory_gb or needed,
            minutes=self.minutes or max(SHORTEST, 10 * math.ceil(SLACK * longest / 600)),
            partition=self.partition,
            extra=self.extra,
        )


def read_minutes(text: str | None) -> int | None:
    """Minutes from a time as Slurm writes it, rounded up; raises `ConfigError`."""
    if text is None:
        return None
    match = TIME.fullmatch(text)
    if match is None:
        raise ConfigError(f"--time: got {show(text)}; takes minutes, hours:minutes:seconds or days-hours")
    days, first, second, third = (int(part) if part else 0 for part in match.groups())
    if match[1]:
        seconds = days * 86400 + first * 3600 + second * 60 + third
    else:
        seconds = first * 3600 + second * 60 + third if match[4] else first * 60 + second
    if not seconds:
        raise ConfigError(f"--time: got {show(text)}; takes more than nothing")
    return math.ceil(seconds / 60)


def read_extra(words: Sequence[str]) -> dict[str, str]:
    """Other options of sbatch, ``account=lab``; raises `ConfigError`."""
    for word in words:
        if not EXTRA.fullmatch(word):
            raise ConfigError(f"--slurm: got {show(word)}; takes a long option of sbatch, as in account=lab")
    return {name: value or "" for name, _, value in (word.partition("=") for word in words)}
