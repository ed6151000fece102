"""Tests of `mapfusion.verification.likelihood`."""

import numpy as np
import pytest
from scipy.stats import beta, betabinom

from mapfusion.verification.fitted_twins import WHOLE
from mapfusion.verification.likelihood import (
    CHANGED,
    RIGHT,
    WRONG,
    BetaRate,
    TwinShares,
    log10_against_chance,
    log10_ratio,
    log10_without_discovery,
    rates_in_part,
    rates_of_maps,
)


def must_own(k: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return regions (R, 2, 2) of landmarks that must be seen, without copies."""
    regions = np.zeros((2, len(k), 2, 2), np.int64)
    regions[:, :, 0, 0] = k, n
    return regions[0], regions[1]


def pmf(k: np.ndarray, n: np.ndarray, rates) -> np.ndarray:
    """Return the likelihoods of both parts (R, 2), each a product over both classes."""
    return np.prod([betabinom.pmf(k[..., c], n[..., c], *rates[c]) for c in (0, 1)], axis=0)


@pytest.mark.parametrize("shares", [TwinShares(0.01, 0.4), TwinShares(0.3, 0.3)])
def test_it_is_the_ratio_of_the_two_mixtures(shares: TwinShares) -> None:
    rng = np.random.default_rng(0)
    n = rng.integers(0, 12, (300, 2, 2))
    k = rng.binomial(n, rng.random((300, 1, 1)))
    right, part, chance = pmf(k, n, RIGHT), pmf(k, n, rates_in_part(RIGHT)), pmf(k, n, WRONG)
    twins = WHOLE * right[:, 1] + (1 - WHOLE) * part[:, 1]
    copies = shares.copied * twins + (1 - shares.copied) * chance[:, 1]
    throughout = WHOLE * right.prod(axis=1) + (1 - WHOLE) * part.prod(axis=1)
    wrong = shares.own * throughout + (1 - shares.own) * chance[:, 0] * copies
    expected = ((1 - CHANGED) * right[:, 0] * right[:, 1] + CHANGED * wrong) / wrong
    np.testing.assert_allclose(log10_ratio(k, n, shares), np.log10(expected), rtol=1e-9)
    against = np.log10(right / chance)
    np.testing.assert_allclose(log10_against_chance(k, n), against, rtol=1e-9)


def test_a_region_weighs_no_more_than_twins_and_changes_allow() -> None:
    n = np.full(1001, 1000)
    ratios = log10_ratio(*must_own(np.arange(1001), n), TwinShares(0.2, 0.5))
    assert ratios[0] == pytest.approx(np.log10(CHANGED), abs=0.01)
    assert ratios.max() < np.log10((1 - CHANGED) / (0.2 * WHOLE) + CHANGED)
    assert ratios.max() > np.log10((1 - CHANGED) / 0.2 + CHANGED)


@pytest.mark.parametrize("rate", RIGHT)
def test_a_rate_in_part_has_the_mean_and_spread_of_a_rate_times_any_share(rate: BetaRate) -> None:
    rng = np.random.default_rng(0)
    drawn = rng.beta(*rate, 200_000) * rng.random(200_000)
    seen, missed = rate.in_part()
    assert seen / (seen + missed) == pytest.approx(drawn.mean(), rel=0.01)
    assert beta.std(seen, missed) == pytest.approx(drawn.std(), rel=0.01)


def test_half_of_a_region_speaks_for_a_twin_in_part() -> None:
    """A fully matched region favours a right motion, a half-matched one a partial copy."""
    found = np.array([170, 100])
    throughout, half = log10_ratio(*must_own(found, np.full(2, 200)), TwinShares(0.2, 0.2))
    assert throughout > 0.7
    assert half < 0


def test_of_a_copy_that_is_found_less_is_learnt_than_of_what_surrounds_it() -> None:
    """Compare a texture with its surroundings matched, not expected, and missing."""
    found, expected = np.zeros((3, 2, 2), np.int64), np.zeros((3, 2, 2), np.int64)
    found[:, 1, 0] = expected[:, 1, 0] = 20
    found[0, 0, 0], expected[[0, 2], 0, 0] = 12, 12
    around, alone, bare = log10_ratio(found, expected, TwinShares(0.02, 0.9))
    assert around > 1.2
    assert 0 < alone < np.log10(1 / WHOLE)
    assert bare < -1


def test_where_all_is_a_twin_only_that_it_is_one_throughout_speaks_for_a_motion() -> None:
    k, n = np.arange(11), np.full(11, 10)
    ratios = log10_ratio(*must_own(k, n), TwinShares(1 - 1e-12, 0.5))
    of_right = betabinom.pmf(k, 10, *RIGHT[0])
    expected = (1 - CHANGED) * of_right / of_twin(k, 10) + CHANGED
    np.testing.assert_allclose(ratios, np.log10(expected), rtol=1e-6)
    assert ratios.max() < np.log10(1 / WHOLE)


def of_twin(k: np.ndarray, n: int) -> np.ndarray:
    """Return the likelihood of k of n that must be seen in a copy."""
    return WHOLE * betabinom.pmf(k, n, *RIGHT[0]) + (1 - WHOLE) * betabinom.pmf(
        k, n, *rates_in_part(RIGHT)[0]
    )


def test_the_ratio_s_mean_under_wrong_motions_is_one() -> None:
    """E[right / wrong] under the wrong model is 1, as for every likelihood ratio."""
    n, s = 12, 0.15
    k = np.arange(n + 1)
    wrong = s * of_twin(k, n) + (1 - s) * betabinom.pmf(k, n, *WRONG[0])
    ratio = 10 ** log10_ratio(*must_own(k, np.full(n + 1, n)), TwinShares(s, 0.5))
    assert wrong @ ratio == pytest.approx(1.0)


def test_beside_the_region_that_found_it_the_mean_is_one_too() -> None:
    """The wrong model is enumerated: either of two regions, with equal odds, is a copy."""
    n, s = 7, 0.15
    k = np.arange(n + 1)
    wrong = s * of_twin(k, n) + (1 - s) * betabinom.pmf(k, n, *WRONG[0])
    right = (1 - CHANGED) * betabinom.pmf(k, n, *RIGHT[0]) + CHANGED * wrong
    found_by_one = (np.outer(right, wrong) + np.outer(wrong, right)) / 2
    by_region = log10_ratio(*must_own(k, np.full(n + 1, n)), TwinShares(s, 0.5))
    ratio = [
        [10 ** log10_without_discovery(np.array([first, second])) for second in by_region]
        for first in by_region
    ]
    np.testing.assert_allclose(found_by_one * ratio, np.outer(right, right), rtol=1e-9)
    assert np.sum(found_by_one * ratio) == pytest.approx(1.0)


def test_one_region_alone_is_no_evidence_for_what_it_found() -> None:
    assert log10_without_discovery(np.array([1.3])) == pytest.approx(0.0)
    assert log10_without_discovery(np.zeros(0)) == 0.0
    assert log10_without_discovery(np.full(4, 0.8)) == pytest.approx(3 * 0.8)
    assert log10_without_discovery(np.array([1.3, -1.2])) == pytest.approx(-0.9, abs=0.01)


def drawn_regions(rng: np.random.Generator, means: tuple[float, float], n_right: int, n_wrong: int):
    """Return counts (R, 2) in regions with given mean rates, and in regions of chance."""
    rates = tuple(own.with_mean(mean) for own, mean in zip(RIGHT, means, strict=True))
    n = rng.integers(5, 40, (n_right + n_wrong, 2))
    of_each = [rates] * n_right + [WRONG] * n_wrong
    share = np.array([[rng.beta(*own) for own in each] for each in of_each])
    return rng.binomial(n, share), n


@pytest.mark.parametrize("n_wrong", [0, 60])
@pytest.mark.parametrize("means", [(0.5, 0.2), (0.45, 0.3), (0.8, 0.38)])
def test_rates_of_darker_maps_are_found(means: tuple[float, float], n_wrong: int) -> None:
    k, n = drawn_regions(np.random.default_rng(1), means, 200, n_wrong)
    found = rates_of_maps(k, n)
    for own, fitted, mean in zip(found, RIGHT, means, strict=True):
        assert own.mean == pytest.approx(mean, abs=0.05)
        assert sum(own) == pytest.approx(sum(fitted))


def test_rates_do_not_exceed_the_fitted_ones_and_few_regions_change_little() -> None:
    k, n = drawn_regions(np.random.default_rng(2), (0.97, 0.9), 100, 0)
    np.testing.assert_allclose(rates_of_maps(k, n), RIGHT)
    empty = np.zeros((0, 2), np.int64)
    np.testing.assert_allclose(rates_of_maps(empty, empty), RIGHT)
    one = rates_of_maps(np.array([[2, 0]]), np.array([[5, 0]]))
    assert 0.7 < one[0].mean < RIGHT[0].mean


def test_chance_does_not_lower_the_rates() -> None:
    k, n = drawn_regions(np.random.default_rng(3), (0.5, 0.2), 0, 100)
    found = rates_of_maps(k, n)
    assert found[0].mean >= RIGHT[0].mean / 2
    regions = log10_against_chance(k, n, found)
    assert np.mean(regions < 0) > 0.9
