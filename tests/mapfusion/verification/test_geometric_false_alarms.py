"""The a-contrario test by geometry: its terms against exact values, and its law on random maps."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy

from mapfusion.align.aligners import make_aligner
from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.correspondences import MatchParameters, match
from mapfusion.align.geometric_matching import Site
from mapfusion.align.refinement import Refinement
from mapfusion.geometry.se2 import inverse, rms_distance_m, transform_points
from mapfusion.verification.false_alarms import Acceptance
from mapfusion.verification.geometric_false_alarms import RandomPlacement
from mapfusion.verification.registration import Registration
from mapfusion.verification.rivals import is_mirrored
from tests.mapfusion.align.made_fields import made_field, mirrored
from tests.mapfusion.align.map_pairs import landmarks, motion, unit_vectors

REGISTRATION = Registration(make_aligner("clique"))


def registered(map_a, map_b):
    return REGISTRATION.register(map_a, map_b, match(map_a, map_b), np.random.default_rng(0))


def planar_site(p):
    n = len(p)
    return Site(p, np.zeros(n), np.full(n, np.inf), np.full(n, np.nan), np.full(n, -1))


@pytest.mark.parametrize("planar", [True, False])
def test_a_field_is_aligned_and_accepted(planar):
    field = made_field(np.random.default_rng(1), 70, 20, planar=planar)
    done = registered(field.map_a, field.map_b)
    assert done.verdict.status is Status.ACCEPTED
    assert "by geometry alone" in done.verdict.reason
    p_b = field.map_b.position_m[:, :2]
    assert rms_distance_m(done.refined.T_a_b, field.T_a_b, p_b) < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_a_mirrored_field_is_refused_and_named(seed):
    field = made_field(np.random.default_rng(seed), 60, 40)
    image = mirrored(field.map_b)
    done = registered(field.map_a, image)
    assert not done.verdict.accepted
    pairs = Pairs(field.map_a, image, match(field.map_a, image))
    assert is_mirrored(pairs, Acceptance(), Refinement(), MatchParameters())


def narrow_maps(rng, described):
    """Maps of landmarks along a corridor: two walls without descriptors, or a strip with them."""
    n, n_common, own = 80, 40, 20
    x, wall = rng.uniform(0, 40, n), np.where(rng.random(n) < 0.5, 0.0, 2.5)
    y = rng.uniform(0, 4, n) if described else wall + rng.normal(0, 0.05, n)
    look, T_a_b = unit_vectors(rng, n), motion(rng)
    maps = []
    rows_of_b = [*range(n_common), *range(n - own, n)]
    for name, rows, T in (("a", range(n - own), np.zeros(3)), ("b", rows_of_b, T_a_b)):
        seen = transform_points(inverse(T), np.column_stack([x, y])[rows])
        p = np.column_stack([seen + rng.normal(0, 0.02, seen.shape), np.zeros(len(seen))])
        maps.append(landmarks(p, 0.02, look[rows] if described else None, planar=True, name=name))
    return maps[0], maps[1], T_a_b


@pytest.mark.parametrize(("described", "seeds"), [(True, (3, 5, 12, 22)), (False, (1, 10, 15))])
def test_landmarks_near_the_axis_of_a_mirror_are_not_enough(described, seeds):
    """The mirror images of these maps are beyond chance."""
    for seed in seeds:
        map_a, map_b, T_a_b = narrow_maps(np.random.default_rng(seed), described)
        right, image = (registered(map_a, each) for each in (map_b, mirrored(map_b)))
        assert right.verdict.accepted
        assert rms_distance_m(right.refined.T_a_b, T_a_b, map_b.position_m[:, :2]) < 0.1
        assert image.verdict.log10_false_alarms <= math.log10(Acceptance().false_alarms)
        assert image.verdict.status is Status.AMBIGUOUS
        assert image.verdict.reason.startswith("the mirror image of map b fits map a with ")


def test_landmarks_on_one_line_are_accepted():
    """A line is its own mirror image, which lays every landmark on the same place."""
    rng = np.random.default_rng(0)
    p = np.column_stack([rng.uniform(0, 30, 80), np.zeros((80, 2))])
    look = unit_vectors(rng, 80)
    for _ in range(5):
        noisy = [p + rng.normal(0, 0.1, p.shape) * [1, 1, 0] for _ in "ab"]
        maps = [landmarks(each, 0.1, look, planar=True) for each in noisy]
        assert registered(*maps).verdict.accepted


def test_number_of_false_alarms_on_random_maps():
    """At most epsilon of pairs without common ground reach an NFA of epsilon, at the best motion.

    The count of n pairs is below its 99.9 % quantile.
    """
    rng, n_pairs = np.random.default_rng(8), 60
    found = []
    for _ in range(n_pairs):
        field = made_field(rng, int(rng.integers(20, 60)), 0, planar=bool(rng.integers(2)))
        found.append(registered(field.map_a, field.map_b).verdict.log10_false_alarms)
    found = np.array(found)
    for epsilon in (0.03, 0.1, 0.3):
        count = np.count_nonzero(found <= math.log10(epsilon))
        assert count <= scipy.stats.binom.ppf(0.999, n_pairs, epsilon)
    # the bound is no empty one: it is within a few decades of the law
    assert np.nanmedian(found) < 6


def test_motions_of_two_pairs_are_counted():
    field = made_field(np.random.default_rng(2), 12, 6, planar=True)
    a, b = (each.position_m[:, :2].copy() for each in (field.map_a, field.map_b))
    null = RandomPlacement(planar_site(a), planar_site(b), 0.25)
    for gate_m in (0.1, 0.4):
        count = 0
        for i, k in itertools.permutations(range(12), 2):
            for j, m in itertools.combinations(range(12), 2):
                longer = np.linalg.norm(a[i] - a[k]) - np.linalg.norm(b[j] - b[m])
                count += abs(longer) <= 2 * gate_m
        assert 10 ** null.log10_motions(gate_m) == pytest.approx(count, rel=0.1)


def test_chance_of_agreeing_is_that_of_the_density():
    """A place lies within r of a uniform point with probability 1 - exp(-density pi r^2)."""
    rng, side_m = np.random.default_rng(3), 40.0
    a, b = rng.uniform(0, side_m, (800, 2)), rng.uniform(8, side_m - 8, (200, 2))
    null = RandomPlacement(planar_site(a), planar_site(b), 0.25)
    for gate_m in (0.2, 0.4):
        expected = 1 - math.exp(-800 / side_m**2 * math.pi * gate_m**2)
        found = null.chance_of_agreeing(np.zeros(3), 0.0, gate_m)
        assert found == pytest.approx(expected, rel=0.15)


def test_points_in_a_row_agree_by_chance_more_often():
    rng = np.random.default_rng(4)
    rows = [np.column_stack([rng.uniform(0, 40, 60), rng.normal(0, 0.02, 60)]) for _ in range(2)]
    along = RandomPlacement(planar_site(rows[0]), planar_site(rows[1]), 0.25)
    chance = along.chance_of_agreeing(np.zeros(3), 0.0, 0.1)
    assert chance == pytest.approx(1 - math.exp(-60 / 40 * 2 * 0.1), rel=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_rows_of_other_trees_are_not_accepted(seed):
    """Trees along two walls, planted at random: a motion lays wall on wall, but not trees."""
    rng = np.random.default_rng(seed)
    maps = []
    for name in "ab":
        x, y = rng.uniform(0, 30, 50), np.where(np.arange(50) % 2, 0.0, 6.0)
        p = np.column_stack([x, y, np.zeros(50)]) + rng.normal(0, 0.02, (50, 3))
        maps.append(landmarks(p, 0.03, planar=True, name=name))
    assert not registered(*maps).verdict.accepted


def test_an_orchard_is_ambiguous():
    """Trees on a grid: a shift by one row fits as well as the truth."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(8) * 4.0, np.arange(6) * 5.0)
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(48)])
    maps = [
        landmarks(grid + rng.normal(0, 0.03, grid.shape), 0.03, planar=True, name=name)
        for name in "ab"
    ]
    done = registered(*maps)
    assert done.verdict.status is Status.AMBIGUOUS


def test_sizes_make_a_crowded_field_certain():
    field = made_field(np.random.default_rng(7), 100, 16, 2.0, 0.02, planar=True, sizes=True)
    bare = [replace(each, size_m=None) for each in (field.map_a, field.map_b)]
    sized = registered(field.map_a, field.map_b).verdict.log10_false_alarms
    assert sized < registered(*bare).verdict.log10_false_alarms - 2


def test_supporters_of_a_crowded_field_are_one_to_one():
    """Pairs of rival motions share landmarks with those of the best one; a merge needs none."""
    field = made_field(np.random.default_rng(10), 150, 60, 3.0, 0.03, planar=True)
    pairs = match(field.map_a, field.map_b)
    done = registered(field.map_a, field.map_b)
    assert done.verdict.accepted
    used = pairs[done.refined.inlier]
    assert len(np.unique(pairs.index_a)) < len(pairs)
    assert len(np.unique(used.index_a)) == len(np.unique(used.index_b)) == len(used)
