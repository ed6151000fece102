import numpy as np
import pytest

from mapfusion.align.aligners import as_aligner
from mapfusion.align.alignment import Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.rigid_motion import motion_covariance
from mapfusion.align.svd import Svd, solve
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import error, given_pairs, landmarks, moved

RNG = np.random.default_rng(0)  # SVD draws nothing


def listing(m, m_prime):
    """Run algorithm 1 line by line, on homogeneous points, one per row."""
    m, m_prime = (np.column_stack([p, np.ones(len(p))]) for p in (m, m_prime))
    u, d, vt = np.linalg.svd(m_prime, full_matrices=False)
    z = u.T @ m
    w = z / d[:, None]
    return (vt.T @ w).T


@pytest.mark.parametrize(("points", "n"), [("plane", 2), ("space", 3)])
def test_is_algorithm_1(points, n):
    """With points of space the listing gives the 4x4 matrix of eq. 11."""
    pair = given_pairs(np.random.default_rng(1), 50, 0.8, 0.1)
    T = listing(pair.map_a.position_m[:, :n], pair.map_b.position_m[:, :n])
    u, _, vt = np.linalg.svd(T[:2, :2])
    nearest = u @ np.diag([1, np.linalg.det(u @ vt)]) @ vt
    maps = (pair.map_a, pair.map_b, pair.correspondences)
    printed = as_aligner(Svd(points=points)).align(*maps, RNG).T_a_b
    np.testing.assert_allclose(printed[:2], T[:2, -1], atol=1e-9)
    np.testing.assert_allclose(se2.rotation(printed[2]), nearest, atol=1e-9)


@pytest.mark.parametrize(("n_pairs", "status"), [(3, "degenerate"), (4, "accepted")])
def test_a_4x4_matrix_needs_four_pairs(n_pairs, status):
    pair = given_pairs(np.random.default_rng(8), n_pairs)
    aligner = as_aligner(Svd(points="space"))
    assert aligner.align(pair.map_a, pair.map_b, pair.correspondences, RNG).status == status


def test_result_of_the_listing_is_no_rotation():
    pair = given_pairs(np.random.default_rng(2), 50, 1.0, 1.0)
    block = listing(pair.map_a.position_m[:, :2], pair.map_b.position_m[:, :2])[:2, :2]
    assert abs(np.linalg.det(block) - 1) > 0.01


def test_solved_translation_brings_centroids_together():
    pair = given_pairs(np.random.default_rng(3), 50, 0.5, 0.1)
    m, m_prime = pair.map_a.position_m[:, :2], pair.map_b.position_m[:, :2]
    T_a_b, _ = solve(m, m_prime, "solved")
    centroid = se2.transform_points(T_a_b, m_prime).mean(axis=0)
    np.testing.assert_allclose(centroid, m.mean(axis=0), atol=1e-9)


def test_printed_translation_depends_on_where_map_b_begins():
    """Only the solved translation is equivariant under a change of map b's origin."""
    pair = given_pairs(np.random.default_rng(4), 50, 0.5, 0.1)
    T_new_b = np.array([30.0, -20.0, 0.0])
    shifted = moved(pair.map_b, T_new_b)
    for translation, least, most in (("solved", 0.0, 1e-6), ("printed", 0.1, np.inf)):
        aligner = Svd(translation)
        first, second = (
            as_aligner(aligner).align(pair.map_a, b, pair.correspondences, RNG).T_a_b
            for b in (pair.map_b, shifted)
        )
        assert least <= error(se2.compose(second, T_new_b), first)[0] <= most


@pytest.mark.parametrize("translation", ["printed", "solved"])
@pytest.mark.parametrize("n", [2, 3])
def test_covariance_against_monte_carlo(translation, n):
    """Map a has different noise for each landmark, which the fit does not use."""
    pair = given_pairs(np.random.default_rng(6), 30)
    rng = np.random.default_rng(7)
    sigma = rng.uniform(0.01, 0.2, 30)
    m, m_prime = pair.map_a.position_m[:, :2], pair.map_b.position_m[:, :n]
    fits = np.array(
        [
            solve(m + sigma[:, None] * rng.standard_normal((30, 2)), m_prime, translation)[0]
            for _ in range(4000)
        ]
    )
    fits[:, 2] = se2.wrap(fits[:, 2] - pair.T_a_b[2])
    _, gain = solve(m, m_prime, translation)
    expected = motion_covariance(gain, np.eye(2) * sigma[:, None, None] ** 2)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.cov(fits.T) / scale, expected / scale, atol=0.1)


@pytest.mark.parametrize(("across_m", "status"), [(0.0, "degenerate"), (2.0, "accepted")])
def test_one_common_wall_is_degenerate(across_m, status):
    """Compare landmarks of one wall, with noise across it, and landmarks of a room."""
    rng = np.random.default_rng(5)
    sigma, n = 0.05, 60
    p = np.column_stack(
        [rng.uniform(0, 10, n), rng.uniform(0, across_m, n), rng.uniform(0, 2.5, n)]
    )
    T_b_a = np.array([3.0, 1.0, 0.7])
    map_a = landmarks(p + rng.normal(0, sigma, p.shape), sigma)
    map_b = landmarks(se2.transform_points(T_b_a, p + rng.normal(0, sigma, p.shape)), sigma)
    pairs = Correspondences(np.arange(n), np.arange(n), np.zeros(n))
    alignment = as_aligner(Svd()).align(map_a, map_b, pairs, RNG)
    assert alignment.status == status
    assert ("line" in alignment.reason) == (alignment.status is Status.DEGENERATE)


def test_unknown_options_are_named():
    with pytest.raises(ValueError, match="translation: is 'guessed', expected one of printed"):
        Svd(translation="guessed")
    with pytest.raises(ValueError, match="points: is 'line', expected one of plane, space"):
        Svd(points="line")
