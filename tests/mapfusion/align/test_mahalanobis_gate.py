"""Tests of `mapfusion.align.mahalanobis_gate`."""

import math

import numpy as np
import pytest
from scipy.stats import chi2, f, multivariate_normal

from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.mahalanobis_gate import (
    PairSpread,
    PlanarPairs,
    highest_leverage_pair,
    is_outlier_to_others,
    log_likelihood,
    mark_supporters,
    mean_variances,
    refit_at_best_drift,
    refit_to_support,
    spread_area_m2,
)
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import fit_rigid, fit_weighted, residual_covariances
from mapfusion.geometry import se2
from mapfusion.geometry.se2 import motion_jacobian
from mapfusion.landmark_map import LandmarkMap
from tests.mapfusion.align.map_pairs import blurred, error, given_pairs, stretched
from tests.mapfusion.align.slow_twins import slow_squares

T_TRUE = np.array([1.0, -2.0, 0.7])
SIGMA_M = 0.01


def planar_map(p: np.ndarray, *, named: bool = False) -> LandmarkMap:
    n = len(p)
    return LandmarkMap(
        np.column_stack([p, np.zeros(n)]),
        np.tile(np.eye(3) * SIGMA_M**2, (n, 1, 1)),
        np.full(n, 5, np.int32),
        np.arange(n),
        planar=True,
        label=np.arange(n, dtype=np.int32) if named else None,
    )


def a_corner_and_one_far(
    turned_rad: float, seed: int = 0, *, named: bool = False
) -> tuple[LandmarkMap, LandmarkMap, Correspondences, np.ndarray]:
    """25 true pairs lie within 0.3 m; one 7 m away is consistent with a rotation about them."""
    rng = np.random.default_rng(seed)
    p_b = np.vstack([rng.uniform(-0.15, 0.15, (25, 2)), [[7.0, 0.5]]])
    p_a = se2.transform_points(T_TRUE, p_b) + rng.normal(0, SIGMA_M, p_b.shape)
    T_turned = T_TRUE + np.array([0, 0, turned_rad])
    p_a[-1] = se2.transform_points(T_turned, p_b[-1:])[0]
    n = np.arange(26)
    map_a, map_b = (planar_map(p, named=named) for p in (p_a, p_b))
    return map_a, map_b, Correspondences(n, n, np.zeros(26)), T_turned


@pytest.mark.parametrize("named", [False, True])
def test_a_false_far_pair_turns_the_map_and_is_found_out(named: bool) -> None:
    """A wrong label is a false pair as well."""
    map_a, map_b, pairs, T_turned = a_corner_and_one_far(0.7, named=named)
    found = Refinement().refine(Pairs(map_a, map_b, pairs), T_turned)
    assert np.hypot(*(found.T_a_b - T_turned)[:2]) < 0.1  # it did go there: residuals fit the gate
    assert abs(found.T_a_b[2] - T_TRUE[2]) > 0.5
    assert found.status is Status.REFUSED
    assert "rests on one correspondence: without it landmarks move by 4" in found.reason


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_a_true_far_pair_is_welcome(seed: int, named: bool) -> None:
    map_a, map_b, pairs, start = a_corner_and_one_far(0.0, seed, named=named)
    found = Refinement().refine(Pairs(map_a, map_b, pairs), start)
    assert found.status is Status.ACCEPTED
    assert abs(found.T_a_b[2] - T_TRUE[2]) < 0.01


def test_leverage_is_the_hat_matrix_s_trace() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        n = 12
        A = rng.normal(0, 0.1, (2, n, 2, 2))
        S_a, S_b = A @ np.swapaxes(A, 2, 3)
        pairs = PlanarPairs(rng.normal(0, 3, (n, 2)), rng.normal(0, 3, (n, 2)), S_a, S_b)
        T, truth, variance = rng.normal(size=3), rng.uniform(0, 1, n), 0.01
        C = residual_covariances(T, S_a, S_b) + variance * np.eye(2)
        W, J = truth[:, None, None] * np.linalg.inv(C), motion_jacobian(T, pairs.p_b)
        covariance = np.linalg.inv(np.einsum("nki,nkl,nlj->ij", J, W, J))
        hat = np.einsum("nki,ij,nlj,nlk->n", J, covariance, J, W)
        assert hat.sum() == pytest.approx(3)  # as many as parameters
        assert highest_leverage_pair(T, pairs, variance, truth, covariance) == np.argmax(hat)


@pytest.mark.parametrize("n", [4, 6, 12])
def test_true_pairs_are_called_false_as_seldom_as_promised(n: int) -> None:
    """In bent maps the pair of highest leverage has a residual like the others."""
    rng, called, tried = np.random.default_rng(n), 0, 300
    S = np.tile(np.eye(2) * 1e-6, (n, 1, 1))
    for _ in range(tried):
        p_b = rng.normal(0, 3, (n, 2))
        p_a = se2.transform_points(T_TRUE, p_b) + rng.normal(0, 0.3, (n, 2))
        pairs = PlanarPairs(p_a, p_b, S, S)
        others = PlanarPairs(*(part[1:] for part in pairs))
        T = np.array(fit_rigid(others.p_a, others.p_b, np.arange(n - 1)))
        e = others.p_a - se2.transform_points(T, others.p_b)
        variance = float(np.sum(e**2)) / (2 * (n - 1) - 3)
        J = motion_jacobian(T, others.p_b)
        covariance = np.linalg.inv(np.einsum("nki,nkj->ij", J, J)) * variance
        called += is_outlier_to_others(T, covariance, variance, pairs, 0)
    assert called <= 2  # 0.075 are expected at n = 4
    far = p_a.copy()
    far[0] += 300.0
    assert is_outlier_to_others(T, covariance, variance, pairs._replace(p_a=far), 0)


@pytest.mark.parametrize("n", [4, 6, 20])
def test_the_limit_of_a_pair_is_that_of_the_f_distribution(n: int) -> None:
    """The other n - 1 pairs have m = 2 (n - 1) - 3 degrees of freedom, so that D is 2 F(2, m)."""
    rng, sigma_m, k = np.random.default_rng(n), 0.05, 2
    p_b = rng.uniform(0, 9, (n, 2))
    p_a, none, known = se2.transform_points(T_TRUE, p_b), np.zeros((n, 2, 2)), np.zeros((3, 3))
    limit = 2 * f.isf(1e-3 / n, 2, 2 * (n - 1) - 3)
    for share, unlike in ((0.999, False), (1.001, True)):
        moved = p_a.copy()
        moved[k] += sigma_m * np.sqrt(share * limit) * np.array([0.6, -0.8])
        pairs = PlanarPairs(moved, p_b, none, none)
        assert is_outlier_to_others(T_TRUE, known, sigma_m**2, pairs, k) == unlike


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
    count, score = mark_supporters(T_a_b, planar, own, variance, BOUND, inside)
    _, C, square = slow_squares(T_a_b, pairs, variance)
    np.testing.assert_allclose(mean, np.trace(C, axis1=1, axis2=2) / 2)
    np.testing.assert_array_equal(inside, square <= BOUND)
    assert count == inside.sum()
    assert score == pytest.approx(np.sum(BOUND - square[inside]))


def test_gate_keeps_true_pairs_with_the_probability_stated():
    (map_a, map_b), pair = blurred(np.random.default_rng(1), 20_000, 1.0)
    planar, inside = Pairs(map_a, map_b, pair.correspondences).in_plan(), np.empty(20_000, bool)
    own = mean_variances(planar)
    count, _ = mark_supporters(pair.T_a_b, planar, own, 1e-12, BOUND, inside)
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
    count = refit_to_support(T, planar, mean_variances(planar), 0.0025, BOUND, inside)
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
    """60 of 300 pairs are true; the most likely of three s_drift is the true one."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        pair = given_pairs(rng, 300, 0.2, 0.03, drift_m, planar=True)
        planar = Pairs(pair.map_a, stretched(rng, pair.map_b, 1), pair.correspondences).in_plan()
        T, inside = pair.T_a_b.copy(), np.empty(300, dtype=bool)
        scales = np.array([0.0, 0.05, 0.1]) ** 2 + 1e-12
        spread = PairSpread.of(planar)
        assert refit_at_best_drift(T, planar, spread, scales, BOUND, inside)[1] == level


def test_no_support_at_any_scale():
    pair = given_pairs(np.random.default_rng(3), 50, 1.0, 0.01, planar=True)
    planar = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
    T, inside = pair.T_a_b + np.array([500.0, 0, 0]), np.ones(50, dtype=bool)
    spread = PairSpread.of(planar)
    assert refit_at_best_drift(T, planar, spread, np.array([1e-4]), BOUND, inside)[1] == -1
    assert not inside.any()
