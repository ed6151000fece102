"""Pairs joined to points, against what every order of maps must have in common."""

import itertools

import numpy as np

from mapfusion.fusion.aligned_landmarks import Pair, joined

SIZES = [12, 9, 11]


def _pairs(seed: int) -> list[Pair]:
    rng, pairs = np.random.default_rng(seed), []
    for a, b in itertools.combinations(range(3), 2):
        rows = rng.integers(0, SIZES[a], 10), rng.integers(0, SIZES[b], 10)
        pairs.append(Pair(a, b, *rows, rng.random(10)))
    return pairs


def _as_sets(points: np.ndarray, order: tuple[int, ...] = (0, 1, 2)) -> set[frozenset]:
    """Each point as the set of its landmarks (map, row)."""
    return {
        frozenset((order[k], int(row)) for k, row in enumerate(own) if row >= 0) for own in points
    }


def _one_by_one(pairs: list[Pair]) -> set[frozenset]:
    """The slow obvious version: sets of landmarks, united while no map is in both."""
    points = [{(k, row)} for k, size in enumerate(SIZES) for row in range(size)]
    every = [
        (unlike, (pair.a, int(i)), (pair.b, int(j)))
        for pair in pairs
        for i, j, unlike in zip(pair.row_a, pair.row_b, pair.unlike, strict=True)
    ]
    for _, i, j in sorted(every):
        one, other = (next(own for own in points if which in own) for which in (i, j))
        if one is not other and not {k for k, _ in one} & {k for k, _ in other}:
            points.remove(other)
            one |= other
    return {frozenset(own) for own in points}


def test_equals_sets_united_one_by_one() -> None:
    for seed in range(20):
        pairs = _pairs(seed)
        points = joined(pairs, SIZES)
        assert _as_sets(points) == _one_by_one(pairs)
        several = np.count_nonzero(points >= 0, axis=1) > 1
        assert not np.any(np.diff(several.astype(int)) > 0)  # those of one map come last


def test_the_order_of_maps_makes_no_difference() -> None:
    pairs = _pairs(0)
    expected = _as_sets(joined(pairs, SIZES))
    for order in itertools.permutations(range(3)):
        place = {k: at for at, k in enumerate(order)}
        turned = [pair._replace(a=place[pair.a], b=place[pair.b]) for pair in reversed(pairs)]
        assert _as_sets(joined(turned, [SIZES[k] for k in order]), order) == expected


def test_without_pairs_each_landmark_is_a_point() -> None:
    assert len(joined([], SIZES)) == sum(SIZES)
