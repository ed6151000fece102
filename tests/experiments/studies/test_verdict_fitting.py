"""Tests of the fits of the verdict's constants: known values are recovered from drawn samples."""

import numpy as np
import pytest

from experiments.studies.refusal_rates import calibration_error
from experiments.studies.verdict_fitting import (
    Answers,
    fit_probability,
    fit_rates,
    fit_twins,
    left_out,
    stated,
)
from mapfusion.verification import likelihood
from mapfusion.verification.likelihood import BetaRate, Rates
from mapfusion.verification.regions import Regions

MODEL = np.array([-0.5, 1.5, -2.0])
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


def drawn_answers(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw features (n, 2) and outcomes (n,) of `MODEL`."""
    rng = np.random.default_rng(seed)
    features = rng.normal([3, 0], [1, 0.5], (n, 2))
    return features, (rng.random(n) < stated(MODEL, features)).astype(float)


def test_known_coefficients_are_found() -> None:
    assert fit_probability(*drawn_answers(40_000, 0)) == pytest.approx(MODEL, abs=0.3)


def test_the_true_model_is_calibrated_and_half_of_its_probability_is_not() -> None:
    features, right = drawn_answers(40_000, 1)
    p = stated(MODEL, features)
    assert calibration_error(p, right) < 0.02
    assert calibration_error(p / 2, right) > 0.1


def test_a_kind_left_out_is_predicted_from_the_others() -> None:
    features, right = drawn_answers(4000, 2)
    kind = np.array(["a", "b"])[np.arange(4000) % 2]
    p = left_out(Answers(features, right, kind))
    of_b = fit_probability(features[kind == "b"], right[kind == "b"])
    np.testing.assert_allclose(p[kind == "a"], stated(of_b, features[kind == "a"]))


def test_units_and_origin_of_a_feature_do_not_change_the_probability() -> None:
    """In thousandths of the unit a weight is a thousandth; the probability stays the same."""
    features, right = drawn_answers(2000, 3)
    in_mm = 1e3 * (features + np.array([5.0, -2.0]))
    one, other = fit_probability(features, right), fit_probability(in_mm, right)
    np.testing.assert_allclose(1e3 * other[1:], one[1:], rtol=1e-3)
    np.testing.assert_allclose(stated(other, in_mm), stated(one, features), atol=1e-4)
    # the intercept makes the mean probability that of the answers
    assert stated(other, in_mm).mean() == pytest.approx(right.mean(), abs=1e-3)
