"""Hierarchical bootstrap of ratios over training seeds and evaluation clusters.

The training seed is the unit of replication. Every seed of a cell is evaluated on the same frozen initial conditions or
maps, so seeds and clusters are crossed: a replicate draws seeds, and one set of clusters that all the seeds share.
Drawing clusters apart for each seed would average their difficulty away and give intervals that are too narrow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from srlrace.report.stats import CONFIDENCE, Interval

Array = npt.NDArray[np.float64]
Centre = Callable[[Array], Array]  # (draws, seeds) -> (draws,)

DRAWS = 2000  # bootstrap replicates: the ends of a 95 % interval then move by about 1 % of its width
SEED = 20_240_321  # fixed: the same runs give the same report, digit by digit


@dataclass(frozen=True)
class ClusteredRatio:
    """A ratio of sums of one run, kept cluster by cluster, such as crashes over episodes on each map."""

    numerator: Array  # (clusters,)
    denominator: Array  # (clusters,) counts; at least one is positive
    flown: tuple[int, ...]  # what the clusters are; runs that flew the same are resampled together

    @property
    def value(self) -> float:
        """The ratio of the sums."""
        return float(self.numerator.sum() / self.denominator.sum())


def mean(values: Array) -> Array:
    """Return the mean along the last axis."""
    return np.asarray(values.mean(axis=-1))


def hierarchical_interval(runs: Sequence[ClusteredRatio], centre: Centre = mean) -> Interval:
    """Return the percentile interval of ``centre`` over seeds; with one seed, over its clusters only."""
    return _percentiles(centre(_pick_seeds(_replicates(runs))))


def single_intervals(runs: Sequence[ClusteredRatio]) -> list[Interval]:
    """Return what `hierarchical_interval` says of each run alone; runs that flew the same are resampled at once."""
    intervals: dict[int, Interval] = {}
    for flown in dict.fromkeys(run.flown for run in runs):
        same = [i for i, run in enumerate(runs) if run.flown == flown]
        replicates = _replicates([runs[i] for i in same])
        intervals |= {i: _percentiles(values) for i, values in zip(same, replicates.T, strict=True)}
    return [intervals[i] for i in range(len(runs))]


def paired_interval(pairs: Sequence[tuple[ClusteredRatio, ClusteredRatio]]) -> Interval:
    """Return the percentile interval of the mean difference, first minus second, over common seeds."""
    first = _replicates([a for a, _ in pairs])
    second = _replicates([b for _, b in pairs])
    return _percentiles(mean(_pick_seeds(first - second)))


def _replicates(runs: Sequence[ClusteredRatio]) -> Array:
    """Return (draws, seeds) ratios over resampled clusters; a draw without a denominator gives the run's value."""
    ratios = np.empty((DRAWS, len(runs)))
    # Runs that flew the same clusters share their draws, and are summed in one product: many small ones cost more.
    for stream, flown in enumerate(dict.fromkeys(run.flown for run in runs)):
        same = [i for i, run in enumerate(runs) if run.flown == flown]
        weights = _resampling_weights(len(runs[same[0]].numerator), stream)
        top = weights @ np.stack([runs[i].numerator for i in same], axis=1)
        bottom = weights @ np.stack([runs[i].denominator for i in same], axis=1)
        values = np.array([runs[i].value for i in same])
        ratios[:, same] = np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), values)
    return ratios


@lru_cache(maxsize=8)
def _resampling_weights(clusters: int, stream: int) -> Array:
    """Return (draws, clusters) counts of how often each cluster is drawn."""
    generator = np.random.default_rng((SEED, stream))
    drawn = generator.integers(clusters, size=(DRAWS, clusters)) + clusters * np.arange(DRAWS)[:, None]
    weights = np.bincount(drawn.ravel(), minlength=DRAWS * clusters).reshape(DRAWS, clusters).astype(np.float64)
    weights.flags.writeable = False
    return weights


def _pick_seeds(values: Array) -> Array:
    """Resample the columns of (draws, seeds), anew in every row."""
    seeds = values.shape[1]
    picked = np.random.default_rng((SEED, 1_000_000)).integers(seeds, size=(DRAWS, seeds))
    return np.take_along_axis(values, picked, axis=1)


def _percentiles(values: Array) -> Interval:
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(values, (tail, 100 - tail))
    return Interval(float(low), float(high))
