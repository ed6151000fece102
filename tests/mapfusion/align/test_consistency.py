import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align.consistency import consistency
from mapfusion.align.pairs import Pairs
from tests.mapfusion.align.map_pairs import blurred, given_pairs, motion, moved
from tests.mapfusion.align.slow_twins import slow_consistency

BOUND = float(chi2.ppf(0.999, 1))


def unpacked(graphs, n):
    bits = np.unpackbits(graphs.view(np.uint8), axis=2, bitorder="little")
    assert not bits[:, :, n:].any()
    return bits[:, :, :n].astype(bool)


@pytest.mark.parametrize("n", [2, 8, 63, 64, 65, 200])
def test_kernel_equals_its_twin(n):
    (map_a, map_b), pair = blurred(np.random.default_rng(n), n)
    pairs = Pairs(map_a, map_b, pair.correspondences).in_plan()
    variances = np.array([1e-12, 0.0025, 0.01])
    found = unpacked(consistency(pairs, variances, BOUND), n)
    for graph, variance in zip(found, variances, strict=True):
        np.testing.assert_array_equal(graph, slow_consistency(pairs, variance, BOUND))
        np.testing.assert_array_equal(graph, graph.T)


@pytest.mark.parametrize("drift_m", [0.0, 0.1])
def test_true_pairs_agree_with_the_probability_stated(drift_m):
    n, disagreeing = 200, []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        (map_a, map_b), pair = blurred(rng, n, true_share=1.0)
        map_b.position_m[:, :2] += rng.normal(0, drift_m, (n, 2))
        pairs = Pairs(map_a, map_b, pair.correspondences).in_plan()
        graph = consistency(pairs, np.array([max(drift_m**2, 1e-12)]), BOUND)
        disagreeing.append(1 - np.sum(unpacked(graph, n)) / (n * (n - 1)))
    # one landmark is in 199 comparisons: the scatter over the maps tells how sure the mean is
    sure = 4 * np.std(disagreeing) / np.sqrt(30)
    assert np.mean(disagreeing) == pytest.approx(0.001, abs=sure + 1e-4)


def test_does_not_depend_on_the_frames():
    rng = np.random.default_rng(1)
    (map_a, map_b), pair = blurred(rng, 150)
    graphs = [
        consistency(Pairs(a, b, pair.correspondences).in_plan(), np.array([0.01]), BOUND)
        for a, b in ((map_a, map_b), (moved(map_a, motion(rng)), moved(map_b, motion(rng))))
    ]
    np.testing.assert_array_equal(*graphs)


def test_exact_maps_without_covariance_agree():
    """Nothing but rounding keeps these distances apart, a kilometre from the origin."""
    rng = np.random.default_rng(2)
    pair = given_pairs(rng, 100, planar=True, T_a_b=np.array([1000.0, -700.0, 2.0]))
    pairs = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
    graph = unpacked(consistency(pairs, np.array([1e-12]), BOUND), 100)[0]
    assert np.sum(graph) == 100 * 99
