import math

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from mapfusion.align.alignment import Pairs
from mapfusion.align.mahalanobis_gate import (
    Spread,
    log_likelihood,
    mark_supporters,
    mean_variances,
    settle,
    settle_at_best_scale,
    spread_area_m2,
)
from mapfusion.align.rigid_motion import fit_weighted
from tests.helpers.inner_kernels import from_python
from tests.mapfusion.align.map_pairs import blurred, error, given_pairs, stretched
from tests.mapfusion.align.slow_twins import slow_squares

BOUND = float(chi2.ppf(0.99, 2))


@pytest.fixture
def case():
    (map_a, map_b), pair = blurred(np.random.default_rng(0), 200, 0.5)
    return Pairs(map_a, map_b, pair.correspondences), pair.T_a_b


@pytest.mark.parametrize("variance", [1e-12, 0.01])
def test_support_equals_its_twin(case, variance):
    pairs, T_a_b = case
    planar, inside = pairs.in_plan(), np.empty(200, dtype=bool)
    own, mean = mean_variances(planar), mean_variances(planar, variance)
    count, score = from_python(mark_supporters)(T_a_b, planar, own, variance, BOUND, inside)
    _, C, square = slow_squares(T_a_b, pairs, variance)
    np.testing.assert_allclose(mean, np.trace(C, axis1=1, axis2=2) / 2)
    np.testing.assert_array_equal(inside, square <= BOUND)
    assert count == inside.sum()
    assert score == pytest.approx(np.sum(BOUND - square[inside]))


def test_gate_keeps_true_pairs_with_the_probability_stated():
    (map_a, map_b), pair = blurred(np.random.default_rng(1), 20_000, 1.0)
    planar, inside = Pairs(map_a, map_b, pair.correspondences).in_plan(), np.empty(20_000, bool)
    own = mean_variances(planar)
    count, _ = from_python(mark_supporters)(pair.T_a_b, planar, own, 1e-12, BOUND, inside)
    assert count / 20_000 == pytest.approx(0.99, abs=4 * math.sqrt(0.99 * 0.01 / 20_000))


def test_likelihood_equals_its_twin(case):
    pairs, T_a_b = case
    e, C, _ = slow_squares(T_a_b, pairs, 0.01)
    density = [multivariate_normal.pdf(x, cov=S) for x, S in zip(e, C, strict=True)]
    expected = np.sum(np.log(0.7 / 400 + 0.3 * np.array(density)) - np.log(1 / 400))
    assert log_likelihood(T_a_b, pairs.in_plan(), 0.01, 0.3, 400.0) == pytest.approx(expected)


def test_settled_motion_fits_its_own_support(case):
    pairs, T_a_b = case
    planar, inside = pairs.in_plan(), np.empty(200, dtype=bool)
    T = T_a_b + np.array([0.05, -0.05, 0.002])
    count = settle(T, planar, mean_variances(planar), 0.0025, BOUND, inside)
    fitted = np.empty(3)
    fit_weighted(planar.p_a, planar.p_b, inside / mean_variances(planar, 0.0025), fitted)
    assert error(T, fitted) == pytest.approx((0, 0), abs=1e-12)
    np.testing.assert_array_equal(inside, slow_squares(T, pairs, 0.0025)[2] <= BOUND)
    assert count == inside.sum() > 90


def test_area_of_a_turned_rectangle():
    x, y = np.meshgrid(np.arange(100) + 0.5, (np.arange(100) + 0.5) / 2)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    assert spread_area_m2(np.column_stack([x.ravel(), y.ravel()]) @ turn.T) == pytest.approx(
        5000, rel=1e-3
    )
    assert spread_area_m2(np.tile([[3.0, 4.0]], (5, 1))) == 0


@pytest.mark.parametrize(("drift_m", "level"), [(0.0, 0), (0.05, 1), (0.1, 2)])
def test_the_scale_that_the_residuals_have_is_chosen(drift_m, level):
    """Sixty of three hundred pairs true: the likeliest of three s_drift is the one they have."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        pair = given_pairs(rng, 300, 0.2, 0.03, drift_m, planar=True)
        planar = Pairs(pair.map_a, stretched(rng, pair.map_b, 1), pair.correspondences).in_plan()
        T, inside = pair.T_a_b.copy(), np.empty(300, dtype=bool)
        scales = np.array([0.0, 0.05, 0.1]) ** 2 + 1e-12
        spread = Spread.of(planar)
        assert settle_at_best_scale(T, planar, spread, scales, BOUND, inside)[1] == level


def test_no_support_at_any_scale():
    pair = given_pairs(np.random.default_rng(3), 50, 1.0, 0.01, planar=True)
    planar = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
    T, inside = pair.T_a_b + np.array([500.0, 0, 0]), np.ones(50, dtype=bool)
    spread = Spread.of(planar)
    assert settle_at_best_scale(T, planar, spread, np.array([1e-4]), BOUND, inside)[1] == -1
    assert not inside.any()
