"""Which runs stand for a cell: one algorithm and budget, one run per training seed, never a mixture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from srlrace.report.collect import Evaluation, Run
from srlrace.runs import State
from srlrace.schema import AlgoConfig


@dataclass(frozen=True, eq=False)
class Group:
    """Evaluated runs of one preset that differ in the seed only."""

    algo: AlgoConfig
    suite: str
    runs: dict[int, Run]  # by training seed

    @property
    def evaluations(self) -> list[tuple[int, Evaluation]]:
        """(training seed, evaluation) pairs in the order of seeds."""
        return [(seed, self.runs[seed].evaluations[self.suite]) for seed in sorted(self.runs)]

    @property
    def rank(self) -> tuple[int, int, float]:
        """The better group: more seeds, then the larger budget, then the newer evaluation."""
        return len(self.runs), self.algo.total_steps, max(evaluation.newest for _, evaluation in self.evaluations)


def groups(runs: Sequence[Run], preset: tuple[object, ...], suite: str) -> list[Group]:
    """Return the groups of finished runs that fit a cell, best first."""
    by_algo: dict[AlgoConfig, dict[int, Run]] = {}
    for run in runs:
        if run.state is State.FINISHED and suite in run.evaluations and run.preset == preset:
            seeds = by_algo.setdefault(run.algo, {})
            seeds[run.config.seed] = _preferred(seeds.get(run.config.seed), run, suite)
    found = [Group(algo, suite, seeds) for algo, seeds in by_algo.items()]
    return sorted(found, key=lambda group: group.rank, reverse=True)


def common_group(first: Sequence[Group], second: Sequence[Group]) -> tuple[Group, Group] | None:
    """Return the two sides' groups of the same algorithm with the most seeds in common, if any."""
    sides = [(a, b) for a in first for b in second if a.algo == b.algo and a.runs.keys() & b.runs.keys()]
    return max(sides, key=lambda pair: (len(pair[0].runs.keys() & pair[1].runs.keys()), pair[0].rank), default=None)


def _preferred(held: Run | None, run: Run, suite: str) -> Run:
    """Of two runs that differ in their label only, take the one without a label, then the newer evaluation."""
    if held is None:
        return run
    return max((held, run), key=lambda each: (not each.config.name, each.evaluations[suite].newest))
