"""What a sweep has to do: one job for each different run of the experiment files.

A cell of a table means a configuration, and a configuration has one id: runs that several tables share are
trained once, whatever starts them and wherever.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from srlrace.confdir import conf_dir
from srlrace.config import Config, ConfigError, run_id
from srlrace.hydra_bridge import compose
from srlrace.parse import nearest, show
from srlrace.report.experiments import Experiment, load_experiment
from srlrace.runs import RunFolder, State


@dataclass(frozen=True)
class Plan:
    """What a sweep adds to the experiment files."""

    root: Path
    seeds: int | None = None
    steps: int | None = None
    cores: int | None = None  # of one run; torch gets as many threads, which its results depend on
    record: str = "10"

    @property
    def overrides(self) -> list[str]:
        """The settings that every run of the sweep gets."""
        settings = {"algo.total_steps": self.steps, "algo.threads": self.cores}
        return [f"{name}={value}" for name, value in settings.items() if value]


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
    def complete(self) -> bool:
        """Whether nothing is left to do."""
        return not (self.untrained or self.missing)

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
    for experiment in chosen:
        for row in experiment.rows:
            words = (*_without(row.overrides, plan.overrides), *plan.overrides)
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
