"""The number of false alarms against its formula, count by count."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import binom

from mapfusion.geometry import se2
from mapfusion.verification.false_alarms import (
    agreeing_repairings,
    chance_of_agreeing,
    fewest_false_alarms,
    independent_pairs,
    log10_tail,
    minimal_motion,
    thin,
)
from tests.mapfusion.align.map_pairs import given_pairs

GATES_M = np.array([0.05, 0.1, 0.2, 0.4])


@pytest.mark.parametrize(("n", "p"), [(5, 0.3), (40, 0.004), (300, 0.01), (2000, 0.05), (1, 0.5)])
def test_tail_is_the_binomials(n, p):
    for k in range(n + 1):
        expected = binom.logsf(k - 1, n, p) / math.log(10)
        if k <= n * p:
            assert log10_tail(k, n, p) == 0.0  # said to be certain, which it at most is
        elif expected > -290:
            assert log10_tail(k, n, p) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_tail_beyond_the_range_of_floats():
    n, k, p = 900, 400, Fraction(1, 256)
    exact = sum(math.comb(n, m) * p**m * (1 - p) ** (n - m) for m in range(k, n + 1))
    log10 = math.log10(exact.numerator >> 3000) + 3000 * math.log10(2)
    log10 -= math.log10(exact.denominator >> 5000) + 5000 * math.log10(2)
    assert log10 < -400
    assert log10_tail(k, n, float(p)) == pytest.approx(log10, rel=1e-12)


def test_thinning_keeps_the_first_of_neighbours_in_both_maps():
    rng = np.random.default_rng(0)
    p_a, p_b = rng.uniform(0, 2, (200, 3)), rng.uniform(0, 2, (200, 3))
    p_b[::3] = p_a[::3] + 5  # a third agrees, so that neighbours in one are so in the other
    kept = []
    for i in range(200):
        near = [
            max(np.linalg.norm(p_a[i] - p_a[j]), np.linalg.norm(p_b[i] - p_b[j])) < 0.4
            for j in kept
        ]
        if not any(near):
            kept.append(i)
    assert 100 < len(kept) < 195
    np.testing.assert_array_equal(thin(p_a, p_b, 0.4), kept)
    np.testing.assert_array_equal(thin(p_a, p_b, 0.0), np.arange(200))


def twin_counts(T_a_b, p_a, p_b, heights, n):
    """(G,) re-pairings among the first n that agree, and how many there are."""
    distance = np.linalg.norm(p_a[:n, None] - se2.transform_points(T_a_b, p_b)[None, :n], axis=2)
    dz2 = (heights[:n, None, 0] - heights[None, :n, 1]) ** 2
    possible = (dz2 <= heights[:n, None, 2] + heights[None, :n, 3]) & ~np.eye(n, dtype=bool)
    return [int(np.sum(possible & (distance <= gate))) for gate in GATES_M], int(possible.sum())


def heights_of(rng, n):
    return np.column_stack([rng.uniform(0, 2, (n, 2)), rng.uniform(0, 0.3, (n, 2))])


def test_repairings_are_counted_right():
    rng = np.random.default_rng(1)
    n = 90
    p_a, p_b, heights = rng.uniform(0, 3, (n, 2)), rng.uniform(0, 3, (n, 2)), heights_of(rng, n)
    pairs = independent_pairs(p_a, p_b, heights)
    for first in (90, 45, 22):
        T_a_b = np.array([*rng.normal(0, 0.5, 2), rng.uniform(-3, 3)])
        agreeing = agreeing_repairings(T_a_b, pairs, GATES_M, first)
        for row, size in ((0, first), (1, n)):
            expected, possible = twin_counts(T_a_b, p_a, p_b, heights, size)
            np.testing.assert_array_equal(agreeing[row], expected)
            assert pairs.possible[size - 1] == possible


def test_chance_is_the_larger_of_the_selections_and_of_all():
    """Counted by hand, one more than was counted: 1/5 and 3/101, 5/5 and 4/101, 1/5 and 101/101."""
    agreeing, possible = np.array([[0, 4, 0], [2, 3, 100]]), np.array([4, 100])
    found = [chance_of_agreeing(agreeing, g, *possible) for g in range(3)]
    np.testing.assert_allclose(found, [0.2, 1.0, 1.0], rtol=1e-12)


def test_minimal_motion_is_the_nearest_of_all():
    rng = np.random.default_rng(2)
    pair = given_pairs(rng, 12, sigma_m=0.1, planar=True)
    p_a, p_b = pair.map_a.position_m[:, :2].copy(), pair.map_b.position_m[:, :2].copy()
    found = minimal_motion(p_a, p_b, np.arange(12), pair.T_a_b)

    def displaced(T_a_b):
        apart = se2.transform_points(T_a_b, p_b) - se2.transform_points(pair.T_a_b, p_b)
        return np.mean(np.sum(apart**2, axis=1))

    def of_two(i, j):
        span_a, span_b = p_a[j] - p_a[i], p_b[j] - p_b[i]
        theta = math.atan2(span_a[1], span_a[0]) - math.atan2(span_b[1], span_b[0])
        middle = se2.rotation(theta) @ (p_b[i] + p_b[j]) / 2
        return np.array([*((p_a[i] + p_a[j]) / 2 - middle), theta])

    best = min(displaced(of_two(i, j)) for i, j in itertools.combinations(range(12), 2))
    assert displaced(found) == pytest.approx(best, rel=1e-9)


def twin_nfa(p_a, p_b, heights, T_a_b):
    """The documented formula, a selection and a gate at a time."""
    sizes = [len(p_a) >> s for s in range(20) if s == 0 or len(p_a) >> s >= 16]
    distance = np.linalg.norm(p_a - se2.transform_points(T_a_b, p_b), axis=1)
    best = math.inf
    for n in sizes:
        order = np.argsort(distance[:n], kind="stable")
        supporters = order[distance[order] <= GATES_M[-1]]
        if len(supporters) < 3:
            continue
        T_two = minimal_motion(p_a, p_b, supporters, T_a_b)
        both = np.maximum(
            distance[:n], np.linalg.norm(p_a - se2.transform_points(T_two, p_b), axis=1)[:n]
        )
        counts = [twin_counts(T_two, p_a, p_b, heights, size) for size in (n, len(p_a))]
        for g, gate in enumerate(GATES_M):
            k = np.sum(both <= gate)
            p = max((agreeing[g] + 1) / (possible + 1) for agreeing, possible in counts)
            if k >= 3:
                tests = len(sizes) * len(GATES_M) * n * (n - 1) / 2
                tail = binom.sf(k - 3, n - 2, p) if k - 2 > (n - 2) * p else 1.0
                best = min(best, math.log10(tests * tail))
    return best


@pytest.mark.parametrize(("true_share", "sigma_m"), [(0.0, 0.03), (0.2, 0.03), (0.6, 0.2)])
def test_the_whole_is_the_documented_formula(true_share, sigma_m):
    """With noise of half a gate, support under the motion judged is not that under two pairs'."""
    rng = np.random.default_rng(3)
    for n in (20, 70):
        pair = given_pairs(rng, n, true_share, sigma_m, planar=True)
        p_a, p_b = pair.map_a.position_m[:, :2].copy(), pair.map_b.position_m[:, :2].copy()
        heights = heights_of(rng, n)
        wrong = np.array([*(p_a[0] - p_b[0]), 0.3])
        for T_a_b in (pair.T_a_b, wrong):
            found = fewest_false_alarms(independent_pairs(p_a, p_b, heights), T_a_b, GATES_M)[0]
            assert found == pytest.approx(twin_nfa(p_a, p_b, heights, T_a_b), rel=1e-9)
