"""Intervals and tests against scipy's values, textbook values and their own definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats as scipy_stats

from srlrace.report.stats import clopper_pearson, fisher_exact, iqm, wilson

COUNTS = [(0, 51), (1, 51), (17, 51), (46, 51), (51, 51), (0, 1000), (3, 1000), (999, 1000), (1, 1), (0, 1)]


@pytest.mark.parametrize(("successes", "trials"), COUNTS)
def test_wilson_agrees_with_scipy(successes: int, trials: int) -> None:
    expected = scipy_stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert wilson(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize(("successes", "trials"), COUNTS)
def test_clopper_pearson_agrees_with_scipy(successes: int, trials: int) -> None:
    expected = scipy_stats.binomtest(successes, trials).proportion_ci(method="exact")
    assert clopper_pearson(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_no_crash_in_51_flights_allows_seven_percent() -> None:
    assert wilson(0, 51).high == pytest.approx(0.0700, abs=5e-4)
    assert clopper_pearson(0, 51).high == pytest.approx(1 - 0.025 ** (1 / 51))


@pytest.mark.parametrize("counts", [(-1, 5), (6, 5), (0, 0)])
def test_impossible_counts_are_refused(counts: tuple[int, int]) -> None:
    for interval in (wilson, clopper_pearson):
        with pytest.raises(ValueError, match="interval"):
            interval(*counts)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 13])
def test_iqm_agrees_with_scipys_trimmed_mean(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(4, count))
    np.testing.assert_allclose(iqm(values), scipy_stats.trim_mean(values, 0.25, axis=1))


def test_iqm_of_five_seeds_ignores_the_best_and_the_worst() -> None:
    assert iqm([100.0, 1.0, 2.0, 3.0, -50.0]) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("first", "second"), [((1, 51), (0, 51)), ((17, 51), (46, 51)), ((3, 1000), (15, 1000)), ((0, 5), (5, 5))]
)
def test_fisher_agrees_with_scipy(first: tuple[int, int], second: tuple[int, int]) -> None:
    table = [[first[0], first[1] - first[0]], [second[0], second[1] - second[0]]]
    assert fisher_exact(first, second) == pytest.approx(scipy_stats.fisher_exact(table).pvalue)


def test_the_papers_one_crash_in_51_is_no_evidence() -> None:
    assert fisher_exact((1, 51), (0, 51)) == 1.0


def test_the_papers_three_ratios_fit_multiples_of_51_and_nothing_else() -> None:
    ratios = (1.96, 33.33, 90.20)

    def fits(trials: int) -> bool:
        return all(any(round(100 * k / trials, 2) == ratio for k in range(trials + 1)) for ratio in ratios)

    assert [n for n in range(1, 210) if fits(n)] == [51, 102, 153, 204]
    assert not fits(1000)
