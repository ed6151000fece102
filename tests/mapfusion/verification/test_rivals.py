"""Tests of `mapfusion.verification.rivals`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage

from mapfusion.align.nearest_neighbours import Grid
from mapfusion.align.refinement import Refinement
from mapfusion.descriptors import USURF
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.regions import EvidenceParameters, ViewedMap, ViewedMapPair
from mapfusion.verification.rivals import (
    BETWEEN,
    RepeatedLandmarks,
    count_neighbours,
    explained_landmarks,
    longest_patch_side_m,
    mark_repeated,
    repeated_under_others,
    rms_distance_m,
    self_motions,
    similar_landmarks,
)
from tests.mapfusion.verification.two_rooms import Wall, between, mapped


def test_equals_the_slow_twin() -> None:
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.uniform(0, 4, (300, 2)), rng.uniform(1, 2, (80, 2))])
    found = rng.random(380) < np.where(np.hypot(*(p - 1.5).T) < 0.7, 0.6, 0.1)
    near = np.linalg.norm(p[:, None] - p, axis=2) <= 0.5
    hits = near @ found.astype(int)
    expected = (hits >= 5) & (hits >= 0.3 * near.sum(axis=1))
    grid, every = Grid.of(p), np.ones(len(p), np.bool_)
    np.testing.assert_array_equal(count_neighbours(found, grid), hits)
    laid = mark_repeated(found, count_neighbours(every, grid), grid)
    np.testing.assert_array_equal(laid, expected)
    assert 20 < laid.sum() < 300


def test_a_picture_that_hangs_twice_is_marked_at_both_places_and_nothing_else() -> None:
    wall = Wall(16, seed=1, copies=[(2, 2.0, 9.0)])
    a = ViewedMap(mapped(wall, 1, 14, seed=2))
    viewed_maps = ViewedMapPair(a, ViewedMap(mapped(wall, 1, 14, seed=3)), EvidenceParameters())
    onto_itself = viewed_maps.copies("a", between(9, 2))
    x = 1 - a.landmarks.position_m[:, 1]  # the map's y is the world's -x
    picture = ((x > 2.2) & (x < 3.8)) | ((x > 9.2) & (x < 10.8))
    away = (x < 1.5) | ((x > 4.5) & (x < 8.5)) | (x > 11.5)
    assert onto_itself.in_a[picture].mean() > 0.95
    assert not onto_itself.in_a[away].any()
    assert not onto_itself.in_b.any()
    there = viewed_maps.copies(BETWEEN, np.zeros(3))
    assert there.in_a.mean() > 0.95
    assert there.in_b.mean() > 0.95


def test_of_several_motions_all_count_but_one_s_own() -> None:
    each = [RepeatedLandmarks(np.arange(3) == k, np.arange(2) == k) for k in range(3)]
    others = repeated_under_others(each, 1)
    assert others.in_a.tolist() == [True, False, True]
    assert others.in_b.tolist() == [True, False]


def random_map(n: int, seed: int) -> LandmarkMap:
    rng = np.random.default_rng(seed)
    descriptor = rng.standard_normal((n, 64)).astype(np.float32) * 0.05
    descriptor[3] = np.nan
    covariance = np.tile(0.01 * np.eye(3), (n, 1, 1))
    counts = np.full(n, 3, np.int32)
    about = covariance, counts, np.arange(n), descriptor
    return LandmarkMap(rng.uniform(0, 4, (n, 3)), *about, descriptor_kind=USURF)


def test_equals_all_pairs() -> None:
    landmarks = random_map(600, 1)
    p, descriptor = landmarks.position_m, landmarks.descriptor
    assert descriptor is not None
    unlike = np.linalg.norm(descriptor[:, None] - descriptor, axis=2)
    near = np.linalg.norm(p[:, None, :2] - p[None, :, :2], axis=2) < 1.0
    dz2 = (p[:, None, 2] - p[None, :, 2]) ** 2
    level = dz2 <= 10.827566170662733 * (0.02 + 2 * 0.004**2)  # chi-square, 0.999
    unlike[near | ~level | np.isnan(unlike)] = np.inf
    best = unlike.argmin(axis=1)
    rows = np.flatnonzero((best[best] == np.arange(600)) & (unlike.min(axis=1) <= 0.6))
    found = similar_landmarks(landmarks)
    np.testing.assert_array_equal(found.index_a, rows)
    np.testing.assert_array_equal(found.index_b, best[rows])
    assert len(rows) > 50


def test_a_picture_that_hangs_twice_is_found_and_one_that_hangs_once_is_not() -> None:
    twice = mapped(Wall(16, seed=1, copies=[(2, 1.5, 9.0)]), 1, 14, seed=2)
    once = mapped(Wall(16, seed=1), 1, 14, seed=2)
    for landmarks, repeats in ((twice, True), (once, False)):
        pairs, motions = self_motions(landmarks, 2, Acceptance(), Refinement())
        best = min((each.log10_false_alarms for each in motions), default=0.0)
        assert (best < -3) == repeats
        if repeats:
            np.testing.assert_allclose(np.abs(motions[0].T_a_b), [0, 7, 0], atol=0.05)
            p = np.ascontiguousarray(pairs.p_a[motions[0].inlier, :2])
            assert longest_patch_side_m(p, 0.7, 5) == pytest.approx(1.5, abs=0.3)


def test_patches_are_single_linkage_clusters() -> None:
    rng = np.random.default_rng(3)
    for n in (6, 40, 200):
        p = rng.uniform(0, 8, (n, 2))
        of = fcluster(linkage(p, "single"), 0.7, "distance")
        sizes = [np.ptp(p[of == k], axis=0).max() for k in np.unique(of) if (of == k).sum() >= 5]
        assert longest_patch_side_m(p, 0.7, 5) == pytest.approx(max(sizes, default=0.0))
    assert longest_patch_side_m(np.zeros((0, 2)), 0.7, 5) == 0.0


def test_a_room_that_is_its_own_half_turn_says_so_once() -> None:
    """Both orders of a pair fit the same half turn, and count as one pair."""
    rng = np.random.default_rng(4)
    p = rng.uniform(0, [8, 8, 2], (40, 3))
    look = (0.1 * rng.standard_normal((40, 64))).astype(np.float32)
    both = np.concatenate([p, [20.0, 12.0, 0.0] + p * [-1, -1, 1]])
    covariance = np.tile(1e-3 * np.eye(3), (80, 1, 1))
    counts, rows = np.full(80, 3, np.int32), np.arange(80)
    landmarks = LandmarkMap(both, covariance, counts, rows, np.concatenate([look, look]))
    pairs, (motion, *_) = self_motions(landmarks, 1, Acceptance(), Refinement())
    assert len(pairs) == 80
    assert motion.inlier.all()
    np.testing.assert_allclose(motion.T_a_b[:2], [20, 12], atol=1e-6)
    one_order = pairs[pairs.index_a < pairs.index_b]
    refined = Refinement().refine(one_order, motion.T_a_b)
    expected = Acceptance().verify(one_order, refined).log10_false_alarms
    assert motion.log10_false_alarms == pytest.approx(expected, rel=1e-6)
    assert expected < -20


def test_motions_lie_apart_by_the_root_mean_square_over_the_points() -> None:
    """A turn by an angle t moves a point at distance r from the origin by 2 r sin(t / 2)."""
    p = np.array([[1.0, 0.0], [0.0, -2.0], [3.0, 4.0]])
    shift = np.array([0.3, -0.4, 0.0])
    assert rms_distance_m(shift, np.zeros(3), p) == pytest.approx(0.5)
    turn = np.array([0.0, 0.0, 0.6])
    expected = 2 * np.sin(0.3) * np.sqrt((1 + 4 + 25) / 3)
    assert rms_distance_m(turn, np.zeros(3), p) == pytest.approx(expected)
    assert rms_distance_m(np.zeros(3), turn, p) == pytest.approx(expected)


def test_explained_landmarks_equal_the_slow_twin() -> None:
    rng = np.random.default_rng(3)
    maps, T_a_b = [], np.array([0.3, -0.2, 0.1])
    for n in (60, 50):
        about = np.tile(1e-4 * np.eye(3), (n, 1, 1)), np.ones(n, np.int32), np.arange(n)
        position_m = rng.uniform(0, 4, (n, 3))
        maps.append(LandmarkMap(position_m, *about, descriptor=rng.uniform(0, 0.18, (n, 64))))
    a, b = maps
    moved = b.position_m[:, :2] @ se2.rotation(T_a_b[2]).T + T_a_b[:2]
    near = np.linalg.norm(a.position_m[:, None, :2] - moved, axis=2) <= 0.4
    assert a.descriptor is not None
    assert b.descriptor is not None
    alike = np.linalg.norm(a.descriptor[:, None] - b.descriptor, axis=2) <= 0.6
    found = explained_landmarks(a, b, T_a_b, 0.4)
    np.testing.assert_array_equal(found, (near & alike).any(axis=0))
    bare = (replace(own, descriptor=None) for own in maps)
    np.testing.assert_array_equal(explained_landmarks(*bare, T_a_b, 0.4), near.any(axis=0))
    assert 10 < found.sum() < near.any(axis=0).sum() < 50
