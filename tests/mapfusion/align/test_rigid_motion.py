import numpy as np
import pytest
from scipy.optimize import least_squares

from mapfusion.align.rigid_motion import (
    fit_rigid,
    fit_two,
    fit_weighted,
    least_squares_gain,
    motion_covariance,
    residual_covariances,
    residuals,
)
from mapfusion.geometry import se2
from mapfusion.geometry.se2 import motion_jacobian
from tests.mapfusion.align.map_pairs import covariances, error, motion


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


@pytest.mark.parametrize("weighted", [False, True])
def test_motion_covariance_against_monte_carlo(noisy, weighted):
    """The covariance is that of the given weights, not of the optimal ones."""
    T_a_b, _, p_b = noisy
    rng = np.random.default_rng(2)
    exact = se2.transform_points(T_a_b, p_b)[:, :2]
    long = rng.uniform(0.02, 0.3, 30)
    turn = se2.rotation(rng.uniform(-np.pi, np.pi, 30))
    root = turn * np.stack([long, np.full(30, 0.02)], axis=1)[:, None]
    covariance = root @ np.swapaxes(root, 1, 2)
    weight = 2 / (long**2 + 0.02**2) if weighted else np.ones(30)
    fits = np.empty((4000, 3))
    for fit in fits:
        p_a = exact + (root @ rng.standard_normal((30, 2, 1)))[:, :, 0]
        fit_weighted(p_a, p_b, weight, fit)
    fits[:, 2] = se2.wrap(fits[:, 2] - T_a_b[2])
    gain = least_squares_gain(T_a_b, p_b, weight if weighted else None)
    expected = motion_covariance(gain, covariance)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(fits.T) / scale, expected / scale, atol=0.1)


@pytest.mark.parametrize("weighted", [False, True])
def test_kernels_equal_their_twins(noisy, weighted):
    """Compute the same by products of whole arrays."""
    T_a_b, p_a, p_b = noisy
    rng = np.random.default_rng(4)
    S_a, S_b = covariances(rng, 30), covariances(rng, 30)
    R = se2.rotation(T_a_b[2])
    own = S_a[:, :2, :2] + R @ S_b[:, :2, :2] @ R.T
    np.testing.assert_allclose(residual_covariances(T_a_b, S_a, S_b), own, rtol=1e-12)
    moved = se2.transform_points(T_a_b, p_b)
    np.testing.assert_allclose(residuals(T_a_b, p_a, p_b), (p_a - moved)[:, :2], atol=1e-13)
    weight, J = rng.uniform(0.1, 5, 30) if weighted else None, motion_jacobian(T_a_b, p_b)
    W = np.ones(30) if weight is None else weight
    normal = np.einsum("n,nik,nil->kl", W, J, J)
    true = np.einsum("n,kl,nil->nki", W, np.linalg.inv(normal), J)
    gain = least_squares_gain(T_a_b, p_b, weight)
    np.testing.assert_allclose(gain, true, rtol=1e-10, atol=1e-14)
    expected = np.einsum("nki,nij,nlj->kl", true, own, true)
    np.testing.assert_allclose(motion_covariance(gain, own), expected, rtol=1e-10, atol=1e-16)


def test_equal_weights_are_none(noisy):
    _, p_a, p_b = noisy
    T_a_b = np.empty(3)
    fit_weighted(p_a, p_b, np.full(30, 7.0), T_a_b)
    assert tuple(T_a_b) == pytest.approx(fit_rigid(p_a, p_b, np.arange(30)), abs=1e-12)


def test_weighted_fit_minimises_what_a_general_optimiser_minimises(noisy):
    T_a_b, p_a, p_b = noisy
    weight = np.random.default_rng(3).uniform(0, 5, 30)
    general = least_squares(
        lambda T: (np.sqrt(weight)[:, None] * residuals(T, p_a, p_b)).ravel(),
        T_a_b,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    fitted = np.empty(3)
    fit_weighted(p_a, p_b, weight, fitted)
    assert error(fitted, general.x) == pytest.approx((0, 0), abs=1e-7)


def test_two_pairs_are_fitted_as_many(noisy):
    _, p_a, p_b = noisy
    T_a_b = np.empty(3)
    shorter = fit_two(p_a, p_b, 4, 17, T_a_b)
    assert tuple(T_a_b) == pytest.approx(fit_rigid(p_a, p_b, np.array([4, 17])), abs=1e-12)
    lengths = [np.linalg.norm(p[4, :2] - p[17, :2]) for p in (p_a, p_b)]
    assert shorter == pytest.approx(min(lengths))
