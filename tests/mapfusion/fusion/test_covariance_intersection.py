"""Covariance intersection, against a grid of weights and against errors that are the same."""

import numpy as np

from mapfusion.fusion.covariance_intersection import intersect_covariances
from tests.mapfusion.align.map_pairs import covariances


def _pairs(n: int = 40) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(0)
    p_i, p_j = rng.uniform(-5, 5, (2, n, 3))
    return p_i, covariances(rng, n), p_j, covariances(rng, n)


def test_no_weight_gives_a_smaller_determinant() -> None:
    p_i, S_i, p_j, S_j = _pairs()
    A, B = np.linalg.inv(S_i), np.linalg.inv(S_j)
    position, covariance = intersect_covariances(p_i, S_i, p_j, S_j)
    w = np.linspace(0, 1, 2001)[:, None, None, None]
    tried = np.linalg.inv(w * A + (1 - w) * B)
    best = np.argmin(np.linalg.det(tried), axis=0)
    assert set(best) - {0, 2000}  # somewhere between the two, in some
    assert np.all(np.linalg.det(covariance) <= np.linalg.det(tried).min(axis=0) * (1 + 1e-12))
    each = np.arange(len(p_i))
    np.testing.assert_allclose(covariance, tried[best, each], rtol=0, atol=2e-3 * np.max(S_i))
    # the information form of the same weight, which the covariance tells
    share = w[best, 0, 0, 0][:, None]
    total = np.einsum("nij,nj->ni", A, p_i) * share + np.einsum("nij,nj->ni", B, p_j) * (1 - share)
    expected = np.einsum("nij,nj->ni", tried[best, each], total)
    np.testing.assert_allclose(position, expected, rtol=0, atol=1e-2)


def test_who_is_first_makes_no_difference() -> None:
    p_i, S_i, p_j, S_j = _pairs()
    one, other = (
        intersect_covariances(p_i, S_i, p_j, S_j),
        intersect_covariances(p_j, S_j, p_i, S_i),
    )
    np.testing.assert_allclose(one[0], other[0], atol=1e-9)
    np.testing.assert_allclose(one[1], other[1], atol=1e-12)


def test_errors_that_are_the_same_are_not_halved() -> None:
    """A Kalman filter underestimates this variance by a factor of two."""
    p, S, _, _ = _pairs()
    np.testing.assert_allclose(intersect_covariances(p, S, p, S)[1], S, rtol=1e-9)
