"""The likelihood ratio of regions: against scipy's beta-binomial, and what bounds it."""

import numpy as np
import pytest
from scipy.stats import betabinom

from mapfusion.evidence.likelihood import (
    CHANGED,
    RIGHT,
    WRONG,
    TwinShares,
    log10_against_chance,
    log10_beside_one,
    log10_ratio,
)


def must_own(k: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Regions (R, 2, 2) of nothing but landmarks that must be seen, where nothing is a copy."""
    regions = np.zeros((2, len(k), 2, 2), np.int64)
    regions[:, :, 0, 0] = k, n
    return regions[0], regions[1]


def pmf(k: np.ndarray, n: np.ndarray, rates) -> np.ndarray:
    """(R, 2) of both parts, each a product over both classes."""
    return np.prod([betabinom.pmf(k[..., c], n[..., c], *rates[c]) for c in (0, 1)], axis=0)


@pytest.mark.parametrize("shares", [TwinShares(0.01, 0.4), TwinShares(0.3, 0.3)])
def test_it_is_the_ratio_of_the_two_mixtures(shares: TwinShares) -> None:
    rng = np.random.default_rng(0)
    n = rng.integers(0, 12, (300, 2, 2))
    k = rng.binomial(n, rng.random((300, 1, 1)))
    right, chance = pmf(k, n, RIGHT), pmf(k, n, WRONG)
    copies = shares.copied * right[:, 1] + (1 - shares.copied) * chance[:, 1]
    wrong = shares.own * right[:, 0] * right[:, 1] + (1 - shares.own) * chance[:, 0] * copies
    expected = ((1 - CHANGED) * right[:, 0] * right[:, 1] + CHANGED * wrong) / wrong
    np.testing.assert_allclose(log10_ratio(k, n, shares), np.log10(expected), rtol=1e-9)
    against = np.log10(right / chance)
    np.testing.assert_allclose(log10_against_chance(k, n), against, rtol=1e-9)


def test_a_region_weighs_no_more_than_twins_and_changes_allow() -> None:
    regions = must_own(np.array([0, 1000]), np.array([1000, 1000]))
    against, confirms = log10_ratio(*regions, TwinShares(0.2, 0.5))
    assert against == pytest.approx(np.log10(CHANGED), abs=0.01)
    assert confirms == pytest.approx(np.log10(0.95 / 0.2 + 0.05), abs=0.01)


def test_of_a_copy_that_is_found_nothing_is_learnt_but_of_what_surrounds_it() -> None:
    """The same picture, its surroundings found, not looked for, and missing."""
    found, expected = np.zeros((3, 2, 2), np.int64), np.zeros((3, 2, 2), np.int64)
    found[:, 1, 0] = expected[:, 1, 0] = 20
    found[0, 0, 0], expected[[0, 2], 0, 0] = 12, 12
    around, alone, bare = log10_ratio(found, expected, TwinShares(0.02, 0.9))
    assert around > 1.2
    assert 0 < alone < 0.06
    assert bare < -1


def test_where_all_is_a_twin_nothing_is_said() -> None:
    regions = must_own(np.arange(10), np.full(10, 10))
    np.testing.assert_allclose(log10_ratio(*regions, TwinShares(1 - 1e-12, 0.5)), 0, atol=1e-6)


def test_the_ratio_s_mean_under_wrong_motions_is_one() -> None:
    """E[right / wrong] over the wrong model is 1, whatever the numbers: a likelihood ratio."""
    n, s = 12, 0.15
    k = np.arange(n + 1)
    wrong = s * betabinom.pmf(k, n, *RIGHT[0]) + (1 - s) * betabinom.pmf(k, n, *WRONG[0])
    ratio = 10 ** log10_ratio(*must_own(k, np.full(n + 1, n)), TwinShares(s, 0.5))
    assert wrong @ ratio == pytest.approx(1.0)


def test_beside_the_region_that_found_it_the_mean_is_one_too() -> None:
    """The wrong model is enumerated: of two regions either, at even odds, is as if right."""
    n, s = 7, 0.15
    k = np.arange(n + 1)
    twin = betabinom.pmf(k, n, *RIGHT[0])
    wrong = s * twin + (1 - s) * betabinom.pmf(k, n, *WRONG[0])
    right = (1 - CHANGED) * twin + CHANGED * wrong
    found_by_one = (np.outer(right, wrong) + np.outer(wrong, right)) / 2
    by_region = log10_ratio(*must_own(k, np.full(n + 1, n)), TwinShares(s, 0.5))
    ratio = [
        [10 ** log10_beside_one(np.array([first, second])) for second in by_region]
        for first in by_region
    ]
    np.testing.assert_allclose(found_by_one * ratio, np.outer(right, right), rtol=1e-9)
    assert np.sum(found_by_one * ratio) == pytest.approx(1.0)


def test_one_region_alone_is_no_evidence_for_what_it_found() -> None:
    assert log10_beside_one(np.array([1.3])) == pytest.approx(0.0)
    assert log10_beside_one(np.zeros(0)) == 0.0
    assert log10_beside_one(np.full(4, 0.8)) == pytest.approx(3 * 0.8)
    assert log10_beside_one(np.array([1.3, -1.2])) == pytest.approx(-0.9, abs=0.01)
