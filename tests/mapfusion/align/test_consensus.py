"""Tests of `mapfusion.align.consensus`."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from mapfusion.align.aligners import as_aligner, make_aligner
from mapfusion.align.alignment import Fit, Pairs, Status
from mapfusion.align.clique import Clique, CliqueSearch
from mapfusion.align.consensus import consistency_graphs, packed_rows
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.gnc import Gnc
from mapfusion.align.mahalanobis_gate import mean_variances, refit_to_support
from mapfusion.align.ransac import RansacMahalanobis, least_truncated_squares
from mapfusion.align.refinement import Oracle
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from tests.mapfusion.align.map_pairs import (
    blurred,
    error,
    given_pairs,
    landmarks,
    motion,
    moved,
    swapped,
)
from tests.mapfusion.align.slow_twins import draw, slow_consistency, slow_squares

NAMES = ["gnc", "clique", "ransac_mahalanobis"]
LOG_MISS = math.log(1e-4)
SUCCESS_M, SUCCESS_RAD = 0.2, 0.05
motions = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.14, 3.14)).map(np.array)


def estimate(aligner, pair, seed=0):
    if isinstance(aligner, str):
        aligner = make_aligner(aligner)
    return as_aligner(aligner).align(
        pair.map_a, pair.map_b, pair.correspondences, np.random.default_rng(seed)
    )


def with_noise_in_both(seed, n, true_share, sigma_m=0.05, drift_m=0.0):
    """Return a planar pair with noise in both maps; sigma_m per axis of a residual."""
    rng = np.random.default_rng(seed)
    share = sigma_m / math.sqrt(2)
    pair = given_pairs(rng, n, true_share, share, drift_m, planar=True)
    p_a = pair.map_a.position_m + rng.normal(0, share, (n, 3)) * [1, 1, 0]
    return replace(pair, map_a=landmarks(p_a, share, planar=True, name="a"))


@settings(max_examples=25)
@given(st.sampled_from(NAMES), st.integers(0, 1000), motions, motions)
def test_follows_the_frames_of_the_maps(name, seed, T_u_a, T_v_b):
    maps, pair = blurred(np.random.default_rng(seed), 60, 0.6)
    pair = replace(pair, map_a=maps[0], map_b=maps[1])
    other = replace(pair, map_a=moved(maps[0], T_u_a), map_b=moved(maps[1], T_v_b))
    found, found_other = estimate(name, pair), estimate(name, other)
    expected = se2.compose(se2.compose(T_u_a, found.T_a_b), se2.inverse(T_v_b))
    np.testing.assert_array_equal(found.inlier, found_other.inlier)
    assert error(found_other.T_a_b, expected) == pytest.approx((0, 0), abs=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_exchanged_maps_give_the_inverse(name):
    pair = with_noise_in_both(1, 100, 0.5)
    there, back = estimate(name, pair), estimate(name, swapped(pair))
    np.testing.assert_array_equal(there.inlier, back.inlier)
    assert error(se2.inverse(back.T_a_b), there.T_a_b) == pytest.approx((0, 0), abs=1e-9)


def normalised_errors(name, true_share, drift_m, parameters):
    """Return the NEES of the three parameters over the aligned pairs of maps."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        maps, pair = blurred(rng, 100, true_share, sigma_m=0.02)
        maps[1].position_m[:, :2] += rng.normal(0, drift_m, (100, 2))
        aligner = make_aligner(name, **parameters)
        found = estimate(aligner, replace(pair, map_a=maps[0], map_b=maps[1]), seed)
        difference = found.T_a_b - pair.T_a_b
        difference[2] = se2.wrap(difference[2])
        if error(found.T_a_b, pair.T_a_b)[0] < SUCCESS_M:
            yield difference @ np.linalg.solve(found.covariance, difference) / 3


@pytest.mark.parametrize("drift_m", [0.0, 0.1])
@pytest.mark.parametrize(
    ("name", "true_share", "parameters", "least"),
    [
        *[(name, 0.6, {}, 195) for name in [*NAMES, "ransac"]],
        # these are only right where all pairs are, and ICP where it happens to start well
        ("svd", 1.0, {"translation": "solved"}, 195),
        ("svd", 1.0, {"translation": "printed"}, 195),
        ("icp", 1.0, {}, 20),
    ],
)
def test_covariance_covers_the_error(name, true_share, parameters, least, drift_m):
    """Covariances differ in size and shape, while most methods use nearly equal weights."""
    nees = list(normalised_errors(name, true_share, drift_m, parameters))
    assert len(nees) >= least
    mean, variance = f_distribution.stats(3, 2 * 100 * true_share - 3)
    assert np.mean(nees) == pytest.approx(mean, abs=4 * np.sqrt(variance / len(nees)))


@pytest.mark.parametrize("name", ["clique", "ransac_mahalanobis"])
@pytest.mark.parametrize(("n", "outliers", "least"), [(1000, 0.99, 100), (60, 0.9, 99)])
def test_the_bars(name, n, outliers, least):
    """Successes of 100 on planar maps, and the median error relative to the oracle."""
    found, best = [], []
    for seed in range(100):
        pair = with_noise_in_both(seed, n, 1 - outliers)
        found.append(error(estimate(name, pair, seed).T_a_b, pair.T_a_b))
        oracle = Oracle().align(Pairs(pair.map_a, pair.map_b, pair.correspondences), pair.is_true)
        best.append(error(oracle.T_a_b, pair.T_a_b))
    assert np.sum(np.all(np.array(found) < (SUCCESS_M, SUCCESS_RAD), axis=1)) >= least
    assert np.median(found, axis=0)[0] <= 1.1 * np.median(best, axis=0)[0]


@pytest.mark.parametrize("name", ["clique", "ransac_mahalanobis"])
def test_five_thousand_pairs(name):
    """Run ten of the hundred pairs; the benchmark runs all."""
    for seed in range(10):
        pair = with_noise_in_both(seed, 5000, 0.01)
        found = error(estimate(name, pair, seed).T_a_b, pair.T_a_b)
        assert found[0] < SUCCESS_M
        assert found[1] < SUCCESS_RAD


@pytest.mark.parametrize("name", ["clique", "ransac_mahalanobis"])
def test_drift_does_not_lead_astray(name):
    for seed in range(20):
        pair = with_noise_in_both(seed, 500, 0.1, drift_m=0.1)
        assert error(estimate(name, pair, seed).T_a_b, pair.T_a_b)[0] < SUCCESS_M


@pytest.mark.parametrize("name", NAMES)
def test_heights_count_unless_planar(name):
    p = np.random.default_rng(6).uniform(0, 10, (20, 3))
    lifted = p + np.array([0, 0, 5.0])
    pairs = Correspondences(np.arange(20), np.arange(20), np.zeros(20))
    rng = np.random.default_rng(0)
    found = as_aligner(make_aligner(name)).align(landmarks(p), landmarks(lifted), pairs, rng)
    assert found.status is Status.DEGENERATE
    assert "height" in found.reason
    flat = [landmarks(x, planar=True) for x in (p, lifted)]
    assert as_aligner(make_aligner(name)).align(*flat, pairs, rng).ok


def test_clique_is_the_largest_set_that_agrees():
    """The best of all subsets of 14 pairs, by exhaustive search, gives the same result."""
    aligner = Clique(drift_sigma_m=0.0)
    bound = chi2.ppf(aligner.agreement_probability, 1)
    for seed in range(5):
        pair = with_noise_in_both(seed, 14, 6 / 14)
        a, b = pair.map_a.position_m[:, :2], pair.map_b.position_m[:, :2]
        difference = np.abs(
            np.linalg.norm(a[:, None] - a, axis=2) - np.linalg.norm(b[:, None] - b, axis=2)
        )
        agree = difference**2 <= bound * 2 * 0.05**2
        sets = (s for size in range(14, 1, -1) for s in combinations(range(14), size))
        largest = np.array(next(s for s in sets if agree[np.ix_(s, s)].all()))
        planar = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
        T, inside = np.array(fit_rigid(a, b, largest)), np.empty(14, dtype=bool)
        refit_to_support(T, planar, mean_variances(planar), 1e-12, aligner.bound, inside)
        found = estimate(aligner, pair)
        np.testing.assert_array_equal(found.inlier, inside)
        assert error(found.T_a_b, T) == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.parametrize("true_share", [0.9, 0.5, 0.25, 0.1])
def test_what_the_clique_leaves_out_changes_nothing(true_share, monkeypatch):
    """The search of the whole graph gives the same motion."""
    pair = with_noise_in_both(3, 400, true_share, drift_m=0.05)
    quick = estimate("clique", pair)
    monkeypatch.setattr("mapfusion.align.clique._WORTH_A_LOOK", 1.0)
    monkeypatch.setattr("mapfusion.align.clique._PART", 100)
    parts = estimate("clique", pair)
    monkeypatch.setattr("mapfusion.align.clique._PART", 400)
    monkeypatch.setattr("mapfusion.align.clique.may_contain_clique", lambda *_: True)
    whole = estimate("clique", pair)
    for found in (quick, parts):
        np.testing.assert_array_equal(found.inlier, whole.inlier)
        assert error(found.T_a_b, whole.T_a_b) == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.parametrize(("n_other", "none"), [(14, True), (30, False)])
def test_parts_without_half_as_large_a_clique_rule_out_another_motion(n_other, none):
    """A clique of more than half of 42 pairs would have more than ten in one of two parts."""
    n, motions = 200, {0: with_noise_in_both(1, 200, 1.0), 50: with_noise_in_both(2, 200, 1.0)}
    chance, sizes, position = with_noise_in_both(3, n, 0.0), {0: 42, 50: n_other}, {}
    for side in ("map_a", "map_b"):
        p = getattr(chance, side).position_m.copy()
        for first, pair in motions.items():
            members = slice(first, first + sizes[first])
            p[members] = getattr(pair, side).position_m[members]
        position[side] = replace(getattr(chance, side), position_m=p)
    search = CliqueSearch(
        Clique(), Pairs(**position, correspondences=chance.correspondences).in_plan()
    )
    search.offer(np.arange(42))
    assert search.none_in_parts([np.arange(0, n, 2), np.arange(1, n, 2)]) == none


@pytest.mark.parametrize("n_true", [190, 120])
def test_a_clique_that_the_sample_does_not_see_is_found(n_true):
    """Every third pair supports a second motion, including the whole sample of the clique."""
    n = 300
    pair, other = with_noise_in_both(1, n, 1.0), with_noise_in_both(2, n, 1.0)
    chance = with_noise_in_both(3, n, 0.0)
    position = {}
    for side in ("map_a", "map_b"):
        p = getattr(chance, side).position_m.copy()
        p[::3] = getattr(other, side).position_m[::3]
        true = np.setdiff1d(np.arange(n), np.arange(0, n, 3))[:n_true]
        p[true] = getattr(pair, side).position_m[true]
        position[side] = replace(getattr(pair, side), position_m=p)
    found = estimate(Clique(), replace(pair, **position))
    assert error(found.T_a_b, pair.T_a_b)[0] < SUCCESS_M


def slow_search(pairs, variance, bound, agreement, max_draws, seed):
    """Run a slow reference of the search with slow references of its parts."""
    n, state, draws, needed = len(pairs), seed, 0, max_draws
    agree, planar = slow_consistency(pairs.in_plan(), variance, agreement), pairs.in_plan()
    best_T, best_score, best_raw = None, 0.0, 0.0
    while draws < needed:
        draws += 1
        state = draw(state)
        i = ((state >> 32) * n) >> 32
        state = draw(state)
        j = ((state >> 32) * (n - 1)) >> 32
        j += j >= i
        lengths = [np.linalg.norm(p[i, :2] - p[j, :2]) for p in (pairs.p_a, pairs.p_b)]
        if not agree[i, j] or min(lengths) < 1.0:
            continue
        T = np.array(fit_rigid(pairs.p_a, pairs.p_b, np.array([i, j])))
        raw = scores(T, pairs, variance, bound)
        if np.sum(raw > 0) < 2 or np.sum(raw) <= best_raw:
            continue
        best_raw = np.sum(raw)
        refit_to_support(
            T, planar, mean_variances(planar), variance, bound, np.empty(n, dtype=bool)
        )
        score = scores(T, pairs, variance, bound)
        if np.sum(score > 0) >= 2 and np.sum(score) > best_score:
            best_T, best_score, count = T, np.sum(score), np.sum(score > 0)
            needed = min(needed, LOG_MISS / math.log1p(-count * (count - 1) / (n * (n - 1))))
    return draws, best_T


def scores(T_a_b, pairs, variance, bound):
    return np.maximum(bound - slow_squares(T_a_b, pairs, variance)[2], 0)


@pytest.mark.parametrize("seed", range(5))
def test_search_equals_its_twin(seed):
    maps, pair = blurred(np.random.default_rng(seed), 50, 0.2)
    pairs = Pairs(*maps, pair.correspondences)
    bound, agreement = float(chi2.ppf(0.99, 2)), float(chi2.ppf(0.99, 1))
    planar = pairs.in_plan()
    given = planar, mean_variances(planar), packed_rows(planar)
    draws, T = least_truncated_squares(
        *given, 0.0025, bound, agreement, 1.0, LOG_MISS, 3000, np.uint64(seed + 1)
    )
    slow_draws, slow_T = slow_search(pairs, 0.0025, bound, agreement, 3000, seed + 1)
    assert draws == slow_draws
    np.testing.assert_allclose(T, slow_T, atol=1e-9)


def test_a_sharp_landmark_is_held_to_more_than_a_blurred_one():
    """A residual of 0.5 m is support along the uncertain direction of a landmark only."""
    rng = np.random.default_rng(3)
    p = rng.uniform(0, 20, (40, 3)) * [1, 1, 0]
    off = p.copy()
    off[:3, 0] += 0.5
    map_a = landmarks(p, 0.02, planar=True)
    covariance = map_a.covariance_m2.copy()
    covariance[0, 0, 0] = 1.0  # along the way it is off
    covariance[1, 1, 1] = 1.0  # across
    map_a = replace(map_a, covariance_m2=covariance)
    map_b = landmarks(off, 0.02, planar=True)
    pairs = Correspondences(np.arange(40), np.arange(40), np.zeros(40))
    for name in NAMES:
        found = as_aligner(make_aligner(name, drift_sigma_m=0.05)).align(map_a, map_b, pairs, rng)
        assert found.inlier[0]
        assert not found.inlier[1:3].any()
        assert found.inlier[3:].all()


@pytest.mark.parametrize(
    ("aligner", "name", "value"),
    [
        (Gnc, "drift_sigma_m", -0.1),
        (Gnc, "probability", 1.0),
        (Clique, "agreement_probability", 0.0),
        (Clique, "max_nodes", 0),
        (Clique, "probability", float("nan")),
        (RansacMahalanobis, "min_baseline_m", 0.0),
        (RansacMahalanobis, "confidence", 1.0),
        (RansacMahalanobis, "max_draws", 0),
        (RansacMahalanobis, "drift_sigma_m", float("nan")),
    ],
)
def test_wrong_parameters_are_named(aligner, name, value):
    with pytest.raises(ValueError, match=name):
        aligner(**{name: value})


def test_what_was_settled_before_of_the_same_pairs_is_settled_so_again():
    """Results are kept for all seeds, separately for each set of parameters."""
    pair = given_pairs(np.random.default_rng(3), 80, 0.6, 0.05)
    maps = pair.map_a, pair.map_b, pair.correspondences
    pairs, methods = Pairs(*maps), [RansacMahalanobis(), RansacMahalanobis(probability=0.9)]
    methods.append(RansacMahalanobis(drift_sigma_m=0.3))
    settled = {}
    for seed in range(5):
        for method in methods:
            found = method.find(pairs, np.random.default_rng(seed))
            alone = method.find(Pairs(*maps), np.random.default_rng(seed))
            assert isinstance(found, Fit)
            assert isinstance(alone, Fit)
            for name in ("T_a_b", "inlier", "weight"):
                np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))
            settled[id(found)] = found
    assert len(methods) <= len(settled) < 5 * len(methods)


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
    found = unpacked(consistency_graphs(packed_rows(pairs), scales, BOUND), n)
    for graph, variance in zip(found, scales, strict=True):
        np.testing.assert_array_equal(graph, slow_consistency(pairs, variance, BOUND))
        np.testing.assert_array_equal(graph, graph.T)


def test_single_precision_loses_no_pair():
    """Landmarks 1 km from the origin are more precise than single precision there."""
    (map_a, map_b), pair = blurred(np.random.default_rng(3), 200, true_share=1.0, sigma_m=1e-7)
    maps = [replace(m, position_m=50 * m.position_m) for m in (map_a, map_b)]
    maps = [replace(m, covariance_m2=2500 * m.covariance_m2) for m in maps]
    pairs = Pairs(*maps, pair.correspondences).in_plan()
    found = unpacked(consistency_graphs(packed_rows(pairs), (0.0, 1e-12), BOUND), 200)
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
        graph = consistency_graphs(packed_rows(pairs), (drift_m**2, 0.01), BOUND)[:1]
        disagreeing.append(1 - np.sum(unpacked(graph, n)) / (n * (n - 1)))
    # one landmark is in 199 comparisons: the scatter over the maps tells how sure the mean is
    sure = 4 * np.std(disagreeing) / np.sqrt(30)
    assert np.mean(disagreeing) == pytest.approx(0.001, abs=sure + 1e-4)


def test_does_not_depend_on_the_frames():
    rng = np.random.default_rng(1)
    (map_a, map_b), pair = blurred(rng, 150)
    graphs = [
        consistency_graphs(
            packed_rows(Pairs(a, b, pair.correspondences).in_plan()), (0.0, 0.01), BOUND
        )
        for a, b in ((map_a, map_b), (moved(map_a, motion(rng)), moved(map_b, motion(rng))))
    ]
    np.testing.assert_array_equal(*graphs)


def test_exact_maps_without_covariance_agree():
    """Distances of landmarks 1 km from the origin differ by rounding only."""
    rng = np.random.default_rng(2)
    pair = given_pairs(rng, 100, planar=True, T_a_b=np.array([1000.0, -700.0, 2.0]))
    pairs = Pairs(pair.map_a, pair.map_b, pair.correspondences).in_plan()
    graph = unpacked(consistency_graphs(packed_rows(pairs), (1e-12, 0.01), BOUND), 100)[0]
    assert np.sum(graph) == 100 * 99
