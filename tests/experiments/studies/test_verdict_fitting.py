"""Tests of the fits of the verdict's constants: known values are recovered from drawn samples."""

import numpy as np
import pytest

from experiments.studies.verdict_fitting import fit_rates, fit_twins
from mapfusion.verification import likelihood
from mapfusion.verification.likelihood import BetaRate, Rates
from mapfusion.verification.regions import Regions

RIGHT = BetaRate(12.0, 2.5), BetaRate(1.8, 2.9)
WRONG = BetaRate(1.0, 15.0), BetaRate(0.9, 16.0)
SHARES = 0.15, 0.25, 0.6


def drawn_counts(rates: Rates, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw counts found and expected of n regions, for both rates."""
    rng = np.random.default_rng(seed)
    expected = rng.integers(5, 60, (n, 2))
    share = np.stack([rng.beta(*rate, n) for rate in rates], axis=1)
    return rng.binomial(expected, share), expected


def test_known_rates_are_found_if_some_regions_have_changed() -> None:
    right, changed = drawn_counts(RIGHT, 3800, 0), drawn_counts(WRONG, 200, 1)
    mixed = (np.concatenate([right[0], changed[0]]), np.concatenate([right[1], changed[1]]))
    of_right, of_wrong, share = fit_rates(mixed, drawn_counts(WRONG, 4000, 2))
    for found, true in zip((*of_right, *of_wrong), (*RIGHT, *WRONG), strict=True):
        assert found.mean == pytest.approx(true.mean, rel=0.06)
        assert sum(found) == pytest.approx(sum(true), rel=0.2)
    assert share == pytest.approx(0.05, abs=0.01)


def drawn_motions(n: int, seed: int) -> list[Regions]:
    """Draw n motions of six regions each, all of one part; the first region led to the motion."""
    rng = np.random.default_rng(seed)
    hypotheses = likelihood.RIGHT, likelihood.rates_in_part(likelihood.RIGHT), likelihood.WRONG
    motions = []
    for _ in range(n):
        found, expected = np.zeros((6, 2, 2), np.int64), np.zeros((6, 2, 2), np.int64)
        expected[:, 0] = rng.integers(10, 60, (6, 2))
        found[0, 0] = expected[0, 0] = 60
        for region in range(1, 6):
            share = [rng.beta(*rate) for rate in hypotheses[rng.choice(3, p=SHARES)]]
            found[region, 0] = rng.binomial(expected[region, 0], share)
        motions.append(Regions(found, expected))
    return motions


def test_known_shares_are_found_without_the_regions_that_led_to_the_motions() -> None:
    assert fit_twins(drawn_motions(600, 0)) == pytest.approx(SHARES, abs=0.03)
