"""The hierarchical bootstrap: degenerate cases, pairing, crossed clusters, and coverage in simulations."""

from __future__ import annotations

import numpy as np
import pytest

from srlrace.report.bootstrap import ClusteredRatio, hierarchical_interval, mean, paired_interval, single_intervals
from srlrace.report.stats import iqm


def ratios(values: np.ndarray, flown: int = 0) -> list[ClusteredRatio]:
    """One run per row of (seeds, clusters), one trial per cluster."""
    return [ClusteredRatio(row, np.ones(len(row)), (flown,)) for row in values.astype(float)]


def test_equal_values_have_no_width() -> None:
    assert hierarchical_interval(ratios(np.full((5, 20), 7.0))) == pytest.approx((7.0, 7.0))


def test_the_same_data_give_the_same_interval_to_the_last_bit() -> None:
    values = np.random.default_rng(1).normal(size=(5, 30))
    assert hierarchical_interval(ratios(values)) == hierarchical_interval(ratios(values))


def test_one_seed_gives_the_interval_of_its_mean() -> None:
    values = np.random.default_rng(2).normal(5.0, 1.0, size=(1, 400))
    low, high = hierarchical_interval(ratios(values))
    half = 1.96 * values.std() / np.sqrt(400)
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.15 * half)


def test_a_ratio_weighs_clusters_by_their_denominator() -> None:
    run = ClusteredRatio(np.array([30.0, 0.0]), np.array([3.0, 1.0]), (0,))
    assert run.value == pytest.approx(7.5)


def test_runs_that_are_resampled_at_once_are_told_apart() -> None:
    values = np.random.default_rng(5).normal(5.0, 1.0, size=(6, 40))
    runs = ratios(values[:3]) + ratios(values[3:5], flown=1) + ratios(values[5:, :20], flown=2)
    alone = [hierarchical_interval([run]) for run in runs]
    assert np.allclose(single_intervals(runs), alone, rtol=1e-12)
    assert len({interval.low for interval in alone}) == 6
    assert single_intervals([]) == []


def test_replicates_without_a_denominator_fall_back_to_the_value() -> None:
    run = ClusteredRatio(np.array([4.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), (0,))
    assert hierarchical_interval([run]) == pytest.approx((4.0, 4.0))


def test_pairing_removes_what_both_sides_share() -> None:
    generator = np.random.default_rng(3)
    base = generator.normal(0.0, 10.0, size=(5, 1)) + generator.normal(0.0, 3.0, size=(1, 50))
    other = base - 1.0 + generator.normal(0.0, 0.01, size=(5, 50))
    low, high = paired_interval(list(zip(ratios(base), ratios(other), strict=True)))
    assert 0.99 < low < 1.0 < high < 1.01


def test_maps_shared_by_the_seeds_do_not_average_out() -> None:
    """All the variance sits in the maps: five seeds on the same maps know no more than one."""
    maps = np.random.default_rng(4).normal(0.0, 1.0, size=(1, 100))
    shared = hierarchical_interval(ratios(np.repeat(maps, 5, axis=0)))
    apart = hierarchical_interval([ratios(maps, flown=seed)[0] for seed in range(5)])
    one = hierarchical_interval(ratios(maps))
    assert shared == pytest.approx(one)
    assert apart.high - apart.low < 0.75 * (one.high - one.low)


def test_the_iqm_shrugs_off_a_failed_seed() -> None:
    values = np.concatenate([np.full((4, 10), 5.0), np.full((1, 10), 20.0)])
    assert hierarchical_interval(ratios(values), centre=mean).high > 8.0
    assert hierarchical_interval(ratios(values), centre=iqm).low == pytest.approx(5.0)


@pytest.mark.parametrize(("seeds", "least"), [(20, 0.90), (5, 0.78)])
def test_coverage_of_nested_normal_data(seeds: int, least: float) -> None:
    """Percentile intervals over few seeds are known to be narrow: 20 seeds near 95 %, 5 seeds near 83-90 %."""
    generator = np.random.default_rng(5)
    trials, hits = 200, 0
    for _ in range(trials):
        values = generator.normal(0.0, 1.0, size=(seeds, 1)) + generator.normal(0.0, 1.0, size=(seeds, 25))
        low, high = hierarchical_interval(ratios(values))
        hits += low <= 0.0 <= high
    assert least <= hits / trials <= 0.99
