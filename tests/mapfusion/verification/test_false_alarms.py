"""Tests of `mapfusion.verification.false_alarms`."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from mapfusion.align.aligners import as_aligner, make_aligner
from mapfusion.align.alignment import Alignment, Pairs, Status, degenerate
from mapfusion.align.correspondences import Correspondences, match
from mapfusion.align.ransac import Ransac
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import (
    Acceptance,
    Verdict,
    agreeing_repairings,
    chance_of_agreeing,
    fewest_false_alarms,
    independent_pairs,
    independent_rows,
    log10_tail,
    minimal_motion,
    named_false_alarms,
)
from mapfusion.verification.registration import Registration
from tests.mapfusion.align.map_pairs import given_pairs, landmarks, motion, moved, swapped

GATES_M = np.array([0.05, 0.1, 0.2, 0.4])


def alignment(T_a_b, n):
    return Alignment(np.asarray(T_a_b, float), np.eye(3), np.ones(n, bool), 0.0, Status.ACCEPTED)


def judged(pair, T_a_b=None, **parameters):
    T_a_b = pair.T_a_b if T_a_b is None else T_a_b
    answer = alignment(T_a_b, len(pair.correspondences))
    return Acceptance(**parameters).verify(
        Pairs(pair.map_a, pair.map_b, pair.correspondences), answer
    )


def random_pairs(rng, n, planar=True):
    """Return false pairs: independent positions of both maps, on walls and in clusters."""

    def points():
        wall = rng.integers(6, size=n)
        along = rng.uniform(0, 8, n)
        xy = np.where((wall % 2 == 0)[:, None], [1.0, 0.0], [0.0, 1.0]) * along[:, None]
        return np.column_stack([xy + 3.0 * (wall // 2)[:, None], rng.uniform(0, 2.5, n)])

    a, b = points(), points()
    if planar:
        a[:, 2] = b[:, 2] = 0
    maps = landmarks(a, 0.02, planar=planar, name="a"), landmarks(b, 0.02, planar=planar, name="b")
    return *maps, Correspondences(np.arange(n), np.arange(n), rng.uniform(0.1, 0.6, n))


# --- what it promises ---


@pytest.mark.parametrize("planar", [True, False])
def test_false_alarms_are_at_most_the_stated_number(planar):
    """Run RANSAC on 200 pairs of random maps, at a rate that such a sample can reject."""
    rng = np.random.default_rng(4)
    stated, n = 1.0, 200
    test = Acceptance(false_alarms=stated)
    hits = low = 0
    for _ in range(n):
        map_a, map_b, pairs = random_pairs(rng, 60, planar)
        found = as_aligner(Ransac(max_draws=3000)).align(map_a, map_b, pairs, rng)
        refined = Refinement().refine(Pairs(map_a, map_b, pairs), found.T_a_b)
        verdict = test.verify(Pairs(map_a, map_b, pairs), refined)
        hits += verdict.accepted
        low += verdict.log10_false_alarms <= -1
    # a stated rate of 0.1 must not be rejected by the count of those below it
    assert binomtest(int(low), n, 0.1, "greater").pvalue > 1e-3
    assert hits <= n * stated * 0.1  # the bound is loose: independent tests are counted apart


def test_true_alignments_pass():
    rng = np.random.default_rng(5)
    accepted = [
        judged(given_pairs(rng, 200, 0.1, sigma_m=0.05, drift_m=0.05)).accepted for _ in range(200)
    ]
    assert np.mean(accepted) >= 0.99


def test_clumped_supporters_are_one():
    """Five corners of each of four patches agree: 20 supporters, four of them independent."""
    rng = np.random.default_rng(6)
    pair = given_pairs(rng, 120, 0.0)
    p_a, p_b = pair.map_a.position_m.copy(), pair.map_b.position_m.copy()
    p_a[:20] = np.repeat(rng.uniform(0, 20, (4, 3)) * [1, 1, 0.1], 5, axis=0)
    p_a[:20] += rng.uniform(-0.05, 0.05, (20, 3))
    p_b[:20] = se2.transform_points(se2.inverse(pair.T_a_b), p_a[:20])
    clumped = replace(
        pair,
        map_a=replace(pair.map_a, position_m=p_a),
        map_b=replace(pair.map_b, position_m=p_b),
    )
    assert judged(clumped, patch_m=0.0).accepted
    verdict = judged(clumped)
    assert not verdict.accepted
    assert verdict.log10_false_alarms > 0
    assert verdict.reason.startswith("4 of ")


def test_few_true_pairs_among_good_matches_are_found():
    """12 of 400 pairs are true and match best, so that smaller selections find them."""
    rng = np.random.default_rng(7)
    pair = given_pairs(rng, 400, 12 / 400, 0.02, 0.5, np.array([1.0, 0.5, 0.3]), planar=True)
    T_a_b = pair.T_a_b * [0.2, 0.2, 1.0]
    room = [0.2, 0.2, 1.0]  # 4 m by 4 m, drift 0.1 m
    map_a = replace(pair.map_a, position_m=pair.map_a.position_m * room)
    map_b = replace(pair.map_b, position_m=pair.map_b.position_m * room)
    hidden = rng.uniform(0.1, 0.6, 400)
    better = np.where(pair.is_true, rng.uniform(0.0, 0.2, 400), hidden)
    first, second = (
        judged(
            replace(
                pair,
                map_a=map_a,
                map_b=map_b,
                correspondences=replace(pair.correspondences, distance=distance),
            ),
            T_a_b,
        )
        for distance in (hidden, better)
    )
    assert second.log10_false_alarms < first.log10_false_alarms - 3


def test_verdict_does_not_depend_on_the_frames():
    rng = np.random.default_rng(8)
    for true_share in (0.0, 0.15):
        pair = given_pairs(rng, 80, true_share, sigma_m=0.05)
        T_a_b = (
            pair.T_a_b
            if true_share
            else as_aligner(Ransac()).align(pair.map_a, pair.map_b, pair.correspondences, rng).T_a_b
        )
        expected = judged(pair, T_a_b)
        T_new_a, T_new_b = motion(rng), motion(rng)
        T_new = se2.compose(se2.compose(T_new_a, T_a_b), se2.inverse(T_new_b))
        frames = replace(pair, map_a=moved(pair.map_a, T_new_a), map_b=moved(pair.map_b, T_new_b))
        found = judged(frames, T_new)
        assert found.log10_false_alarms == pytest.approx(expected.log10_false_alarms, rel=1e-9)
        back = judged(swapped(pair), se2.inverse(T_a_b))
        assert back.log10_false_alarms == pytest.approx(expected.log10_false_alarms, abs=0.5)


def test_a_few_landmarks_with_known_labels_pass_when_all_agree():
    """MRCLAM has 15 of 15; the smallest accepted number is 6 of 6."""
    rng = np.random.default_rng(9)
    for n, accepted in ((3, False), (4, False), (5, False), (6, True), (15, True)):
        p_a = np.column_stack([1.5 * np.arange(n), 3 * np.cos(np.arange(n)), np.zeros(n)])
        p_b = se2.transform_points(se2.inverse([1, 2, 0.5]), p_a)
        p_b[:, :2] += rng.normal(0, 0.02, (n, 2))
        maps = landmarks(p_a, 0.02, planar=True), landmarks(p_b, 0.02, planar=True)
        pairs = Correspondences(np.arange(n), np.arange(n), np.zeros(n))
        verdict = Acceptance().verify(Pairs(*maps, pairs), alignment([1, 2, 0.5], n))
        assert verdict.accepted is accepted, n
    assert verdict.log10_false_alarms < -15


def test_the_threshold_is_the_stated_number():
    rng = np.random.default_rng(10)
    pair = given_pairs(rng, 60, 0.15, sigma_m=0.05)
    found = judged(pair)
    number = 10**found.log10_false_alarms
    assert 1e-30 < number < 0.5
    assert judged(pair, false_alarms=2 * number).accepted
    refused = judged(pair, false_alarms=number / 2)
    assert not refused.accepted
    assert "independent correspondences agree within" in refused.reason


# --- results and arguments ---


def test_a_failed_alignment_is_not_judged():
    pair = given_pairs(np.random.default_rng(11), 30)
    failed = degenerate("no shape", 30)
    verdict = Acceptance().verify(Pairs(pair.map_a, pair.map_b, pair.correspondences), failed)
    assert (verdict.accepted, verdict.reason) == (False, "no shape")
    assert math.isnan(verdict.log10_false_alarms)
    assert verdict.applied_to(failed) is failed


def test_a_verdict_refuses_an_alignment():
    found = alignment([1, 2, 0.3], 5)
    assert Verdict(Status.ACCEPTED, -9.0).applied_to(found) is found
    refused = Verdict(Status.REFUSED, 2.0, "chance").applied_to(found)
    assert (refused.status, refused.reason, refused.ok) == (Status.REFUSED, "chance", False)
    np.testing.assert_array_equal(refused.T_a_b, found.T_a_b)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_next_to_nothing_is_refused_with_a_reason(n):
    rng = np.random.default_rng(12)
    pair = given_pairs(rng, 4)
    few = replace(pair, correspondences=pair.correspondences[np.arange(n)])
    verdict = judged(few)
    assert not verdict.accepted
    assert verdict.reason


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("false_alarms", 0.0),
        ("false_alarms", 2.0),
        ("gates_m", ()),
        ("gates_m", (0.1, -1.0)),
        ("gates_m", (math.inf,)),
        ("patch_m", -0.1),
    ],
)
def test_wrong_parameters_are_named(field, value):
    with pytest.raises(ValueError, match=field):
        Acceptance(**{field: value})


def test_wrong_indices_are_named():
    pair = given_pairs(np.random.default_rng(13), 10)
    outside = replace(pair.correspondences, index_b=pair.correspondences.index_b + 1)
    with pytest.raises(ValueError, match="index_b"):
        Acceptance().verify(Pairs(pair.map_a, pair.map_b, outside), alignment(pair.T_a_b, 10))


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
    np.testing.assert_array_equal(independent_rows(p_a, p_b, 0.4), kept)
    np.testing.assert_array_equal(independent_rows(p_a, p_b, 0.0), np.arange(200))


def twin_counts(T_a_b, p_a, p_b, heights, n):
    """Return the number of agreeing re-pairings among the first n by gate (G,), and of all."""
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
    """Counts plus one, by hand: 1/5 and 3/101, 5/5 and 4/101, 1/5 and 101/101."""
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
    """Evaluate the documented formula for each selection and gate."""
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
    """With noise of half a gate the support differs between the motion and that of two pairs."""
    rng = np.random.default_rng(3)
    for n in (20, 70):
        pair = given_pairs(rng, n, true_share, sigma_m, planar=True)
        p_a, p_b = pair.map_a.position_m[:, :2].copy(), pair.map_b.position_m[:, :2].copy()
        heights = heights_of(rng, n)
        wrong = np.array([*(p_a[0] - p_b[0]), 0.3])
        for T_a_b in (pair.T_a_b, wrong):
            found = fewest_false_alarms(independent_pairs(p_a, p_b, heights), T_a_b, GATES_M)[0]
            assert found == pytest.approx(twin_nfa(p_a, p_b, heights, T_a_b), rel=1e-9)


NAMED_LANDMARKS_GATES_M = np.array(sorted(Acceptance().gates_m))
T_A_B = np.array([1.0, -2.0, 0.7])


def named_map(p: np.ndarray, name: str) -> LandmarkMap:
    n = len(p)
    position = np.column_stack([p, np.zeros(n)])
    covariance = np.tile(np.diag([1e-4, 1e-4, 0.0]), (n, 1, 1))
    counts, labels = np.full(n, 5, np.int32), np.arange(n, dtype=np.int32)
    return LandmarkMap(position, covariance, counts, np.arange(n), None, labels, True, name)


def test_it_is_what_the_formula_says() -> None:
    rng = np.random.default_rng(0)
    p_a = rng.uniform(0, [12, 8], (10, 2))
    noise = np.zeros((10, 2))
    noise[7:] = 3.0
    p_b = se2.transform_points(se2.inverse(T_A_B), p_a + noise)
    log10, gate_m, n, k = named_false_alarms(p_a, p_b, T_A_B, NAMED_LANDMARKS_GATES_M)
    assert (gate_m, n, k) == (0.05, 10, 7)
    width, depth = np.ptp(p_a, axis=0) + 0.1
    tail = binom.sf(4, 8, math.pi * 0.05**2 / (width * depth))
    assert log10 == pytest.approx(math.log10(5 * 90 / 42 * tail))


def test_namesakes_may_be_twice_as_far_off_as_the_widest_gate() -> None:
    """Residuals are 0.6 m: outside the widest gate of 0.4 m, inside twice that gate."""
    rng = np.random.default_rng(4)
    p_a, way = rng.uniform(0, [40, 30], (10, 2)), rng.uniform(-np.pi, np.pi, 10)
    off = np.array([0.01, 0.01] + [0.6] * 6 + [0.81, 5.0])
    moved = p_a + off[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    p_b = se2.transform_points(se2.inverse(T_A_B), moved)
    log10, gate_m, n, k = named_false_alarms(p_a, p_b, T_A_B, NAMED_LANDMARKS_GATES_M)
    assert (gate_m, n, k) == (2 * NAMED_LANDMARKS_GATES_M[-1], 10, 8)
    width, depth = np.ptp(p_a, axis=0) + 2 * gate_m
    tail = binom.sf(5, 8, math.pi * gate_m**2 / (width * depth))
    assert log10 == pytest.approx(math.log10(5 * 90 / 56 * tail))


@pytest.mark.parametrize(("sigma_m", "accepted"), [(0.01, True), (1.5, False)])
def test_three_namesakes_that_agree_are_evidence(sigma_m: float, accepted: bool) -> None:
    rng = np.random.default_rng(1)
    p_a = np.array([[0.0, 0.0], [12.0, 1.0], [5.0, 9.0]])
    p_b = se2.transform_points(se2.inverse(T_A_B), p_a + rng.normal(0, sigma_m, (3, 2)))
    a, b = named_map(p_a, "a"), named_map(p_b, "b")
    done = Registration(make_aligner("clique")).register(a, b, match(a, b), rng)
    assert (done.verdict.status is Status.ACCEPTED) == accepted


def test_maps_that_are_wrong_have_no_more_false_alarms_than_stated() -> None:
    """Test every motion of two of the labelled landmarks with uniform positions."""
    rng, bound, n_maps, accepted = np.random.default_rng(2), 0.1, 200, 0
    for _ in range(n_maps):
        p_a, p_b = rng.uniform(0, 10, (2, 8, 2))
        best = math.inf
        for i in range(8):
            for j in range(i):
                turn = math.atan2(*(p_a[i] - p_a[j])[::-1]) - math.atan2(*(p_b[i] - p_b[j])[::-1])
                middle = se2.rotation(turn) @ (p_b[i] + p_b[j]) / 2
                T = np.array([*((p_a[i] + p_a[j]) / 2 - middle), turn])
                best = min(best, named_false_alarms(p_a, p_b, T, NAMED_LANDMARKS_GATES_M)[0])
        accepted += best <= math.log10(bound)
    assert accepted / n_maps <= bound + 3 * math.sqrt(bound / n_maps)


def test_maps_that_are_bent_are_fitted_by_all_that_has_a_name() -> None:
    """One half of each map is rotated; a narrow gate would align the larger half only."""
    rng = np.random.default_rng(3)
    p_a = rng.uniform(0, [12, 8], (11, 2))
    bent = p_a.copy()
    bent[:4] += [1.2, 0.0]
    p_b = se2.transform_points(se2.inverse(T_A_B), bent)
    a, b = named_map(p_a, "a"), named_map(p_b, "b")
    done = Registration(make_aligner("ransac")).register(a, b, match(a, b), rng)
    every = np.arange(11)
    T_all = np.array(fit_rigid(p_a, np.ascontiguousarray(p_b), every))
    assert done.refined.inlier.all()
    np.testing.assert_allclose(done.refined.T_a_b, T_all, atol=0.02)


def test_one_name_that_was_misread_is_left_out() -> None:
    rng = np.random.default_rng(4)
    p_a = rng.uniform(0, [12, 8], (15, 2))
    moved = p_a + rng.normal(0, 0.05, (15, 2))
    moved[5] += [6.0, 3.0]
    p_b = se2.transform_points(se2.inverse(T_A_B), moved)
    a, b = named_map(p_a, "a"), named_map(p_b, "b")
    done = Registration(make_aligner("ransac")).register(a, b, match(a, b), rng)
    assert np.flatnonzero(~done.refined.inlier).tolist() == [5]
    np.testing.assert_allclose(done.refined.T_a_b, T_A_B, atol=0.15)
