"""Tests of `mapfusion.align.drift`."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2

from mapfusion.align.drift import estimate_drift_m
from mapfusion.align.mahalanobis_gate import DRIFT_FLOOR_M
from mapfusion.geometry.se2 import rotation


def residuals_with(rng, n, drift_m):
    """Return residuals about a known motion, and the covariances that explain a part of them."""
    turn = rotation(rng.uniform(-np.pi, np.pi, n))
    S = turn @ np.diag([0.08**2, 0.02**2]) @ np.swapaxes(turn, 1, 2)
    C = S + drift_m**2 * np.eye(2)
    return np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((n, 2))), S


def test_is_the_most_likely_value():
    e, S = residuals_with(np.random.default_rng(0), 2000, 0.1)

    def minus_log_likelihood(drift):
        C = S + drift**2 * np.eye(2)
        square = np.einsum("ni,ni->n", e, np.linalg.solve(C, e[:, :, None])[:, :, 0])
        return np.sum(square + np.log(np.linalg.det(C))) / 2

    best = minimize_scalar(minus_log_likelihood, bounds=(0.0, 1.0), options={"xatol": 1e-9}).x
    # three of 4000 numbers went into the motion
    assert estimate_drift_m(e, S) == pytest.approx(best, rel=1e-3)


def slow_score(e, S, variance_m2, gate_m):
    """Return the derivative of the documented log-likelihood by s_drift^2."""
    share = 2 * len(e) / (2 * len(e) - 3)
    C = S + variance_m2 * np.eye(2)
    inverse, v = np.linalg.inv(C), np.trace(C, axis1=1, axis2=2) / 2
    explained = np.einsum("ni,nij,njk,nk->", e, inverse, inverse, e)
    inside = -np.expm1(-(gate_m**2) / (2 * v))
    truncated = np.exp(-(gate_m**2) / (2 * v)) * gate_m**2 / v**2 if gate_m < np.inf else 0 * v
    return (
        share * explained - np.trace(inverse, axis1=1, axis2=2).sum() + np.sum(truncated / inside)
    )


@pytest.mark.parametrize("gate_m", [0.3, np.inf])
def test_landmarks_of_all_certainties_leave_it_where_no_step_is_taken(gate_m):
    """With heavy tails plain Fisher scoring oscillates on one in fifteen."""
    rng = np.random.default_rng(5)
    above = 0
    for _ in range(60):
        variance = 10 ** rng.uniform(-8, -3, 200)
        sigma = np.sqrt(variance + 10 ** rng.uniform(-12, -6))
        e = sigma[:, None] * rng.standard_t(1.5, (200, 2))
        kept = np.hypot(*e.T) < gate_m
        e, S = e[kept], variance[kept, None, None] * np.eye(2)
        found = estimate_drift_m(e, S, gate_m) ** 2
        if found > 1.001 * DRIFT_FLOOR_M**2:
            near = found * np.array([1 - 1e-3, 1 + 1e-3])
            true = brentq(lambda x, e=e, S=S: slow_score(e, S, x, gate_m), *near, xtol=1e-18)
            assert found == pytest.approx(true, rel=1e-8)
            above += 1
        else:
            assert slow_score(e, S, DRIFT_FLOOR_M**2, gate_m) < 0
    assert above > 20


def test_three_fitted_parameters_leave_the_variance_unbiased():
    rng = np.random.default_rng(1)
    drift, p = 0.1, rng.uniform(-5, 5, (6, 2))
    jacobian = np.zeros((12, 3))
    jacobian[::2, 0] = jacobian[1::2, 1] = 1
    jacobian[::2, 2], jacobian[1::2, 2] = -p[:, 1], p[:, 0]
    rest = np.eye(12) - jacobian @ np.linalg.pinv(jacobian)
    variances = [
        estimate_drift_m((rest @ rng.normal(0, drift, 12)).reshape(6, 2), np.zeros((6, 2, 2))) ** 2
        for _ in range(2000)
    ]
    assert np.mean(variances) == pytest.approx(drift**2, rel=0.05)


@pytest.mark.parametrize("gate_sigmas", [2.0, 3.0])
def test_gate_does_not_bias_it(gate_sigmas):
    rng = np.random.default_rng(2)
    drift = 0.1
    e, S = rng.normal(0, drift, (40_000, 2)), np.zeros((40_000, 2, 2))
    gate = gate_sigmas * drift
    kept = np.hypot(*e.T) < gate
    assert estimate_drift_m(e[kept], S[kept], gate) == pytest.approx(drift, rel=0.02)
    assert estimate_drift_m(e[kept], S[kept]) < 0.98 * drift  # unaware of the gate


def test_true_pairs_fall_into_the_gate_as_often_as_it_says():
    rng = np.random.default_rng(3)
    e, S = residuals_with(rng, 5000, 0.15)

    def coverage(drift):
        C = S + drift**2 * np.eye(2)
        square = np.einsum("ni,ni->n", e, np.linalg.solve(C, e[:, :, None])[:, :, 0])
        return np.mean(square <= chi2.ppf(0.99, 2))

    assert coverage(estimate_drift_m(e, S)) == pytest.approx(0.99, abs=0.005)
    assert coverage(0.0) < 0.5


def test_nothing_to_explain():
    rng = np.random.default_rng(4)
    S = np.tile(np.eye(2) * 0.1**2, (500, 1, 1))
    assert estimate_drift_m(rng.normal(0, 0.05, (500, 2)), S) == DRIFT_FLOOR_M
    assert estimate_drift_m(np.zeros((5, 2)), np.zeros((5, 2, 2))) == DRIFT_FLOOR_M
    assert estimate_drift_m(np.zeros((0, 2)), np.zeros((0, 2, 2))) == DRIFT_FLOOR_M
