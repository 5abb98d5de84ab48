"""From the evaluations of one cell, one per training seed, to its numbers and intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from srlrace.report.bootstrap import (
    Array,
    ClusteredRatio,
    hierarchical_interval,
    mean,
    paired_interval,
    single_intervals,
)
from srlrace.report.collect import Evaluation
from srlrace.report.model import Estimate, Numbers
from srlrace.report.stats import Interval, clopper_pearson, iqm, wilson

BATCH = 256  # evaluations that are resampled at once
IQM_SEEDS = 4  # with fewer values the interquartile mean is the mean

Quantity = Callable[[Evaluation], ClusteredRatio | None]


def crash_ratio(evaluation: Evaluation) -> ClusteredRatio:
    """Return crashes over episodes."""
    return _clustered(evaluation, evaluation.crashed, np.ones(len(evaluation.crashed)))


def flight_time(evaluation: Evaluation) -> ClusteredRatio | None:
    """Return total time over finished flights [s]; None if none finished."""
    if not evaluation.finished.any():
        return None
    return _clustered(evaluation, np.where(evaluation.finished, evaluation.time_s, 0.0), evaluation.finished)


def penalised_time(evaluation: Evaluation) -> float:
    """Return the mean time over all flights [s], a failure counting as the horizon."""
    return float(np.where(evaluation.finished, evaluation.time_s, evaluation.horizon_s).mean())


def cell_numbers(evaluations: Sequence[tuple[int, Evaluation]]) -> Numbers:
    """Return the numbers of a cell from (training seed, evaluation) pairs, at least one, one per seed."""
    times = [time for _, evaluation in evaluations if (time := flight_time(evaluation)) is not None]
    return _numbers(evaluations, times, _estimate(times, mean) if times else None)


def single_numbers(evaluations: Sequence[tuple[int, Evaluation]]) -> list[Numbers]:
    """Return what `cell_numbers` says of each pair alone, in a thirtieth of the time where there are thousands."""
    numbers = []
    for start in range(0, len(evaluations), BATCH):
        batch = evaluations[start : start + BATCH]
        times = [flight_time(evaluation) for _, evaluation in batch]
        known = [time for time in times if time is not None]
        estimates = iter([_scaled(*each, 1.0) for each in zip(_values(known), single_intervals(known), strict=True)])
        for pair, time in zip(batch, times, strict=True):
            numbers.append(_numbers([pair], [time], next(estimates)) if time else _numbers([pair], [], None))
    return numbers


def _numbers(
    evaluations: Sequence[tuple[int, Evaluation]], times: Sequence[ClusteredRatio], time_s: Estimate | None
) -> Numbers:
    flown = [evaluation for _, evaluation in evaluations]
    crashes = [crash_ratio(evaluation) for evaluation in flown]
    return Numbers(
        time_s=time_s,
        time_iqm_s=_estimate(times, iqm) if len(times) >= IQM_SEEDS else None,
        crash_pct=_crash_estimate(crashes, mean),
        crash_iqm_pct=_crash_estimate(crashes, iqm) if len(crashes) >= IQM_SEEDS else None,
        penalised_time_s=float(np.mean([penalised_time(evaluation) for evaluation in flown])),
        finished=sum(int(evaluation.finished.sum()) for evaluation in flown),
        crashed=sum(int(evaluation.crashed.sum()) for evaluation in flown),
        episodes=sum(len(evaluation.episode) for evaluation in flown),
        seeds=tuple(sorted(seed for seed, _ in evaluations)),
    )


def paired_difference(pairs: Sequence[tuple[Evaluation, Evaluation]], quantity: str) -> tuple[int, Estimate] | None:
    """Return how many seeds have the quantity on both sides, and the mean difference, in s or percentage points."""
    measure: Quantity = flight_time if quantity == "time" else crash_ratio
    scale = 1.0 if quantity == "time" else 100.0
    measured = [(measure(a), measure(b)) for a, b in pairs]
    both = [(a, b) for a, b in measured if a is not None and b is not None]
    if not both:
        return None
    value = float(np.mean([a.value - b.value for a, b in both]))
    return len(both), _scaled(value, paired_interval(both), scale)


def _estimate(ratios: Sequence[ClusteredRatio], centre: Callable[[Array], Array], scale: float = 1.0) -> Estimate:
    value = float(centre(np.array(_values(ratios))))
    return _scaled(value, hierarchical_interval(ratios, centre), scale)


def _values(ratios: Sequence[ClusteredRatio]) -> list[float]:
    return [ratio.value for ratio in ratios]


def _crash_estimate(ratios: Sequence[ClusteredRatio], centre: Callable[[Array], Array]) -> Estimate:
    """Return the crash ratio in %; where the bootstrap sees no variation, an interval on one run's counts instead."""
    values = {ratio.value for ratio in ratios}
    if values <= {0.0} or values <= {1.0}:
        # Resampling zeros gives zeros. One run's clusters bound the ratio; pooling the seeds would claim too much.
        trials = min(len(ratio.numerator) for ratio in ratios)
        value = values.pop()
        return _scaled(value, clopper_pearson(round(value * trials), trials), 100.0)
    if len(ratios) == 1 and (ratios[0].denominator == 1).all():
        crashes = ratios[0].numerator
        return _scaled(ratios[0].value, wilson(int(crashes.sum()), len(crashes)), 100.0)
    return _estimate(ratios, centre, 100.0)


def _scaled(value: float, interval: Interval, scale: float) -> Estimate:
    return Estimate(scale * value, scale * interval.low, scale * interval.high)


def _clustered(evaluation: Evaluation, top: np.ndarray, bottom: np.ndarray) -> ClusteredRatio:
    """Sum by map where several were flown, since flights on one map resemble each other; else by episode."""
    maps, index = np.unique(evaluation.map_seed, return_inverse=True)
    if len(maps) == 1:
        maps, index = np.unique(evaluation.episode, return_inverse=True)
    return ClusteredRatio(
        numerator=np.bincount(index, weights=top).astype(np.float64),
        denominator=np.bincount(index, weights=bottom).astype(np.float64),
        flown=(evaluation.seed, *maps.tolist()),
    )
