"""Tests of `mapfusion.verification.registration`."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mapfusion.align.aligners import ALIGNERS, as_aligner, make_aligner
from mapfusion.align.alignment import (
    Alignment,
    Fit,
    Needs,
    Pairs,
    Status,
    Undetermined,
    supported,
    without_answer,
)
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.ransac import Ransac
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import (
    fit_rigid,
    least_squares_gain,
    motion_covariance,
    residual_covariances,
)
from mapfusion.geometry.se2 import motion_jacobian
from mapfusion.verification.false_alarms import Acceptance, Verdict
from mapfusion.verification.registration import (
    PairRegistration,
    Registered,
    Registration,
    VerifiedRefinement,
)
from mapfusion.verification.verdict import Verifier
from tests.mapfusion.align.map_pairs import given_pairs, landmarks


@dataclass
class Answers:
    """Says one thing after the other, and keeps what it was given."""

    answers: list = field(default_factory=list)
    randomised: bool = True
    given: list[Pairs] = field(default_factory=list)

    def find(self, pairs, rng):
        del rng
        self.given.append(pairs)
        return self.answers[(len(self.given) - 1) % len(self.answers)]


@dataclass
class WholeAnswers:
    """A process of its own, say: it has `align`."""

    answer: Alignment
    randomised: bool = False

    def align(self, map_a, map_b, correspondences, rng):
        del map_a, map_b, correspondences, rng
        return self.answer


@dataclass
class CountedRefinement:
    calls: list = field(default_factory=list)
    gate_m: float = Refinement().gate_m

    def refine(self, pairs, T_a_b):
        self.calls.append(np.array(T_a_b))
        return Refinement().refine(pairs, T_a_b)


def maps_of(pair):
    return pair.map_a, pair.map_b, pair.correspondences


def assert_same(first, second):
    for name in ("T_a_b", "covariance", "inlier", "drift_sigma_m"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert (first.status, first.reason) == (second.status, second.reason)


@pytest.mark.parametrize("name", list(ALIGNERS))
@pytest.mark.parametrize("true_share", [0.0, 0.6])
def test_equals_the_steps_by_hand(name, true_share):
    pair = given_pairs(np.random.default_rng(0), 80, true_share, 0.05)
    method, refinement, judge = (
        make_aligner(name),
        Refinement(gate_m=0.4),
        Verifier(Acceptance(1e-4)),
    )
    registration = Registration(method, refinement, judge)
    done = registration.register(*maps_of(pair), np.random.default_rng(1))
    estimated = as_aligner(method).align(*maps_of(pair), np.random.default_rng(1))
    refined = refinement.refine(Pairs(*maps_of(pair)), estimated.T_a_b)
    if np.isnan(estimated.T_a_b).any():
        refined = replace(refined, reason=estimated.reason)
    verdict = judge.on(Pairs(*maps_of(pair))).verify(refined)
    assert_same(done.estimated, estimated)
    assert_same(done.refined, refined)
    assert done.verdict == pytest.approx(verdict) or done.verdict == verdict
    assert done.applied.ok == verdict.accepted
    assert registration.randomised == method.randomised
    assert done.estimated.elapsed_s > 0


def test_covariance_and_drift_come_from_the_pairs_fitted():
    """Equal, isotropic noise s^2: (J'J)^-1 s^2, s^2 the residuals' own unbiased estimate."""
    pair = given_pairs(np.random.default_rng(0), 4000, 0.5, 0.0, drift_m=0.1, planar=True)
    p_a, p_b = pair.map_a.position_m, pair.map_b.position_m
    T_a_b = np.array(fit_rigid(p_a, p_b, np.flatnonzero(pair.is_true)))
    found = as_aligner(Answers([Fit(T_a_b, pair.is_true)])).align(
        *maps_of(pair), np.random.default_rng(0)
    )
    J = motion_jacobian(T_a_b, p_b[pair.is_true]).reshape(-1, 3)
    np.testing.assert_allclose(found.drift_sigma_m, 0.1, rtol=0.05)
    expected = np.linalg.inv(J.T @ J) * found.drift_sigma_m**2
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-3, atol=1e-9)
    assert (found.status, found.reason) == (Status.ACCEPTED, "")
    np.testing.assert_array_equal(found.inlier, pair.is_true)
    np.testing.assert_array_equal(found.T_a_b, T_a_b)


def test_weights_gains_and_other_pairs_of_a_fit_count():
    pair = given_pairs(np.random.default_rng(1), 30, 1.0, 0.05, planar=True)
    pairs, everyone = Pairs(*maps_of(pair)), np.ones(30, dtype=bool)
    weight = np.random.default_rng(2).uniform(0.1, 1, 30)
    rng = np.random.default_rng(0)

    def covariance(fit):
        return as_aligner(Answers([fit])).align(*maps_of(pair), rng).covariance

    gain = least_squares_gain(pair.T_a_b, pairs.p_b, weight)
    weighted = covariance(Fit(pair.T_a_b, everyone, weight=weight))
    np.testing.assert_array_equal(weighted, covariance(Fit(pair.T_a_b, everyone, gain=gain)))
    assert not np.allclose(weighted, covariance(Fit(pair.T_a_b, everyone)), rtol=1e-3)
    half = pairs[np.arange(15)]
    of_half = as_aligner(Answers([Fit(pair.T_a_b, everyone, fitted=half)])).align(
        *maps_of(pair), rng
    )
    own = residual_covariances(pair.T_a_b, half.covariance_a, half.covariance_b)
    expected = motion_covariance(
        least_squares_gain(pair.T_a_b, half.p_b), own + of_half.drift_sigma_m**2 * np.eye(2)
    )
    np.testing.assert_array_equal(of_half.covariance, expected)
    assert of_half.inlier.all()


def test_few_supporters_are_a_refusal_that_says_how_many():
    pair = given_pairs(np.random.default_rng(1), 10)
    pairs, rng = Pairs(*maps_of(pair)), np.random.default_rng(0)
    for n in range(4):
        fit = supported(pairs, np.arange(10) < n, pair.T_a_b)
        found = as_aligner(Answers([fit])).align(*maps_of(pair), rng)
        assert (found.status is Status.ACCEPTED) == (n == 3)
        assert n == 3 or found.reason.startswith(f"{n} correspondences")
        assert np.isnan(found.covariance).all() == (n < 2)
    refused = supported(pairs, np.ones(10, bool), pair.T_a_b, "symmetric")
    assert as_aligner(Answers([refused])).align(*maps_of(pair), rng).reason == "symmetric"


def test_supporters_in_one_place_leave_the_angle_open():
    place = landmarks(np.tile([[3.0, 4.0, 1.0]], (9, 1)))
    pairs = Pairs(place, place, Correspondences(np.arange(9), np.arange(9), np.zeros(9)))
    found = supported(pairs, np.ones(9, bool), np.zeros(3))
    assert isinstance(found, Undetermined)
    assert "one point" in found.reason


def test_a_method_is_not_called_with_less_than_it_needs():
    pair = given_pairs(np.random.default_rng(3), 12)
    wall = replace(pair.map_b, position_m=pair.map_b.position_m * [1, 0, 1] + np.array([0, 5, 0]))
    far = replace(pair.map_b, position_m=pair.map_b.position_m + np.array([0, 0, 50.0]))
    for needs, height, map_b, n, reason in (
        (Needs(), None, pair.map_b, 1, "1 correspondences, at least 2"),
        (Needs(5), None, pair.map_b, 4, "4 correspondences, at least 5"),
        (Needs(), HeightGate(), far, 12, "the heights of 0 correspondences agree, at least 2"),
        (Needs(dimensions=2), None, wall, 12, "lie on one line"),
        (Needs(dimensions=1), None, wall, 12, ""),
    ):
        method = Answers([Undetermined("called")])
        method.needs, method.height = needs, height
        pairs = pair.correspondences[np.arange(n)]
        found = as_aligner(method).align(pair.map_a, map_b, pairs, np.random.default_rng(0))
        assert found.status is Status.DEGENERATE
        assert len(method.given) == (not reason)
        assert found.reason == "called" if not reason else reason in found.reason


def test_pairs_of_other_heights_are_kept_from_it_and_its_inliers_are_of_all_pairs():
    pair = given_pairs(np.random.default_rng(4), 12)
    position = pair.map_b.position_m.copy()
    position[::3, 2] += 50
    method = Answers([Fit(pair.T_a_b, np.arange(8) < 4)])
    method.height = HeightGate()
    map_b = replace(pair.map_b, position_m=position)
    found = as_aligner(method).align(
        pair.map_a, map_b, pair.correspondences, np.random.default_rng(0)
    )
    near = np.flatnonzero(np.arange(12) % 3 != 0)
    np.testing.assert_array_equal(method.given[0].index_a, pair.correspondences.index_a[near])
    np.testing.assert_array_equal(np.flatnonzero(found.inlier), near[:4])


@pytest.mark.parametrize("status", [Status.FAILED, Status.ABSENT])
def test_what_did_not_run_is_passed_through(status):
    pair = given_pairs(np.random.default_rng(5), 40)
    answer = without_answer(status, "the reason", 40)
    refinement = CountedRefinement()
    registration = Registration(WholeAnswers(answer), refinement)
    done = registration.register(*maps_of(pair), np.random.default_rng(0))
    assert done.estimated is done.refined is done.applied is answer
    assert (done.verdict.accepted, done.verdict.reason) == (False, "the reason")
    assert refinement.calls == []


def test_degenerate_stays_degenerate_and_a_refused_estimate_is_refined():
    pair = given_pairs(np.random.default_rng(6), 60, 1.0, 0.02)
    rng = np.random.default_rng(0)
    done = Registration(Answers([Undetermined("no")])).register(*maps_of(pair), rng)
    assert (done.estimated.status, done.estimated.reason) == (Status.DEGENERATE, "no")
    assert done.refined.status is Status.DEGENERATE
    assert not done.applied.ok
    refused = Fit(pair.T_a_b + np.array([0.05, 0, 0]), np.ones(60, bool), refusal="unsure")
    done = Registration(Answers([refused])).register(*maps_of(pair), rng)
    assert (done.estimated.status, done.estimated.reason) == (Status.REFUSED, "unsure")
    assert done.refined.ok
    assert done.verdict.accepted
    assert done.applied is done.refined


def test_what_chance_would_give_is_refused_when_applied():
    pair = given_pairs(np.random.default_rng(7), 4, 1.0, 0.01)
    done = Registration(Ransac()).register(*maps_of(pair), np.random.default_rng(0))
    assert done.refined.ok
    assert done.applied.status is Status.REFUSED
    assert done.applied.reason == done.verdict.reason != ""
    trusting = Registration(Ransac(), verifier=None)
    assert trusting.register(*maps_of(pair), np.random.default_rng(0)).applied.ok


def test_equal_estimates_are_refined_once():
    pair = given_pairs(np.random.default_rng(8), 60, 1.0, 0.02)
    everyone = np.ones(60, bool)
    motions = [pair.T_a_b, pair.T_a_b + np.array([0.01, 0, 0])]
    fits = [Fit(motions[0], everyone), Fit(motions[1], everyone), Fit(motions[0].copy(), everyone)]
    refinement, method = CountedRefinement(), Answers([*fits, Undetermined("a"), Undetermined("b")])
    on_pair = Registration(method, refinement).on(*maps_of(pair))
    rng = np.random.default_rng(0)
    done = [on_pair.register(rng) for _ in range(10)]
    assert len(method.given) == 10  # all were estimated and timed
    assert len(refinement.calls) == 4  # two motions, two reasons
    assert done[0].refined is done[2].refined is done[5].refined
    assert done[0].refined is not done[1].refined
    assert done[0].verdict is done[2].verdict
    assert [d.estimated.reason for d in done[3:5]] == ["a", "b"]
    again = Registration(Answers(fits)).register(*maps_of(pair), rng)
    assert_same(again.refined, done[0].refined)


def test_equal_fits_are_one_answer_and_others_are_not():
    """Whatever a fit says counts: else a fit would be given the covariance of another."""
    pair = given_pairs(np.random.default_rng(9), 40, 1.0, 0.05)
    pairs, everyone, rng = Pairs(*maps_of(pair)), np.ones(40, bool), np.random.default_rng(0)
    first = Fit(pair.T_a_b, everyone)
    gain = least_squares_gain(pair.T_a_b, pairs.p_b, np.linspace(2, 1, 40))
    fits = [
        first,
        Fit(pair.T_a_b.copy(), everyone.copy()),
        replace(first, T_a_b=pair.T_a_b + np.array([0.1, 0, 0])),
        replace(first, inlier=np.arange(40) < 30),
        replace(first, weight=np.linspace(1, 2, 40)),
        replace(first, gain=gain),
        replace(first, fitted=pairs[np.arange(20)]),
        replace(first, gate_m=0.1),
        replace(first, refusal="unsure"),
    ]
    aligner = as_aligner(Answers(fits))
    again = [aligner.align_pairs(pairs, rng) for _ in fits]
    for fit, found in zip(fits, again, strict=True):
        assert_same(found, as_aligner(Answers([fit])).align(*maps_of(pair), rng))
    covariances = [found.covariance.tobytes() for found in again]
    assert covariances[0] == covariances[1]
    assert len(set(covariances[1:-1])) == len(fits) - 2
    assert again[0].covariance is again[1].covariance
    assert again[0].elapsed_s != again[1].elapsed_s


def test_the_height_gate_and_needs_of_each_method_are_its_own():
    """Methods get all pairs, the pairs of equal height, or none."""
    pair = given_pairs(np.random.default_rng(3), 50, 1.0, 0.01)
    raised = replace(pair.map_b, position_m=pair.map_b.position_m + np.array([0, 0, 5.0]))
    pairs, everyone = Pairs(pair.map_a, raised, pair.correspondences), np.ones(50, bool)
    rng, plain = np.random.default_rng(0), Answers([Fit(pair.T_a_b, everyone)])
    assert as_aligner(plain).align_pairs(pairs, rng).ok
    gated = Answers([Fit(pair.T_a_b, everyone)])
    gated.height = HeightGate()
    assert "heights of 0" in as_aligner(gated).align_pairs(pairs, rng).reason
    assert not gated.given
    wants = Answers([Fit(pair.T_a_b, everyone)])
    wants.needs = Needs(51)
    assert "51 are needed" in as_aligner(wants).align_pairs(pairs, rng).reason
    assert as_aligner(plain).align_pairs(pairs, rng).ok
    assert [len(given) for given in plain.given] == [50, 50]


def test_index_outside_its_map_is_named():
    full = landmarks(np.zeros((5, 3)))
    wrong = Correspondences(np.array([0, 5]), np.array([0, 1]), np.zeros(2))
    with pytest.raises(ValueError, match="index_a"):
        Registration(Ransac()).on(full, full, wrong)


def test_a_refusal_tells_what_about_the_maps_explains_it():
    """Once in each reason; a map in other units and labels of other landmarks, and nothing else."""
    rng = np.random.default_rng(6)
    pair, registration = given_pairs(rng, 40), Registration(make_aligner("ransac"))
    assert registration.register(*maps_of(pair), rng).verdict.accepted
    larger = replace(pair.map_b, position_m=1000 * pair.map_b.position_m, planar=True)
    done = registration.register(pair.map_a, larger, pair.correspondences, rng)
    assert done.estimated.reason.count("are 1000 times those of map") == 1
    assert done.applied.reason.count("is it in millimetres?") == 1
    named = [
        replace(each, label=np.arange(len(each), dtype=np.int32)) for each in maps_of(pair)[:2]
    ]
    wrong = replace(pair.correspondences, index_b=rng.permutation(pair.correspondences.index_b))
    done = registration.register(*named, wrong, rng)
    assert "40 labels are in both maps: do they name the same landmarks?" in done.applied.reason
    pairs = Pairs(*named, pair.correspondences)
    assert (pairs.note(20), pairs.note(19) != "") == ("", True)
    failed = without_answer(Status.FAILED, "ended", 40)
    ended = Registered(failed, failed, Verdict(Status.FAILED, math.nan, "ended"))
    assert ended.with_note("a note") is ended


@dataclass
class CountedVerifier:
    """Keeps what it was asked to judge."""

    asked: list = field(default_factory=list)

    def on(self, pairs, known):
        self.ready = Verifier().on(pairs, known)
        return self

    def verify(self, alignment):
        self.asked.append(alignment)
        return self.ready.verify(alignment)


def test_methods_on_one_pair_share_what_completes_their_estimates():
    pair = given_pairs(np.random.default_rng(8), 60, 0.8, 0.02)
    methods = [make_aligner(name) for name in ("ransac", "icp", "impicp", "clique", "gnc")] * 2
    refinement, judge = CountedRefinement(), CountedVerifier()
    verifier = VerifiedRefinement(Pairs(*maps_of(pair)), refinement, judge)
    motions, refined = set(), set()
    for k, method in enumerate(methods):
        rng, same_rng = np.random.default_rng(k), np.random.default_rng(k)
        done = PairRegistration(method, verifier).register(rng)
        alone = Registration(method).register(*maps_of(pair), same_rng)
        assert_same(done.estimated, alone.estimated)
        assert_same(done.refined, alone.refined)
        assert done.verdict == alone.verdict
        motions.add((done.estimated.T_a_b.tobytes(), done.estimated.reason))
        refined.add((done.refined.T_a_b.tobytes(), done.refined.covariance.tobytes()))
    assert len(refinement.calls) == len(motions) < len(methods)
    assert len(judge.asked) == len(refined) < len(methods)


def test_what_becomes_the_same_is_judged_once_and_what_differs_by_itself():
    pair = given_pairs(np.random.default_rng(8), 60, 1.0, 0.02)
    motions = [pair.T_a_b + np.array([k * 0.01, 0, 0]) for k in range(6)]
    fits = [Fit(T, np.ones(60, bool)) for T in motions]
    method, refinement, judge = Answers(fits), CountedRefinement(), CountedVerifier()
    verifier = VerifiedRefinement(Pairs(*maps_of(pair)), refinement, judge)
    answer, _ = verifier.verify(as_aligner(method).align(*maps_of(pair), None))
    refinement.refine = lambda pairs, T_a_b: answer  # all to one place
    n = len(judge.asked)
    for _ in motions:
        rng = np.random.default_rng(0)
        assert PairRegistration(method, verifier).register(rng).refined is answer
    assert len(judge.asked) == n == 1
    for changed in (
        {"T_a_b": answer.T_a_b + 1e-12},
        {"covariance": answer.covariance * 2},
        {"inlier": ~answer.inlier},
        {"drift_sigma_m": 1.0},
        {"status": Status.REFUSED, "reason": "unsure"},
    ):
        other = replace(answer, **changed)
        refinement.refine = lambda pairs, T_a_b, other=other: other
        verifier.verify(replace(answer, T_a_b=answer.T_a_b + len(judge.asked)))
        assert judge.asked[-1] is other
