"""The sentences under a table: what its numbers rest on and what they cannot bear."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict

from srlrace.report.experiments import Experiment, Paper
from srlrace.report.groups import Group
from srlrace.report.stats import fisher_exact, wilson
from srlrace.schema import AlgoConfig


def cell_notes(experiment: Experiment, candidates: Sequence[Group], group: Group) -> tuple[str, ...]:
    """Return what a reader of one cell must know: a lone seed, a short evaluation, runs left out."""
    notes = []
    if len(group.runs) == 1:
        notes.append("one seed: the interval is within-run only and says nothing about another training")
    counts = {len(evaluation.episode) for _, evaluation in group.evaluations}
    if min(counts) < experiment.episodes:
        notes.append(f"a run was evaluated on {min(counts)} episodes only, not {experiment.episodes}")
    others = [other for other in candidates if other.algo != group.algo]
    if others:
        names = budgets([group.algo, *(other.algo for other in others)])
        left_out = "; ".join(f"{names[other.algo]} ({_seeds(len(other.runs))})" for other in others)
        notes.append(f"from the runs with {names[group.algo]}; not mixed with those of {left_out}")
    return tuple(notes)


def table_notes(experiment: Experiment, paper: Paper, chosen: Iterable[Group | None]) -> tuple[str, ...]:
    """Return what holds for a whole table: the experiment's own notes, the budgets, the paper's sample size."""
    return (*experiment.notes, *_budget_notes(chosen), *_paper_notes(experiment, paper))


def budgets(algos: Iterable[AlgoConfig]) -> dict[AlgoConfig, str]:
    """Describe each algorithm and budget in words that tell them apart."""
    settings = {algo: asdict(algo) for algo in algos}
    shown = ("name", "total_steps", "n_envs")
    keys = next(iter(settings.values()), {}).keys() - set(shown)
    differing = sorted(key for key in keys if len({str(values[key]) for values in settings.values()}) > 1)
    return {
        algo: f"{algo.name}, {algo.total_steps / 1e6:g} M steps, {algo.n_envs} drones"
        + "".join(f", {key}={values[key]}" for key in differing)
        for algo, values in settings.items()
    }


def _budget_notes(chosen: Iterable[Group | None]) -> list[str]:
    names = sorted(budgets(group.algo for group in chosen if group).values())
    if len(names) > 1:
        return [f"The cells differ in algorithm or budget, so they compare more than methods: {'; '.join(names)}."]
    return [f"Trained with {name}." for name in names]


def _paper_notes(experiment: Experiment, paper: Paper) -> list[str]:
    if not experiment.paper_table or "crash" not in experiment.columns:
        return []
    n = paper.episodes
    notes = [
        f"The paper's crash ratios fit only multiples of {n} flights; "
        f"0 of {n} has a 95 % interval of 0 to {100 * wilson(0, n).high:.0f} %."
    ]
    if experiment.paired == "crash":
        p = fisher_exact((1, n), (0, n))
        notes.append(f"The paper's 1 of {n} against 0 of {n} is no evidence of a difference (Fisher p = {p:g}).")
    return notes


def _seeds(count: int) -> str:
    return "1 seed" if count == 1 else f"{count} seeds"
