"""The fitted probability: known coefficients are found, and what is stated holds."""

import numpy as np
import pytest

from experiments.studies.refusal.fit_probability import Answers, fit, left_out, stated
from experiments.studies.refusal_rates import calibration_error

MODEL = np.array([-0.5, 1.5, -2.0])


def drawn(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    features = rng.normal([3, 0], [1, 0.5], (n, 2))
    return features, (rng.random(n) < stated(MODEL, features)).astype(float)


def test_known_coefficients_are_found() -> None:
    assert fit(*drawn(40_000, 0)) == pytest.approx(MODEL, abs=0.3)


def test_what_a_true_model_states_holds_and_a_boast_does_not() -> None:
    features, right = drawn(40_000, 1)
    p = stated(MODEL, features)
    assert calibration_error(p, right) < 0.02
    assert calibration_error(p / 2, right) > 0.1


def test_a_kind_left_out_is_told_by_the_others() -> None:
    features, right = drawn(4000, 2)
    kind = np.array(["a", "b"])[np.arange(4000) % 2]
    p = left_out(Answers(features, right, kind))
    of_b = fit(features[kind == "b"], right[kind == "b"])
    np.testing.assert_allclose(p[kind == "a"], stated(of_b, features[kind == "a"]))


def test_the_units_and_the_origin_of_a_feature_do_not_change_what_is_stated() -> None:
    """In thousandths of the unit a weight is a thousandth; the probability stays the same."""
    features, right = drawn(2000, 3)
    in_mm = 1e3 * (features + np.array([5.0, -2.0]))
    one, other = fit(features, right), fit(in_mm, right)
    np.testing.assert_allclose(1e3 * other[1:], one[1:], rtol=1e-3)
    np.testing.assert_allclose(stated(other, in_mm), stated(one, features), atol=1e-4)
    # the intercept makes the mean probability that of the answers
    assert stated(other, in_mm).mean() == pytest.approx(right.mean(), abs=1e-3)
