from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align.alignment import Pairs
from mapfusion.align.consensus import consistency, in_rows
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
    scales = 0.0025 * (n > 64), 0.01
    found = unpacked(consistency(in_rows(pairs), scales, BOUND), n)
    for graph, variance in zip(found, scales, strict=True):
        np.testing.assert_array_equal(graph, slow_consistency(pairs, variance, BOUND))
        np.testing.assert_array_equal(graph, graph.T)


def test_single_precision_loses_no_pair():
    """A kilometre apart, landmarks known better than single precision can tell there."""
    (map_a, map_b), pair = blurred(np.random.default_rng(3), 200, true_share=1.0, sigma_m=1e-7)
    maps = [replace(m, position_m=50 * m.position_m) for m in (map_a, map_b)]
    maps = [replace(m, covariance_m2=2500 * m.covariance_m2) for m in maps]
    pairs = Pairs(*maps, pair.correspondences).in_plan()
    found = unpacked(consistency(in_rows(pairs), (0.0, 1e-12), BOUND), 200)
    np.testing.assert_array_equal(found[0], slow_consistency(pairs, 0.0, BOUND))
    assert np.sum(found[0]) > 0.99 * 200 * 199


@pytest.mark.parametrize("drift_m", [0.0, 0.1])
def test_true_pairs_agree_with_the_probability_stated(drift_m):
    n, disagreeing = 200, []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        (map_a, map_b), pair = blurred(rng, n, true_share=1.0)
        map_b.position_m[:, :2] += rng.normal(0, drift_m, (n, 2))
        pairs = Pairs(map_a, map_b, pair.correspondences).in_plan()
        graph = consistency(in_rows(pairs), (drift_m**2, 0.01), BOUND)[:1]
        disagreeing.append(1 - np.sum(unpacked(graph, n)) / (n * (n - 1)))
    # one landmark is in 199 comparisons: the scatter over the maps tells how sure the mean is
    sure = 4 * np.std(disagreeing) / np.sqrt(30)
    assert np.mean(disagreeing) == pytest.approx(0.001, abs=sure + 1e-4)


def test_does_not_depend_on_the_frames():
    rng = np.random.default_rng(1)
    (map_a, map_b), pair = blurred(rng, 150)
    graphs = [
        consistency(in_rows(Pairs(a, b, pair.correspondences).in_plan()), (0.0, 0.01), BOUND)
        for a, b in ((map_a, map_b), (moved(map_a, motion(rng)), moved(map_b, motion(rng))))
    ]
    np.testing.assert_array_equal(*graphs)


def test_exact_maps_without_covariance_agree():
    """Nothing but rounding keeps these distances apart, a kilometre from the origin."""
    rng = np.random.default_rng(2)
    pair = given_pairs(rng, 100, planar=True, T_a_b=np.array([1000.0, -700.0, 2.0]))
    pairs = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
    graph = unpacked(consistency(in_rows(pairs), (1e-12, 0.01), BOUND), 100)[0]
    assert np.sum(graph) == 100 * 99
