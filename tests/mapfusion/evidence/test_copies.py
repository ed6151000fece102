"""Which landmarks lie in places that a motion lays on their like."""

import numpy as np

from mapfusion.align.nearest_neighbours import Grid
from mapfusion.verification.parameters import EvidenceParameters
from mapfusion.verification.regions import Witness, Witnesses
from mapfusion.verification.rivals import BETWEEN, Copies, about_each, laid_on_like, of_others
from tests.mapfusion.evidence.two_rooms import Wall, between, mapped


def test_equals_the_slow_twin() -> None:
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.uniform(0, 4, (300, 2)), rng.uniform(1, 2, (80, 2))])
    found = rng.random(380) < np.where(np.hypot(*(p - 1.5).T) < 0.7, 0.6, 0.1)
    near = np.linalg.norm(p[:, None] - p, axis=2) <= 0.5
    hits = near @ found.astype(int)
    expected = (hits >= 5) & (hits >= 0.3 * near.sum(axis=1))
    grid, every = Grid.of(p), np.ones(len(p), np.bool_)
    np.testing.assert_array_equal(about_each(found, grid), hits)
    laid = laid_on_like(found, about_each(every, grid), grid)
    np.testing.assert_array_equal(laid, expected)
    assert 20 < laid.sum() < 300


def test_a_picture_that_hangs_twice_is_marked_at_both_places_and_nothing_else() -> None:
    wall = Wall(16, seed=1, copies=[(2, 2.0, 9.0)])
    a = Witness(mapped(wall, 1, 14, seed=2))
    witnesses = Witnesses(a, Witness(mapped(wall, 1, 14, seed=3)), EvidenceParameters())
    onto_itself = witnesses.copies("a", between(9, 2))
    x = 1 - a.landmarks.position_m[:, 1]  # the map's y is the world's -x
    picture = ((x > 2.2) & (x < 3.8)) | ((x > 9.2) & (x < 10.8))
    away = (x < 1.5) | ((x > 4.5) & (x < 8.5)) | (x > 11.5)
    assert onto_itself.in_a[picture].mean() > 0.95
    assert not onto_itself.in_a[away].any()
    assert not onto_itself.in_b.any()
    there = witnesses.copies(BETWEEN, np.zeros(3))
    assert there.in_a.mean() > 0.95
    assert there.in_b.mean() > 0.95


def test_of_several_motions_all_count_but_one_s_own() -> None:
    each = [Copies(np.arange(3) == k, np.arange(2) == k) for k in range(3)]
    others = of_others(each, 1)
    assert others.in_a.tolist() == [True, False, True]
    assert others.in_b.tolist() == [True, False]
