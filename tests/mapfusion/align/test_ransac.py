import math
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import chisquare

from mapfusion.align.aligners import as_aligner
from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.ransac import Ransac, draw_pair, list_supporters, most_supported
from mapfusion.align.refinement import Oracle, Refinement
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import error, given_pairs, landmarks
from tests.mapfusion.align.slow_twins import draw

GATE_M, BASELINE_M = 0.3, 1.0
LOG_MISS = math.log(1e-4)


def closed_form(p_a, p_b):
    """Fit a motion by the SVD of the cross-covariance (Arun et al. 1987)."""
    a, b = p_a[:, :2], p_b[:, :2]
    u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = u @ np.diag([1, np.linalg.det(u @ vt)]) @ vt
    return np.array([*(a.mean(0) - R @ b.mean(0)), math.atan2(R[1, 0], R[0, 0])])


def supporters(T, p_a, p_b):
    distance = np.linalg.norm(p_a - se2.transform_points(T, p_b), axis=1)
    rows = np.flatnonzero(distance <= GATE_M)
    return rows, np.sum(distance[rows] ** 2)


def hypothesis(p_a, p_b, i, j):
    """Return the motion of a minimal set, refitted to its support; None for a rejected set."""
    lengths = [np.linalg.norm(p[i, :2] - p[j, :2]) for p in (p_a, p_b)]
    if min(lengths) < BASELINE_M or abs(lengths[0] - lengths[1]) > 2 * GATE_M:
        return None
    T = closed_form(p_a[[i, j]], p_b[[i, j]])
    return T, *supporters(T, p_a, p_b)


def settled(T, rows, p_a, p_b):
    for _ in range(10):
        T = closed_form(p_a[rows], p_b[rows])
        before, (rows, cost) = rows, supporters(T, p_a, p_b)
        if len(rows) < 2 or np.array_equal(rows, before):
            break
    return T, rows, cost


def slow_search(p_a, p_b, max_draws, seed):
    n, best_T, best, best_cost = len(p_a), None, np.zeros(0), math.inf
    needed, draws, state = max_draws, 0, int(seed)
    while draws < needed:
        draws += 1
        state = draw(state)
        i = ((state >> 32) * n) >> 32
        state = draw(state)
        j = ((state >> 32) * (n - 1)) >> 32
        j += j >= i
        raw = hypothesis(p_a, p_b, i, j)
        if raw is None or len(raw[1]) < max(len(best), 2):
            continue
        T, rows, cost = settled(raw[0], raw[1], p_a, p_b)
        if (len(rows), -cost) > (len(best), -best_cost):
            best_T, best, best_cost = T, rows, cost
            hit = len(rows) * (len(rows) - 1) / (n * (n - 1))
            needed = min(needed, LOG_MISS / math.log1p(-hit)) if hit < 1 else 0
    return draws, best_T, best


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_kernel_equals_its_twin(seed, planar):
    pair = given_pairs(np.random.default_rng(seed), 60, 0.2, 0.05, planar=planar)
    dimensions = 2 if planar else 3
    p_a, p_b = (m.position_m[:, :dimensions].copy() for m in (pair.map_a, pair.map_b))
    if not planar:  # some pairs agree in plan only
        p_b[::7, 2] += 0.5
    draws, T, rows = most_supported(
        p_a, p_b, GATE_M, BASELINE_M, LOG_MISS, 3000, np.uint64(seed + 1)
    )
    twin_draws, twin_T, twin_rows = slow_search(p_a, p_b, 3000, seed + 1)
    assert draws == twin_draws
    np.testing.assert_array_equal(rows, twin_rows)
    np.testing.assert_allclose(T, twin_T, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_no_minimal_set_of_all_has_more_support(seed):
    pair = given_pairs(np.random.default_rng(seed), 50, 0.15, 0.08)
    p_a, p_b = pair.map_a.position_m, pair.map_b.position_m
    most = 0
    for i, j in combinations(range(50), 2):
        raw = hypothesis(p_a, p_b, i, j)
        if raw is not None and len(raw[1]) >= 2:
            most = max(most, len(settled(raw[0], raw[1], p_a, p_b)[1]))
    _, _, rows = most_supported(p_a, p_b, GATE_M, BASELINE_M, math.log(1e-9), 100_000, np.uint64(1))
    assert len(rows) >= most


def test_of_equal_support_the_nearer_wins():
    """Each of two motions has twenty supporters, one of them exactly."""
    rng = np.random.default_rng(8)
    p_b = rng.uniform(0, 10, (40, 3))
    exact, rough = np.array([1.0, 2.0, 0.3]), np.array([-4.0, 7.0, -2.0])
    p_a = se2.transform_points(rough, p_b)
    p_a += rng.uniform(-0.05, 0.05, p_a.shape)
    p_a[::2] = se2.transform_points(exact, p_b[::2])
    for seed in range(1, 20):
        _, T, rows = most_supported(p_a, p_b, GATE_M, BASELINE_M, LOG_MISS, 3000, np.uint64(seed))
        assert len(rows) == 20
        assert error(T, exact) == pytest.approx((0, 0), abs=1e-9)


def test_every_two_pairs_are_drawn_equally_often():
    state, drawn = np.uint64(12345), np.zeros((7, 7))
    for _ in range(42_000):
        state, i, j = draw_pair(np.uint64(state), 7)
        drawn[i, j] += 1
    assert np.trace(drawn) == 0
    assert chisquare(drawn[~np.eye(7, dtype=bool)]).pvalue > 1e-3


@pytest.mark.parametrize(("outliers", "least"), [(0.95, 100), (0.99, 95)])
def test_the_bar(outliers, least):
    """1000 pairs, noise 0.05 m: successes of 100, and the median error relative to the oracle."""
    estimated, refined, best = [], [], []
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        pair = given_pairs(rng, 1000, 1 - outliers, 0.05)
        maps = pair.map_a, pair.map_b, pair.correspondences
        alignment = as_aligner(Ransac()).align(*maps, rng)
        refinement = Refinement().refine(Pairs(*maps), alignment.T_a_b)
        estimated.append(error(alignment.T_a_b, pair.T_a_b))
        refined.append(error(refinement.T_a_b, pair.T_a_b))
        best.append(error(Oracle().align(Pairs(*maps), pair.is_true).T_a_b, pair.T_a_b))
    for errors in (np.array(estimated), np.array(refined)):
        assert np.sum(np.all(errors < (0.2, 0.05), axis=1)) >= least
        assert np.median(errors[:, 0]) <= 1.1 * np.median(np.array(best)[:, 0])


def test_false_pairs_are_left_out():
    rng = np.random.default_rng(5)
    pair = given_pairs(rng, 200, 0.4, 0.03)
    alignment = as_aligner(Ransac()).align(pair.map_a, pair.map_b, pair.correspondences, rng)
    assert alignment.status is Status.ACCEPTED
    assert np.mean(alignment.inlier[pair.is_true]) == 1.0
    assert np.sum(alignment.inlier & ~pair.is_true) <= 2


def test_heights_count_unless_planar():
    p = np.random.default_rng(6).uniform(0, 10, (20, 3))
    lifted = p + np.array([0, 0, 5.0])
    pairs = Correspondences(np.arange(20), np.arange(20), np.zeros(20))
    rng = np.random.default_rng(0)
    alignment = as_aligner(Ransac()).align(landmarks(p), landmarks(lifted), pairs, rng)
    assert alignment.status is Status.DEGENERATE
    assert "height" in alignment.reason
    flat = [landmarks(x, planar=True) for x in (p, lifted)]
    assert as_aligner(Ransac()).align(*flat, pairs, rng).ok


def test_support_is_within_the_gate_in_all_dimensions_there_are():
    """Residuals of 0.3 m in the plane and 0.4 m in height make 0.5 m."""
    p_a, p_b = np.array([[1.0, 2.0, 3.0]]), np.array([[1.3, 2.0, 3.4]])
    for gate_m, counted, counted_flat in ((0.29, 0, 0), (0.49, 0, 1), (0.51, 1, 1)):
        for points, n in (((p_a, p_b), counted), ((p_a[:, :2], p_b[:, :2]), counted_flat)):
            flat = [np.ascontiguousarray(each) for each in points]
            found, cost = list_supporters(np.zeros(3), *flat, gate_m, 0, np.empty(1, np.int64))
            assert found == n
            assert cost == pytest.approx(n * (0.09 + 0.16 * (len(points[0][0]) == 3)))


def test_one_draw_from_the_generator_decides():
    pair = given_pairs(np.random.default_rng(7), 100, 0.3, 0.05)
    runs = [
        as_aligner(Ransac()).align(
            pair.map_a, pair.map_b, pair.correspondences, np.random.default_rng(s)
        )
        for s in (1, 1)
    ]
    assert runs[0].T_a_b.tobytes() == runs[1].T_a_b.tobytes()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gate_m", 0.0),
        ("min_baseline_m", float("nan")),
        ("confidence", 1.0),
        ("max_draws", 0),
    ],
)
def test_wrong_parameters_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        Ransac(**{name: value})
