"""The likelihood ratio of regions: against scipy's beta-binomial, and what bounds it."""

import numpy as np
import pytest
from scipy.stats import betabinom

from mapfusion.evidence.likelihood import CHANGED, RIGHT, WRONG, log10_ratio


@pytest.mark.parametrize("twin_share", [0.01, 0.3, 0.9])
def test_it_is_the_ratio_of_the_two_mixtures(twin_share: float) -> None:
    k, n = (each.ravel() for each in np.meshgrid(np.arange(0, 9), [9, 14]))
    right, chance = (betabinom.pmf(k, n, *rate) for rate in (RIGHT, WRONG))
    wrong = twin_share * right + (1 - twin_share) * chance
    expected = ((1 - CHANGED) * right + CHANGED * wrong) / wrong
    np.testing.assert_allclose(log10_ratio(k, n, twin_share), np.log10(expected), rtol=1e-9)


def test_a_region_weighs_no_more_than_twins_and_changes_allow() -> None:
    many = np.array([0, 1000])
    against, confirms = log10_ratio(many, np.array([1000, 1000]), 0.2)
    assert against == pytest.approx(np.log10(CHANGED), abs=0.01)
    assert confirms == pytest.approx(np.log10(0.95 / 0.2 + 0.05), abs=0.01)


def test_where_all_is_a_twin_nothing_is_said() -> None:
    k = np.arange(10)
    np.testing.assert_allclose(log10_ratio(k, np.full(10, 10), 1 - 1e-12), 0, atol=1e-6)


def test_the_ratio_s_mean_under_wrong_motions_is_one() -> None:
    """E[right / wrong] over the wrong model is 1, whatever the numbers: a likelihood ratio."""
    n, s = 12, 0.15
    k = np.arange(n + 1)
    wrong = s * betabinom.pmf(k, n, *RIGHT) + (1 - s) * betabinom.pmf(k, n, *WRONG)
    assert wrong @ 10 ** log10_ratio(k, np.full(n + 1, n), s) == pytest.approx(1.0)
