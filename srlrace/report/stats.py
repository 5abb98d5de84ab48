"""Intervals on counts, the interquartile mean and Fisher's test: closed forms where there are any."""

from __future__ import annotations

from math import comb, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

CONFIDENCE = 0.95  # two-sided level of every interval in the report
FISHER_TIE = 1e-7  # relative slack within which two tables count as equally likely, as in R and scipy


class Interval(NamedTuple):
    """A two-sided interval; both ends carry the unit of the quantity."""

    low: float
    high: float


def wilson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return Wilson's score interval of a proportion.

    Source: Wilson 1927, without continuity correction. Raises ValueError unless 0 <= successes <= trials, trials > 0.
    """
    _check_counts(successes, trials)
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p, weight = successes / trials, z * z / trials
    centre = (p + weight / 2) / (1 + weight)
    half = z * sqrt(p * (1 - p) / trials + weight / (4 * trials)) / (1 + weight)
    # The ends are exactly 0 and 1 at 0 and n successes; rounding would leave 1e-17.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return Interval(low, high)


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return the exact (Clopper-Pearson) interval of a proportion; conservative, meant for 0 of n.

    Raises ValueError unless 0 <= successes <= trials and trials > 0.
    """
    _check_counts(successes, trials)
    from scipy.special import betaincinv  # here, so that importing the report stays quick

    tail = (1 - confidence) / 2
    low = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 1 - tail))
    return Interval(low, high)


def iqm(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the interquartile mean along the last axis: a quarter of the values, rounded down, cut at each end.

    Source: Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice"; five seeds keep the middle three.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=-1)
    count = ordered.shape[-1]
    cut = count // 4
    return np.asarray(ordered[..., cut : count - cut].mean(axis=-1))


def fisher_exact(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Return the two-sided p value of Fisher's exact test for two (successes, trials) counts."""
    for successes, trials in (first, second):
        _check_counts(successes, trials)
    total, trials = first[0] + second[0], first[1] + second[1]
    ways = [comb(first[1], k) * comb(second[1], total - k) for k in range(total + 1)]
    observed = ways[first[0]]
    # Integers have no rounding, but keep the common slack so that ties decide alike everywhere.
    likely = sum(way for way in ways if way <= observed * (1 + FISHER_TIE))
    return min(1.0, likely / comb(trials, total))


def _check_counts(successes: int, trials: int) -> None:
    if trials <= 0 or not 0 <= successes <= trials:
        raise ValueError(f"cannot give an interval to {successes} of {trials}")
