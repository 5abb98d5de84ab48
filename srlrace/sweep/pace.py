"""How long a sweep will take, from the runs that are finished already, or from published ones."""

from __future__ import annotations

import json
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from srlrace.config import ConfigError, to_dict
from srlrace.files import FileError
from srlrace.runs import RunError, list_runs
from srlrace.sweep.plan import Job

STEPS_PER_S = 100_000.0  # ours, cautious: the published runs have 140,000 in the median, two at a time on two cores
EPISODES_PER_S = 100.0  # ours: evaluation with a few recordings on such a core
START_UP = 5.0  # s until a process has imported torch and loaded the kernels
LOOKED_AT = 500  # runs that are read for their speed, at most
PUBLISHED = "reference"  # folder among the runs, with those that came with the repository


@dataclass(frozen=True)
class Pace:
    """Training steps per second, as finished runs say, by what they depend on; the widest kind has the key ""."""

    rates: dict[str, float]
    known: int  # finished runs behind it
    published: int = 0  # published runs behind it; they count where none of these is alike

    def training(self, job: Job) -> float:
        """Seconds that the whole training of a job takes."""
        settings = to_dict(job.config)
        rates = (self.rates.get(key) for key in _kinds(settings))
        return job.config.algo.total_steps / next((rate for rate in rates if rate), STEPS_PER_S) + START_UP

    def left(self, job: Job) -> float:
        """Seconds that a job still takes."""
        flights = sum(job.suites[suite] / EPISODES_PER_S + START_UP for suite in job.missing)
        return flights + (self.training(job) * (1 - job.fraction) if job.untrained else 0.0)

    @property
    def source(self) -> str:
        """Where the figures come from, in words."""
        sources = []
        if self.known:
            sources.append(f"{self.known} finished run{'s' if self.known > 1 else ''}")
        if self.published:
            sources.append(f"{self.published} published run{'s' if self.published > 1 else ''}, of another machine")
        return f"from {' and '.join(sources)}" if sources else f"assuming {STEPS_PER_S:,.0f} steps a second"


def _kinds(settings: dict[str, Any]) -> tuple[str, ...]:
    """Keys of runs as fast as one with these settings, from the narrowest to the widest."""
    algo = {name: value for name, value in settings["algo"].items() if name != "total_steps"}
    parts = [algo, settings["env"].get("name"), settings["level"].get("name"), settings["observation"].get("blocks")]
    return json.dumps(parts), json.dumps(algo), ""


def read_pace(root: Path) -> Pace:
    """Read how fast the finished runs below ``root``, and the published ones there, were trained."""
    own, known = _read_rates(root)
    others, published = _read_rates(root / PUBLISHED)
    return Pace(others | own, known, published)


def _read_rates(root: Path) -> tuple[dict[str, float], int]:
    """Return steps per second by kind, and the number of runs behind it; what cannot be read is passed over."""
    found: dict[str, list[float]] = defaultdict(list)
    known = 0
    for run in list_runs(root)[:LOOKED_AT]:
        info = run.info
        steps, wall = info.get("steps"), info.get("train_wall_s")
        if not (isinstance(steps, int) and isinstance(wall, int | float) and wall > 0):
            continue
        try:
            config = run.load_config()
        except (FileError, ConfigError, RunError):
            continue
        known += 1
        for kind in _kinds(to_dict(config)):
            found[kind].append(steps / wall)
    return {kind: statistics.median(rates) for kind, rates in found.items()}, known


def together(seconds: Sequence[float], size: int) -> float:
    """Seconds that jobs take ``size`` side by side, at the least."""
    return max(sum(seconds) / size, *seconds) if seconds else 0.0


def roughly(seconds: float) -> str:
    """A time to be expected, in words."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return "less than a minute"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
