import numpy as np
import pytest
from map_pairs import error, motion
from scipy.optimize import least_squares

from mapfusion import se2
from mapfusion.align.rigid import (
    fit_rigid,
    motion_covariance,
    motion_jacobian,
    residual_covariances,
    residuals,
)


@pytest.fixture
def noisy():
    rng = np.random.default_rng(0)
    T_a_b = motion(rng)
    p_b = rng.uniform(-5, 5, (30, 3))
    return T_a_b, se2.transform_points(T_a_b, p_b) + rng.normal(0, 0.1, (30, 3)), p_b


def test_fit_minimises_what_a_general_optimiser_minimises(noisy):
    T_a_b, p_a, p_b = noisy
    general = least_squares(
        lambda T: residuals(T, p_a, p_b).ravel(), T_a_b, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    fitted = np.array(fit_rigid(p_a, p_b, np.arange(30)))
    assert error(fitted, general.x) == pytest.approx((0, 0), abs=1e-7)


def test_fit_uses_only_the_rows_given(noisy):
    _, p_a, p_b = noisy
    rows = np.array([3, 4, 20])
    assert fit_rigid(p_a, p_b, rows) == pytest.approx(
        fit_rigid(p_a[rows], p_b[rows], np.arange(3)), abs=1e-12
    )


def test_jacobian_is_the_derivative(noisy):
    T_a_b, _, p_b = noisy
    h = 1e-6
    for k, step in enumerate(np.eye(3) * h):
        plus, minus = (se2.transform_points(T_a_b + s, p_b)[:, :2] for s in (step, -step))
        np.testing.assert_allclose(
            motion_jacobian(T_a_b, p_b)[:, :, k], (plus - minus) / (2 * h), atol=1e-8
        )


def test_residual_covariance_against_monte_carlo(noisy):
    T_a_b, p_a, p_b = noisy
    rng = np.random.default_rng(1)
    S_a, S_b = np.diag([0.04, 0.01, 0.02]), np.array([[0.09, 0.04, 0], [0.04, 0.03, 0], [0, 0, 1]])
    n = 100_000
    a = p_a[0] + rng.multivariate_normal(np.zeros(3), S_a, n)
    b = p_b[0] + rng.multivariate_normal(np.zeros(3), S_b, n)
    expected = residual_covariances(T_a_b, S_a[None], S_b[None])[0]
    np.testing.assert_allclose(np.cov(residuals(T_a_b, a, b).T), expected, atol=2e-3)


def test_motion_covariance_against_monte_carlo(noisy):
    T_a_b, _, p_b = noisy
    rng = np.random.default_rng(2)
    sigma = 0.1
    exact = se2.transform_points(T_a_b, p_b)
    rows = np.arange(len(p_b))
    fits = np.array(
        [fit_rigid(exact + rng.normal(0, sigma, exact.shape), p_b, rows) for _ in range(4000)]
    )
    fits[:, 2] = se2.wrap(fits[:, 2] - T_a_b[2])
    expected = motion_covariance(T_a_b, p_b, np.tile(np.eye(2) * sigma**2, (30, 1, 1)))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(fits.T) / scale, expected / scale, atol=0.1)
