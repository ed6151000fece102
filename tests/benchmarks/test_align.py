"""Speed of map alignment: `pytest tests/benchmarks/test_align.py --benchmark-only`.

Tables group the methods on the same maps, OpenCV's RANSAC beside ours. With successes:
`mapfusion study benchmark --method clique --method opencv --pairs 1000 --pairs 5000 --outliers .99`
"""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.aligners import ALIGNERS, as_aligner, make_aligner
from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import Correspondences, match
from mapfusion.align.ransac import Ransac
from mapfusion.align.refinement import Refinement
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance

SIZE_M = np.array([20.0, 20.0, 2.5])
NOISE_M = 0.05
T_A_B = np.array([3.0, -2.0, 0.7])


def a_map(position_m, descriptor=None):
    n = len(position_m)
    covariance = np.tile(np.eye(3) * NOISE_M**2, (n, 1, 1))
    return LandmarkMap(position_m, covariance, np.full(n, 5), np.arange(n), descriptor)


def maps_with_pairs(n_landmarks, n_pairs, true_share):
    """Two maps of a 20x20x2.5 m world of which the first pairs, as far as true, are one point."""
    rng = np.random.default_rng(0)
    p = rng.uniform(0, SIZE_M, (n_landmarks, 3))
    other = p + rng.normal(0, NOISE_M, p.shape)
    n_true = round(true_share * n_pairs)
    other[n_true:n_pairs] = rng.uniform(0, SIZE_M, (n_pairs - n_true, 3))
    map_b = a_map(se2.transform_points(se2.inverse(T_A_B), other))
    rows = np.arange(n_pairs)
    return a_map(p), map_b, Correspondences(rows, rows, rng.uniform(0, 0.3, n_pairs))


@pytest.mark.parametrize("outliers", [0.5, 0.95, 0.99])
def test_ransac_1000_pairs(benchmark, outliers):
    """Bars: 5 ms at 95 % outliers, 50 ms at 99 %."""
    maps = maps_with_pairs(1000, 1000, 1 - outliers)
    found = benchmark(lambda: as_aligner(Ransac()).align(*maps, np.random.default_rng(0)))
    assert found.ok


def planar_pairs(n, n_true):
    """Two planar maps of a 20x20 m world, each with its share of the residuals' 0.05 m per axis."""
    rng = np.random.default_rng(0)
    share = NOISE_M / np.sqrt(2)
    p = rng.uniform(0, SIZE_M, (n, 3)) * [1, 1, 0]
    other = np.vstack([p[:n_true], rng.uniform(0, SIZE_M, (n - n_true, 3)) * [1, 1, 0]])
    other = se2.transform_points(se2.inverse(T_A_B), other)
    maps = []
    for points in (p, other):
        noisy = points + rng.normal(0, share, (n, 3)) * [1, 1, 0]
        maps.append(
            replace(a_map(noisy), covariance_m2=a_map(noisy).covariance_m2 / 2, planar=True)
        )
    rows = np.arange(n)
    return *maps, Correspondences(rows, rows, np.zeros(n))


@pytest.mark.parametrize("name", ["opencv", "gnc", "clique", "ransac_mahalanobis"])
@pytest.mark.parametrize(("n", "n_true"), [(60, 6), (1000, 10), (1000, 500), (5000, 50)])
def test_robust_aligner_on_planar_maps(benchmark, name, n, n_true):
    """Bars of the best at 99 % outliers: a sixth of OpenCV's time for 1000 pairs, 0.4 for 5000."""
    maps = planar_pairs(n, n_true)
    benchmark.group = f"{n} pairs, {n_true} true"
    found = benchmark(lambda: as_aligner(make_aligner(name)).align(*maps, np.random.default_rng(0)))
    if name in {"clique", "ransac_mahalanobis"}:
        assert np.hypot(*(found.T_a_b - T_A_B)[:2]) < 0.2


@pytest.mark.parametrize("name", [*ALIGNERS, "opencv"])
@pytest.mark.parametrize(("n_pairs", "true_share"), [(200, 0.3), (1200, 0.4), (1700, 0.8)])
def test_aligner_on_maps_of_1800_landmarks(benchmark, name, n_pairs, true_share):
    """As many pairs as paper.yaml's maps have; the bar is 2 ms of all but ICP and ImpICP."""
    maps = maps_with_pairs(1800, n_pairs, true_share)
    aligner = make_aligner(name)
    benchmark.group = f"{n_pairs} pairs of 1800 landmarks, {true_share:.0%} true"
    benchmark(lambda: as_aligner(aligner).align(*maps, np.random.default_rng(0)))


def test_refinement_200_pairs(benchmark):
    maps = maps_with_pairs(1600, 200, 0.3)
    assert benchmark(lambda: Refinement().refine(Pairs(*maps), T_A_B)).ok


@pytest.mark.parametrize("n_pairs", [200, 1000, 5000])
def test_acceptance(benchmark, n_pairs):
    maps = maps_with_pairs(n_pairs, n_pairs, 0.3)
    refined = Refinement().refine(Pairs(*maps), T_A_B)
    assert benchmark(lambda: Acceptance().verify(Pairs(*maps), refined)).accepted


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("n", [1600, 5000])
def test_match(benchmark, n, planar):
    rng = np.random.default_rng(0)
    descriptor = rng.standard_normal((n, 64)).astype(np.float32)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    landmarks = replace(a_map(rng.uniform(0, SIZE_M, (n, 3)), descriptor), planar=planar)
    assert len(benchmark(lambda: match(landmarks, landmarks))) == n
