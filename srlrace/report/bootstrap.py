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

    def replicates(self, weights: Array) -> Array:
        """Return the ratio under each row of weights (draws, clusters); one with an empty denominator is the value."""
        top, bottom = weights @ self.numerator, weights @ self.denominator
        return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), self.value)


def mean(values: Array) -> Array:
    """Return the mean along the last axis."""
    return np.asarray(values.mean(axis=-1))


def hierarchical_interval(runs: Sequence[ClusteredRatio], centre: Centre = mean) -> Interval:
    """Return the percentile interval of ``centre`` over seeds; with one seed, over its clusters only."""
    return _percentiles(centre(_pick_seeds(_replicates(runs))))


def paired_interval(pairs: Sequence[tuple[ClusteredRatio, ClusteredRatio]]) -> Interval:
    """Return the percentile interval of the mean difference, first minus second, over common seeds."""
    first = _replicates([a for a, _ in pairs])
    second = _replicates([b for _, b in pairs])
    return _percentiles(mean(_pick_seeds(first - second)))


def _replicates(runs: Sequence[ClusteredRatio]) -> Array:
    """Return (draws, seeds) ratios over resampled clusters."""
    weights = [_resampling_weights(len(run.numerator), _stream(run, runs)) for run in runs]
    return np.stack([run.replicates(drawn) for run, drawn in zip(runs, weights, strict=True)], axis=1)


def _stream(run: ClusteredRatio, runs: Sequence[ClusteredRatio]) -> int:
    """Number the distinct sets of clusters: runs that flew the same ones share their draws."""
    distinct = list(dict.fromkeys(other.flown for other in runs))
    return distinct.index(run.flown)


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
