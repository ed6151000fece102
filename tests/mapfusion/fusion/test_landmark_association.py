"""Tests of `mapfusion.fusion.landmark_association`."""

import itertools

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align.correspondences import HeightGate
from mapfusion.fusion.kalman import kalman_update
from mapfusion.fusion.landmark_association import (
    ABSENT,
    AlignedLandmarks,
    AssociationTest,
    CandidatePairs,
    cluster_landmarks,
)
from mapfusion.tables import NO_LABEL

SIZES = [12, 9, 11]


def _pairs(seed: int) -> list[CandidatePairs]:
    rng, pairs = np.random.default_rng(seed), []
    for a, b in itertools.combinations(range(3), 2):
        rows = rng.integers(0, SIZES[a], 10), rng.integers(0, SIZES[b], 10)
        pairs.append(CandidatePairs(a, b, *rows, rng.random(10)))
    return pairs


def _as_sets(points: np.ndarray, order: tuple[int, ...] = (0, 1, 2)) -> set[frozenset]:
    """Each point as the set of its landmarks (map, row)."""
    return {
        frozenset((order[k], int(row)) for k, row in enumerate(own) if row >= 0) for own in points
    }


def _one_by_one(pairs: list[CandidatePairs]) -> set[frozenset]:
    """The slow obvious version: sets of landmarks, united while no map is in both."""
    points = [{(k, row)} for k, size in enumerate(SIZES) for row in range(size)]
    every = [
        (dissimilarity, (pair.a, int(i)), (pair.b, int(j)))
        for pair in pairs
        for i, j, dissimilarity in zip(pair.row_a, pair.row_b, pair.dissimilarity, strict=True)
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
        points = cluster_landmarks(pairs, SIZES)
        assert _as_sets(points) == _one_by_one(pairs)
        several = np.count_nonzero(points >= 0, axis=1) > 1
        assert not np.any(np.diff(several.astype(int)) > 0)  # those of one map come last


def test_the_order_of_maps_makes_no_difference() -> None:
    pairs = _pairs(0)
    expected = _as_sets(cluster_landmarks(pairs, SIZES))
    for order in itertools.permutations(range(3)):
        place = {k: at for at, k in enumerate(order)}
        turned = [pair._replace(a=place[pair.a], b=place[pair.b]) for pair in reversed(pairs)]
        assert _as_sets(cluster_landmarks(turned, [SIZES[k] for k in order]), order) == expected


def test_without_pairs_each_landmark_is_a_point() -> None:
    assert len(cluster_landmarks([], SIZES)) == sum(SIZES)


def drawn(seed: int, n: int, n_labels: int) -> AlignedLandmarks:
    """Draw landmarks of different accuracy in a square of 4 m; the first `n_labels` have labels.

    Their descriptors are unit vectors in a plane, so that many are alike.
    """
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 3, 3)) * rng.choice([0.01, 0.05, 0.4], (n, 1, 1))
    angle = rng.uniform(0, 1.5, n)
    look = np.zeros((n, 64), np.float32)
    look[:, 0], look[:, 1] = np.cos(angle), np.sin(angle)
    label = np.full(n, NO_LABEL, np.int32)
    label[:n_labels] = rng.permutation(2 * n_labels)[:n_labels]
    return AlignedLandmarks(
        rng.uniform(0, [4, 4, 0.5], (n, 3)),
        root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(3),
        rng.choice([0.0, 0.01, 0.2], n),
        rng.integers(3, 9, n).astype(np.int32),
        look,
        label,
        np.arange(n)[:, None],
    )


def slow_candidates(
    test: AssociationTest, a: AlignedLandmarks, b: AlignedLandmarks
) -> dict[tuple[int, int], float]:
    """Return the pairs that pass, with the distances of their descriptors."""
    found = {}
    gate, most_up = chi2.ppf(test.gate_probability, 2), chi2.ppf(test.height.probability, 1)
    for i in range(len(a)):
        for j in range(len(b)):
            if a.label[i] != NO_LABEL and b.label[j] != NO_LABEL:
                if a.label[i] == b.label[j]:
                    found[i, j] = 0.0
                continue
            S = a.covariance_m2[i, :2, :2] + b.covariance_m2[j, :2, :2]
            S = S + (a.drift_m2[i] + b.drift_m2[j]) * np.eye(2)
            off = (a.position_m[i] - b.position_m[j])[:2]
            if off @ np.linalg.solve(S, off) > gate:
                continue
            up = a.position_m[i, 2] - b.position_m[j, 2]
            variance = a.covariance_m2[i, 2, 2] + b.covariance_m2[j, 2, 2]
            variance += test.height.floor_m**2
            if not test.planar and up**2 > most_up * variance:
                continue
            dissimilarity = float(np.linalg.norm(a.descriptor[i] - b.descriptor[j]))
            if dissimilarity <= test.max_descriptor_distance:
                found[i, j] = dissimilarity
    return found


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_candidates_are_those_of_all_pairs(seed: int, planar: bool) -> None:
    a, b = drawn(2 * seed, 40, 15), drawn(2 * seed + 1, 50, 20)
    test = AssociationTest(0.3, 0.99, HeightGate(0.99, 0.1), planar)
    i, j, dissimilarity = test.candidates(a, b)
    found = dict(zip(zip(i.tolist(), j.tolist(), strict=True), dissimilarity.tolist(), strict=True))
    expected = slow_candidates(test, a, b)
    assert found.keys() == expected.keys()
    assert len(found) == len(i)
    for pair, its in expected.items():
        assert found[pair] == pytest.approx(its, abs=1e-6)
    assert 0 < sum(its == 0 for its in expected.values()) < len(expected)


@pytest.mark.parametrize("planar", [False, True])
def test_the_test_does_not_ask_who_comes_first(planar: bool) -> None:
    a, b = drawn(10, 60, 10), drawn(11, 50, 30)
    test = AssociationTest(0.3, 0.99, HeightGate(0.99, 0.1), planar)
    there, back = test.candidates(a, b), test.candidates(b, a)
    assert set(zip(there[0], there[1], strict=True)) == set(zip(back[1], back[0], strict=True))


def test_a_fused_landmark_drifts_as_the_better_parent_whichever_comes_first() -> None:
    a, b = drawn(20, 30, 0), drawn(21, 30, 0)
    blank = np.full((30, 1), ABSENT)
    a, b = (
        AlignedLandmarks(
            *(own.position_m, own.covariance_m2, own.drift_m2, own.count),
            *(own.descriptor, own.label),
            np.concatenate([own.parents, blank][::order], axis=1),
        )
        for own, order in ((a, 1), (b, -1))
    )
    rows, others = np.arange(0, 20), np.arange(10, 30)[::-1]
    one = a.fuse_with(b, rows, others, 3, kalman_update)
    two = b.fuse_with(a, others, rows, 3, kalman_update)
    by_parents = {
        tuple(parents): drift for parents, drift in zip(two.parents, two.drift_m2, strict=True)
    }
    for parents, drift in zip(one.parents.tolist(), one.drift_m2, strict=True):
        own = [each.drift_m2[k] for each, k in zip((a, b), parents, strict=True) if k != ABSENT]
        assert drift == min(own) == by_parents[tuple(parents)]
