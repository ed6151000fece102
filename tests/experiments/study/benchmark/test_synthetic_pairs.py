"""The made-up maps are what they claim to be."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from experiments.scenario.seeds import generator
from experiments.studies.benchmark import SIGMA_M, SIZE_M, synthetic_pair, true_pairs_of
from mapfusion.align.rigid_motion import residual_covariances
from mapfusion.geometry import se2


def residuals(pair):
    c = pair.correspondences
    moved = se2.transform_points(pair.T_a_b, pair.map_b.position_m[c.index_b])
    return (pair.map_a.position_m[c.index_a] - moved)[:, :2]


def test_true_pairs_differ_by_noise_alone_and_the_covariances_say_how_much():
    pair = synthetic_pair(5000, 0.5, generator(0))
    e = residuals(pair)[pair.is_true]
    S = residual_covariances(
        pair.T_a_b, *(m.covariance_m2[pair.is_true] for m in (pair.map_a, pair.map_b))
    )
    np.testing.assert_allclose(S, np.tile(SIGMA_M**2 * np.eye(2), (len(S), 1, 1)), atol=1e-15)
    squared = np.einsum("ni,nij,nj->n", e, np.linalg.inv(S), e)
    assert kstest(squared, chi2(2).cdf).pvalue > 1e-3


def test_false_pairs_are_uniform_and_independent():
    pair = synthetic_pair(5000, 0.8, generator(1))
    c = pair.correspondences
    world_a = se2.transform_points(se2.inverse(pair.T_a_b), pair.map_a.position_m[c.index_a])
    world_b = pair.map_b.position_m[c.index_b]
    for world in (world_a, world_b):
        for axis in (0, 1):
            uniform = world[~pair.is_true, axis] / SIZE_M + 0.5
            assert kstest(uniform, "uniform").pvalue > 1e-3
    together = np.corrcoef(world_a[~pair.is_true, 0], world_b[~pair.is_true, 0])[0, 1]
    assert abs(together) < 4 / np.sqrt(4000)


@pytest.mark.parametrize(
    ("n", "share", "n_true"),
    [(60, 0.5, 30), (60, 0.95, 3), (60, 0.99, 1), (1000, 0.99, 10), (5000, 0.9, 500)],
)
def test_share_of_true_pairs(n, share, n_true):
    pair = synthetic_pair(n, share, generator(2))
    assert pair.is_true.sum() == true_pairs_of(n, share) == n_true
    assert sorted(pair.correspondences.index_a) == list(range(n))
    assert sorted(pair.correspondences.index_b) == list(range(n))
    assert pair.map_a.planar
    assert pair.map_b.planar


def test_order_and_distances_do_not_tell_which_are_true():
    share = np.zeros(1000)
    for k in range(200):
        pair = synthetic_pair(1000, 0.9, generator(3, k))
        share += pair.is_true[np.argsort(pair.correspondences.distance)]
    halves = share[:500].sum(), share[500:].sum()
    assert halves[0] == pytest.approx(halves[1], rel=0.05)
    first = synthetic_pair(1000, 0.9, generator(3, 0))
    assert np.flatnonzero(first.is_true).std() > 100  # spread over all rows


def test_the_oracle_errs_as_theory_says():
    """Least squares on n points about the origin: variance sigma^2 / n per axis."""
    n, trials = 400, 300
    squares = [
        ((pair.least_squares() - pair.T_a_b)[:2] ** 2).sum()
        for pair in (synthetic_pair(2 * n, 0.5, generator(4, k)) for k in range(trials))
    ]
    scaled = np.sum(squares) / (SIGMA_M**2 / n)
    low, high = chi2(2 * trials).ppf([5e-4, 1 - 5e-4])
    assert low < scaled < high
