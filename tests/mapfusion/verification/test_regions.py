"""Tests of `mapfusion.verification.regions`."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.nearest_neighbours import Grid
from mapfusion.geometry import se2
from mapfusion.verification.fitted_twins import WHOLE
from mapfusion.verification.likelihood import COPIED, OWN, TwinShares, log10_ratio
from mapfusion.verification.regions import (
    DescribedLandmarks,
    EvidenceParameters,
    MatchGates,
    RegionGrid,
    Regions,
    ViewedMap,
    ViewedMapPair,
    mark_matched,
)
from mapfusion.verification.rivals import BETWEEN, RepeatedLandmarks
from mapfusion.verification.verdict import _twin_shares
from tests.mapfusion.verification.two_rooms import Wall, between, mapped


def looks(rng: np.random.Generator, p: np.ndarray) -> DescribedLandmarks:
    descriptor = rng.integers(0, 3, (len(p), 8)).astype(np.float32)
    z_m2 = rng.uniform(0, 0.01, len(p))
    return DescribedLandmarks(Grid.of(p[:, :2]), p[:, 2].copy(), z_m2, descriptor)


@pytest.mark.parametrize("bound", [4.0, np.inf])
def test_equals_all_pairs(bound: float) -> None:
    rng = np.random.default_rng(0)
    p, q = rng.uniform(0, 3, (200, 3)), rng.uniform(0, 3, (300, 3))
    own, other = looks(rng, p), looks(rng, q)
    rows, gates = np.arange(0, 200, 3), MatchGates(0.5, bound, 0.01, 2.0)
    near = np.linalg.norm(p[rows][:, None, :2] - q[None, :, :2], axis=2) <= 0.5
    dz2 = (p[rows][:, None, 2] - q[None, :, 2]) ** 2
    level = dz2 <= bound * (own.z_m2[rows][:, None] + other.z_m2 + 0.01)
    unlike = np.linalg.norm(own.descriptor[rows][:, None] - other.descriptor, axis=2)
    expected = (near & level & (unlike <= 2.0)).any(axis=1)
    found = mark_matched(p, rows, own, other, gates)
    np.testing.assert_array_equal(found, expected)
    assert 10 < found.sum() < len(rows) - 5


def test_no_descriptor_is_found_nowhere() -> None:
    p = np.zeros((1, 3))
    own = DescribedLandmarks(
        Grid.of(p[:, :2]), np.zeros(1), np.ones(1), np.full((1, 8), np.nan, np.float32)
    )
    assert not mark_matched(p, np.arange(1), own, own, MatchGates(1.0, np.inf, 0.0, 9.0)).any()


WALL = Wall(16, seed=1)
A, B = (ViewedMap(mapped(WALL, *ends, seed=k)) for k, ends in enumerate(((1, 9), (5, 14))))
T_A_B = between(1, 5)
PARAMETERS, SHARES = EvidenceParameters(), TwinShares(0.05, 0.5)
SQUARES = RegionGrid(1.0, np.zeros(2))


def regions(T_a_b: np.ndarray, a: ViewedMap = A, b: ViewedMap = B):
    none = RepeatedLandmarks.none(len(a.landmarks), len(b.landmarks))
    return ViewedMapPair(a, b, PARAMETERS).regions(BETWEEN, T_a_b, SQUARES, none)


def test_the_right_motion_is_confirmed_everywhere() -> None:
    found = regions(T_A_B)
    assert len(found) >= 3
    assert found.n_confirmed == len(found)
    assert found.n_contradicted == 0
    assert found.log10_ratio(SHARES) > 3
    best = log10_ratio(found.found, found.expected, SHARES).max()
    assert found.log10_evidence(SHARES) >= found.log10_ratio(SHARES) - best
    assert found.count_confirmed(OWN) == (len(found) - 1, len(found) - 1)  # one of them found it


def test_of_missing_regions_the_one_that_agrees_best_is_no_sample() -> None:
    found, expected = np.zeros((3, 2, 2), np.int64), np.zeros((3, 2, 2), np.int64)
    expected[:, OWN, 0] = 20
    found[1, OWN, 0] = 19
    assert Regions(found, expected).count_confirmed(OWN) == (0, 2)


def test_a_motion_along_the_wall_is_contradicted_everywhere() -> None:
    found = regions(T_A_B + np.array([0.0, 1.5, 0.0]))
    sure = found.expected[:, OWN, 0] > 0  # not at the ends of the maps
    assert found.n_contradicted == np.sum(sure) >= 3
    assert found.log10_ratio(SHARES) < -3


@pytest.mark.parametrize("of", [BETWEEN, "a"])
def test_what_was_found_for_copies_gives_the_same_regions(of: str) -> None:
    none = RepeatedLandmarks.none(len(A.landmarks), len(B.landmarks))
    maps = A.landmarks, B.landmarks
    fresh, asked = (ViewedMapPair(*map(ViewedMap, maps), PARAMETERS) for _ in range(2))
    motions = T_A_B, T_A_B + np.array([0.0, 0.4, 0.0])
    for T in motions:
        asked.copies(of, T)
    for T in motions:
        expected, again = (each.regions(of, T, SQUARES, none) for each in (fresh, asked))
        np.testing.assert_array_equal(again.found, expected.found)
        np.testing.assert_array_equal(again.expected, expected.expected)
        assert len(expected) >= 3


def test_where_nothing_must_be_seen_nothing_is_said() -> None:
    found = regions(T_A_B + np.array([0.0, 40.0, 0.0]))
    assert len(found) == 0
    assert found.log10_ratio(SHARES) == 0.0


def test_the_other_way_round_as_many_are_found() -> None:
    there, back = regions(T_A_B), regions(se2.inverse(T_A_B), B, A)
    assert there.found.sum() == back.found.sum()
    assert there.expected.sum() == pytest.approx(back.expected.sum(), abs=10)  # cut differently


def test_of_another_wall_nothing_is_found() -> None:
    other = ViewedMap(mapped(Wall(16, seed=9), 5, 14, seed=3))
    found = regions(T_A_B, b=other)
    sure = found.expected[:, OWN, 0] > 0
    assert found.n_contradicted == np.sum(sure) >= 3


def changed(own: ViewedMap, position_m: np.ndarray, n_views: np.ndarray) -> ViewedMap:
    viewing = own.landmarks.viewing
    assert viewing is not None
    viewing = replace(viewing, n_views=n_views)
    return ViewedMap(replace(own.landmarks, position_m=position_m, viewing=viewing))


@pytest.mark.parametrize(("views", "scatter_m"), [(9, 0.0), (10, 0.0), (10, 1.0)])
def test_landmarks_on_no_wall_or_rarely_observed_may_be_missed(
    views: int, scatter_m: float
) -> None:
    """Nine observations of a landmark are too few, and a scatter across the wall hides it."""
    rng = np.random.default_rng(4)
    a, b = (
        changed(
            own,
            own.landmarks.position_m + rng.uniform(-scatter_m, scatter_m, (len(own.landmarks), 3)),
            np.full(len(own.landmarks), views, np.int32),
        )
        for own in (A, B)
    )
    must, may = regions(T_A_B, a, b).expected[:, OWN].sum(axis=0)
    plain = regions(T_A_B).expected[:, OWN].sum()
    if scatter_m:
        assert must < may / 10  # few stand in a row by chance
    else:
        assert must + may == plain
        assert (must > 100) == (views == 10)
        assert (must == 0) == (views == 9)


def test_copies_are_counted_apart_and_say_little() -> None:
    all_copies = RepeatedLandmarks(np.ones(len(A.landmarks), bool), np.ones(len(B.landmarks), bool))
    plain = regions(T_A_B)
    marked = ViewedMapPair(A, B, PARAMETERS).regions(BETWEEN, T_A_B, SQUARES, all_copies)
    np.testing.assert_array_equal(marked.found[:, COPIED], plain.found[:, OWN])
    assert not marked.expected[:, OWN].any()
    assert marked.count_confirmed(OWN) == (0, 0)
    assert marked.count_confirmed(COPIED) == plain.count_confirmed(OWN)
    assert 0 < marked.log10_ratio(TwinShares(0.05, 0.9)) < np.log10(1 / WHOLE) * len(marked)
    assert marked.log10_ratio(TwinShares(0.05, 0.9)) < plain.log10_ratio(TwinShares(0.05, 0.9)) / 2


@pytest.mark.parametrize("corner", [(0.0, 0.0), (0.7, -1.3), (1.0, 2.0)])
def test_one_picture_is_one_region_wherever_it_hangs(corner: tuple[float, float]) -> None:
    picture = np.random.default_rng(0).uniform(0, 0.99, (50, 2)) + corner
    squares = RegionGrid.about(np.column_stack([picture, np.ones(50)]), 1.0)
    assert len(np.unique(squares.of(picture))) == 1
    # of a plane of points each square of a metre has its own
    x, y = np.meshgrid(np.arange(0.25, 5, 0.5), np.arange(0.25, 3, 0.5))
    plane = np.column_stack([x.ravel(), y.ravel()]) + squares.middle + 0.5
    np.testing.assert_array_equal(np.bincount(squares.of(plane)), np.full(15, 4))


def test_without_supporters_squares_lie_about_the_origin() -> None:
    np.testing.assert_array_equal(RegionGrid.about(np.zeros((0, 3)), 2.0).middle, [0, 0])
    assert len(SQUARES.of(np.zeros((0, 2)))) == 0


def _regions(n_confirmed: int, n_contradicted: int, part: int) -> Regions:
    """Return regions with twenty landmarks that must be seen, all of them matched or none."""
    n = n_confirmed + n_contradicted
    expected, found = np.zeros((n, 2, 2), np.int64), np.zeros((n, 2, 2), np.int64)
    expected[:, part, 0] = 20
    found[:n_confirmed, part, 0] = 20
    made = Regions(found, expected)
    assert (made.n_confirmed, made.n_contradicted) == (n_confirmed, n_contradicted)
    return made


def test_shares_of_twins_count_regions_under_wrong_motions() -> None:
    """The best motion between the maps is left out, and the best region of each other motion.

    The prior counts are 0.44 of 3.85 regions, and 1.14 of 6.1 copies.
    """
    right, wrong = _regions(6, 0, OWN), [_regions(3, 2, OWN), _regions(1, 3, OWN)]
    onto_itself = _regions(4, 1, COPIED)
    found = _twin_shares([wrong[0], right, wrong[1]], [onto_itself])
    assert found.own == pytest.approx((0.44 + 2 + 0) / (3.85 + 4 + 3))
    assert found.copied == pytest.approx((1.14 + 3) / (6.1 + 4))
    assert _twin_shares([right], []) == pytest.approx((0.44 / 3.85, 1.14 / 6.1))
    own_alone = _twin_shares([right], [_regions(4, 1, OWN)])
    assert own_alone == pytest.approx((0.44 / 3.85, 1.14 / 6.1))
