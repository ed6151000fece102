import numpy as np
import pytest

from mapfusion.align.aligners import as_aligner
from mapfusion.align.alignment import Pairs
from mapfusion.align.gnc import Gnc, anneal
from mapfusion.align.mahalanobis_gate import mean_variances
from mapfusion.align.rigid_motion import fit_weighted
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import blurred, error, given_pairs

BOUND = Gnc().bound


def slow_anneal(pairs, mean):
    """Yang et al. 2020, algorithm 1 with eq. 14 for the weights."""
    weight, T = np.ones(len(mean)), np.empty(3)
    mu = None
    while True:
        fit_weighted(pairs.p_a, pairs.p_b, weight / mean, T)
        moved = pairs.p_b @ se2.rotation(T[2]).T + T[:2]
        r = np.linalg.norm(pairs.p_a - moved, axis=1) / np.sqrt(mean)
        if mu is None:
            mu = BOUND / (2 * np.max(r**2) - BOUND)
        between = np.sqrt(BOUND) / r * np.sqrt(mu * (mu + 1)) - mu
        weight = np.where(
            r**2 <= mu / (mu + 1) * BOUND, 1, np.where(r**2 >= (mu + 1) / mu * BOUND, 0, between)
        )
        if np.all((weight == 0) | (weight == 1)):
            return T, weight
        mu *= 1.4


@pytest.mark.parametrize("seed", range(5))
def test_kernel_equals_its_twin(seed):
    (map_a, map_b), pair = blurred(np.random.default_rng(seed), 120, 0.5)
    pairs = Pairs(map_a, map_b, pair.correspondences).in_plan()
    mean = mean_variances(pairs, 0.0025)
    T, weight = anneal(pairs, mean, BOUND)
    slow_T, slow_weight = slow_anneal(pairs, mean)
    np.testing.assert_allclose(T, slow_T, atol=1e-9)
    np.testing.assert_allclose(weight, slow_weight, atol=1e-6)


def test_pairs_that_all_fit_end_it_at_once():
    pair = given_pairs(np.random.default_rng(1), 50, 1.0, 0.01, planar=True)
    pairs = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
    _, weight = anneal(pairs, np.full(50, 1.0), BOUND)
    np.testing.assert_array_equal(weight, 1.0)


@pytest.mark.parametrize(
    ("outliers", "least", "most"), [(0.5, 100, 100), (0.8, 85, 100), (0.9, 30, 80)]
)
def test_breaks_down_where_it_is_known_to(outliers, least, most):
    """60 pairs; published rates: 86 of 100 at 80 % outliers, 43 at 90 %."""
    good = 0
    for seed in range(100):
        pair = given_pairs(np.random.default_rng(seed), 60, 1 - outliers, 0.05, planar=True)
        found = as_aligner(Gnc()).align(
            pair.map_a, pair.map_b, pair.correspondences, np.random.default_rng(0)
        )
        good += bool(np.all(np.array(error(found.T_a_b, pair.T_a_b)) < (0.2, 0.05)))
    assert least <= good <= most
