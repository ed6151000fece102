"""The test against chance: its numbers against slow twins, its promise against random maps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from mapfusion.align.alignment import Alignment, Pairs, Status, degenerate
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.ransac import Ransac
from mapfusion.align.refinement import Refinement
from mapfusion.geometry import se2
from mapfusion.registration import as_aligner
from mapfusion.verification.false_alarms import Acceptance, Verdict
from tests.mapfusion.align.map_pairs import given_pairs, landmarks, motion, moved, swapped

GATES_M = np.array([0.05, 0.1, 0.2, 0.4])


def alignment(T_a_b, n):
    return Alignment(np.asarray(T_a_b, float), np.eye(3), np.ones(n, bool), 0.0, Status.ACCEPTED)


def judged(pair, T_a_b=None, **parameters):
    T_a_b = pair.T_a_b if T_a_b is None else T_a_b
    answer = alignment(T_a_b, len(pair.correspondences))
    return Acceptance(**parameters).judge(
        Pairs(pair.map_a, pair.map_b, pair.correspondences), answer
    )


def random_pairs(rng, n, planar=True):
    """All false: positions of both maps drawn apart, on walls and in clumps."""

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
    """RANSAC on 200 pairs of random maps, at a rate high enough to be seen to be exceeded."""
    rng = np.random.default_rng(4)
    stated, n = 1.0, 200
    test = Acceptance(false_alarms=stated)
    hits = low = 0
    for _ in range(n):
        map_a, map_b, pairs = random_pairs(rng, 60, planar)
        found = as_aligner(Ransac(max_draws=3000)).align(map_a, map_b, pairs, rng)
        refined = Refinement().refine(Pairs(map_a, map_b, pairs), found.T_a_b)
        verdict = test.judge(Pairs(map_a, map_b, pairs), refined)
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
    """12 true ones hide among 400 in a room, but match best: the smaller selections see them."""
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
    """MRCLAM: 15 of 15. The fewest that can be accepted are 6 of 6."""
    rng = np.random.default_rng(9)
    for n, accepted in ((3, False), (4, False), (5, False), (6, True), (15, True)):
        p_a = np.column_stack([1.5 * np.arange(n), 3 * np.cos(np.arange(n)), np.zeros(n)])
        p_b = se2.transform_points(se2.inverse([1, 2, 0.5]), p_a)
        p_b[:, :2] += rng.normal(0, 0.02, (n, 2))
        maps = landmarks(p_a, 0.02, planar=True), landmarks(p_b, 0.02, planar=True)
        pairs = Correspondences(np.arange(n), np.arange(n), np.zeros(n))
        verdict = Acceptance().judge(Pairs(*maps, pairs), alignment([1, 2, 0.5], n))
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
    verdict = Acceptance().judge(Pairs(pair.map_a, pair.map_b, pair.correspondences), failed)
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
        Acceptance().judge(Pairs(pair.map_a, pair.map_b, outside), alignment(pair.T_a_b, 10))
