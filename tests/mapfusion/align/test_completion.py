"""What several methods estimate on one pair of maps: the same is refined once, and judged once."""

from dataclasses import dataclass, field, replace

import numpy as np

from mapfusion.align.aligners import make_aligner
from mapfusion.align.alignment import Pairs, Status
from mapfusion.align.method import Fit
from mapfusion.registration import Completion, PairRegistration, Registration, as_aligner
from mapfusion.verification.verdict import Judge
from tests.mapfusion.align.map_pairs import given_pairs
from tests.mapfusion.align.test_registration import (
    Answers,
    CountedRefinement,
    assert_same,
    maps_of,
)


@dataclass
class CountedJudge:
    """Keeps what it was asked to judge."""

    asked: list = field(default_factory=list)

    def on(self, pairs, known):
        self.ready = Judge().on(pairs, known)
        return self

    def judge(self, alignment):
        self.asked.append(alignment)
        return self.ready.judge(alignment)


def test_methods_on_one_pair_share_what_completes_their_estimates():
    pair = given_pairs(np.random.default_rng(8), 60, 0.8, 0.02)
    methods = [make_aligner(name) for name in ("ransac", "icp", "impicp", "clique", "gnc")] * 2
    refinement, judge = CountedRefinement(), CountedJudge()
    completion = Completion(Pairs(*maps_of(pair)), refinement, judge)
    motions, refined = set(), set()
    for k, method in enumerate(methods):
        rng, same_rng = np.random.default_rng(k), np.random.default_rng(k)
        done = PairRegistration(method, completion).register(rng)
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
    method, refinement, judge = Answers(fits), CountedRefinement(), CountedJudge()
    completion = Completion(Pairs(*maps_of(pair)), refinement, judge)
    answer, _ = completion.of(as_aligner(method).align(*maps_of(pair), None))
    refinement.refine = lambda pairs, T_a_b: answer  # all to one place
    n = len(judge.asked)
    for _ in motions:
        rng = np.random.default_rng(0)
        assert PairRegistration(method, completion).register(rng).refined is answer
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
        completion.of(replace(answer, T_a_b=answer.T_a_b + len(judge.asked)))
        assert judge.asked[-1] is other
