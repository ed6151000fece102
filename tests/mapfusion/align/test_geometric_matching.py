"""Matching by geometry alone against known motions and against a slow search of all motions."""

import itertools
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.correspondences import HeightGate, match
from mapfusion.align.geometric_matching import (
    DISTINCT_M,
    Bins,
    Site,
    attributes_of_pairs_agree,
    both_directions,
    cast_votes,
    find_placements,
    fullest_bins,
    mutually_nearest,
    segment_lengths,
    segments_of,
    surprise,
)
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.se2 import compose, rms_distance_m, transform_points
from tests.mapfusion.align.made_fields import made_field

TOLERANCE_M, SIZE_TOLERANCE = 0.1, 0.25


def sites(field):
    height = HeightGate()
    bound = math.inf if field.map_a.planar else height.bound
    return [Site.of(each, bound, height.floor_m**2) for each in (field.map_a, field.map_b)]


def best_of(field):
    a, b = sites(field)
    return find_placements(a, b, TOLERANCE_M, SIZE_TOLERANCE)[0]


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("up_m", [0.0, 3.7])
def test_the_motion_and_the_height_offset_are_found(planar, up_m):
    field = made_field(np.random.default_rng(4), 60, 25, planar=planar, up_m=up_m)
    found = best_of(field)
    assert rms_distance_m(found.T_a_b, field.T_a_b, field.map_b.position_m[:, :2]) < 0.03
    assert found.up_m == pytest.approx(0.0 if planar else up_m, abs=0.02)
    assert field.share_of_true(found.index_a, found.index_b) > 0.9
    assert len(found.index_a) > 20


def test_exact_maps_give_the_exact_motion():
    field = made_field(np.random.default_rng(5), 40, 15, noise_m=0.0)
    found = best_of(field)
    assert rms_distance_m(found.T_a_b, field.T_a_b, field.map_b.position_m[:, :2]) < 1e-9


def test_a_moved_map_moves_the_answer():
    field = made_field(np.random.default_rng(6), 50, 20)
    moved = np.array([7.0, -2.0, 2.0])
    p = field.map_a.position_m.copy()
    p[:, :2] = transform_points(moved, p[:, :2])
    other = replace(field, map_a=replace(field.map_a, position_m=p))
    p_b = field.map_b.position_m[:, :2]
    expected = compose(moved, best_of(field).T_a_b)
    assert rms_distance_m(best_of(other).T_a_b, expected, p_b) < 1e-6


def slow_support(a, b, T, gate_m):
    """Count the landmarks of b that each have a landmark of a of their own within a gate."""
    moved = transform_points(T, b)
    distance = np.linalg.norm(a[:, None] - moved[None], axis=2)
    nearest = np.argmin(distance, axis=1)
    mutual = np.argmin(distance, axis=0)[nearest] == np.arange(len(a))
    return int(np.count_nonzero(mutual & (distance.min(axis=1) <= gate_m)))


@pytest.mark.parametrize("seed", range(3))
def test_no_motion_of_two_pairs_has_more_support(seed):
    """All motions of two landmarks of each map are tried, on maps small enough for that."""
    field = made_field(np.random.default_rng(seed), 14, 8, planar=True)
    a, b = (each.position_m[:, :2].copy() for each in (field.map_a, field.map_b))
    best, best_T = 0, np.zeros(3)
    for i, k in itertools.permutations(range(len(a)), 2):
        for j, m in itertools.combinations(range(len(b)), 2):
            if abs(np.linalg.norm(a[i] - a[k]) - np.linalg.norm(b[j] - b[m])) <= 0.1:
                T = np.array(fit_rigid(a[[i, k]], b[[j, m]], np.arange(2)))
                if (n := slow_support(a, b, T, TOLERANCE_M)) > best:
                    best, best_T = n, T
    found = best_of(field)
    assert rms_distance_m(found.T_a_b, best_T, b) < DISTINCT_M
    assert slow_support(a, b, found.T_a_b, TOLERANCE_M) >= best


def test_segments_are_all_pairs_of_a_small_map():
    field = made_field(np.random.default_rng(1), 20, 10)
    a, b = sites(field)
    shortest, longest = segment_lengths(a, b, TOLERANCE_M)
    found = segments_of(a, 0.0, 100.0)
    assert len(found.length) == 20 * 19 / 2
    expected = [np.linalg.norm(a.p[i] - a.p[j]) for i, j in found.ends]
    np.testing.assert_allclose(found.length, expected)
    assert longest > max(expected) or longest > max(segments_of(b, 0.0, 100.0).length)
    assert shortest == pytest.approx(1.0)


@pytest.mark.parametrize("turn_rad", [0.0, 2.0])
def test_votes_are_those_of_a_slow_count(turn_rad):
    field = made_field(np.random.default_rng(9), 30, 20, noise_m=0.01)
    a, b = sites(field)
    b = b._replace(p=transform_points(np.array([0, 0, field.T_a_b[2] + turn_rad]), b.p))
    n_theta, off_m, size_m = 60, 0.15, 0.2
    bins = Bins(2 * math.pi / n_theta, size_m, n_theta)
    of_a, of_b = both_directions(segments_of(a, 1.0, 8.0)), segments_of(b, 1.0, 8.0)
    centre = of_b.middle.mean(axis=0)
    expected = Counter()
    for e, f in itertools.product(range(len(of_a.length)), range(len(of_b.length))):
        z_m = of_a.rise[e] - of_b.rise[f]
        near = abs(of_a.length[e] - of_b.length[f]) <= off_m
        if not near or z_m**2 > of_a.most_z_m2[e] + of_b.most_z_m2[f]:
            continue
        theta = (of_a.theta_rad[e] - of_b.theta_rad[f]) % (2 * math.pi)
        at_m = of_a.middle[e] - transform_points(np.array([0, 0, theta]), of_b.middle[f] - centre)
        u, v = np.floor(at_m / size_m).astype(int)
        expected[int(theta / bins.theta_rad), u, v] += 1
    places, first = cast_votes((a, b), of_a, of_b, centre, bins, off_m, -1.0)
    theta = np.repeat(np.arange(n_theta), np.diff(first))
    assert Counter(zip(theta.tolist(), *places.T.tolist(), strict=True)) == expected
    around = list(itertools.product((-1, 0, 1), repeat=3))
    sums = {
        (t, u, v): sum(expected[(t + dt) % n_theta, u + du, v + dv] for dt, du, dv in around)
        for t, u, v in expected
    }
    most, best = max(sums.values()), fullest_bins(places, first, bins, 1)[0]
    # bins of one vote are not proposed, and places that share a slot add votes
    assert 0.98 * most <= best[0] <= 1.1 * most
    t, u, v = (best[1:] // (bins.theta_rad, size_m, size_m)).astype(int)
    assert sums[t, u, v] >= 0.9 * most


def test_sizes_raise_the_share_of_true_pairs():
    """The fields are so crowded that geometry alone pairs by chance."""
    shares = []
    for sizes in (False, True):
        each = []
        for seed in range(4):
            field = made_field(
                np.random.default_rng(seed), 120, 18, 3.0, 0.03, planar=True, sizes=sizes
            )
            found = match(field.map_a, field.map_b)
            each.append(field.share_of_true(found.index_a, found.index_b))
        shares.append(np.mean(each))
    assert shares[1] > 1.5 * shares[0]


def test_sizes_and_categories_agree_within_their_tolerance():
    field = made_field(np.random.default_rng(2), 5, 5)
    a, b = sites(field)
    a = a._replace(size_m=np.array([1.0, 1.0, 1.0, np.nan, 1.0]), category=np.arange(5))
    b = b._replace(
        size_m=np.array([1.3, 1.35, 0.74, 9.0, np.nan]), category=np.array([0, 1, 2, 3, -1])
    )
    rows = np.arange(5)
    agree = attributes_of_pairs_agree(a, b, rows, rows, SIZE_TOLERANCE)
    assert agree.tolist() == [True, False, False, True, True]
    b = b._replace(size_m=np.full(5, np.nan), category=np.array([1, 1, -1, 4, 4]))
    agree = attributes_of_pairs_agree(a, b, rows, rows, SIZE_TOLERANCE)
    assert agree.tolist() == [False, True, True, False, True]


def test_mutually_nearest_pairs_are_one_to_one():
    index_a, index_b = np.array([0, 0, 1, 2, 2]), np.array([5, 6, 6, 7, 8])
    kept = mutually_nearest(index_a, index_b, np.array([0.2, 0.1, 0.3, 0.4, 0.4]))
    assert kept.tolist() == [False, True, False, True, False]


def test_chernoff_bound_of_the_support():
    """exp(-surprise) bounds the Poisson tail from above, and is close to it."""
    from scipy.stats import poisson

    for count, expected in ((5, 1.0), (20, 3.0), (40, 30.0)):
        tail = poisson.sf(count - 1, expected)
        assert tail <= math.exp(-surprise(count, expected)) < 20 * tail
    assert surprise(2, 3.0) == 0.0


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_maps_too_small_for_a_motion(n):
    field = made_field(np.random.default_rng(3), 10, 10)
    few = field.map_b[np.arange(n)]
    assert len(match(field.map_a, few)) <= n * 4
    assert match(few, field.map_a).by_geometry == (n > 0)
