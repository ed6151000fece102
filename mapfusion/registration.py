"""Registration of two maps: estimate with an aligner, refine by least squares, verify."""

import time
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from mapfusion.align.alignment import (
    MIN_PAIRS,
    NOT_RUN,
    Alignment,
    Pairs,
    Status,
    undetermined,
    why_too_few,
)
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.drift import calibration_covariance, estimate_drift_m
from mapfusion.align.method import Fit, Method, Needs, Undetermined, supported
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import (
    least_squares_gain,
    motion_covariance,
    residual_covariances,
    residuals,
)
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Verdict
from mapfusion.verification.verdict import Judge, PairEvidence, PairJudge


class Completion:
    """Of estimates on one pair of maps.

    Equal estimates are refined once, and what becomes the same by that is judged once.
    """

    def __init__(
        self,
        pairs: Pairs,
        refinement: Refinement,
        judge: Judge | None,
        evidence: PairEvidence | None = None,
    ) -> None:
        """For some correspondences; the others are those of `Registration` and of its `on`."""
        self.pairs, self._refinement = pairs, refinement
        self.judge: PairJudge | None = judge.on(pairs, evidence) if judge is not None else None
        self._refined: dict[tuple, Alignment] = {}
        self._judged: dict[tuple, Verdict] = {}

    def of(self, estimated: Alignment) -> tuple[Alignment, Verdict]:
        """An estimate refined, and the verdict on that."""
        refined = estimated
        if estimated.status not in NOT_RUN:
            known = (estimated.T_a_b.tobytes(), estimated.status, estimated.reason)
            if known not in self._refined:
                found = self._refinement.refine(self.pairs, estimated.T_a_b)
                if np.isnan(estimated.T_a_b).any():  # why, only the estimator can tell
                    found = replace(found, reason=estimated.reason)
                self._refined[known] = found
            refined = self._refined[known]
        arrays = (array.tobytes() for array in (refined.T_a_b, refined.covariance, refined.inlier))
        known = (*arrays, refined.drift_sigma_m, refined.status, refined.reason)
        if known not in self._judged:
            self._judged[known] = self._judge(refined)
        return refined, self._judged[known]

    def _judge(self, refined: Alignment) -> Verdict:
        if self.judge is None:
            return Verdict(refined.status, np.nan, refined.reason)
        return self.judge.judge(refined)


class Aligner(Protocol):
    """Whoever answers with a whole `Alignment`: a `MethodAligner`, or a process of its own."""

    @property
    def randomised(self) -> bool:
        """Whether another generator can give another answer."""
        ...

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b."""
        ...


@dataclass(frozen=True)
class MethodAligner:
    """A method with all that its mathematics leaves out: gathering, refusal, covariance, time."""

    method: Method

    @property
    def randomised(self) -> bool:
        """Whether another generator can give another answer."""
        return self.method.randomised

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        started_s = time.perf_counter()
        return self._align(Pairs(map_a, map_b, correspondences), rng, started_s)

    def align_again(self, pairs: Pairs, rng: np.random.Generator) -> Alignment:
        """The same of pairs that it was given before: the method may have kept what helps it."""
        return self._align(pairs, rng, time.perf_counter())

    def _align(self, pairs: Pairs, rng: np.random.Generator, started_s: float) -> Alignment:
        height = getattr(self.method, "height", None)
        needs = getattr(self.method, "needs", None) or Needs()
        offer = _Offer.of(pairs, height if isinstance(height, HeightGate) else None, needs)
        if offer.too_little:
            return undetermined(offer.too_little, len(pairs), started_s)
        found = self.method.find(offer.given, rng)
        if isinstance(found, Undetermined):
            return undetermined(found.reason, len(pairs), started_s)
        answer = offer.answers.get(content := _content(found))
        if answer is None:
            answer = alignment_of_fit(found, pairs, offer.rows, started_s)
            offer.answers[content] = answer
        return replace(answer, elapsed_s=time.perf_counter() - started_s)


class _Offer(NamedTuple):
    """What a method is given of the pairs of two maps.

    Attributes:
        rows: (n,) of all pairs.
        given: those.
        too_little: why they are less than the method needs; empty when they are not.
        answers: that fits of them made, by their content.
    """

    rows: np.ndarray
    given: Pairs
    too_little: str
    answers: dict[tuple, Alignment]

    @classmethod
    def of(cls, pairs: Pairs, height: HeightGate | None, needs: Needs) -> "_Offer":
        """That of the last call with these pairs, of the same gate and needs, if there was one."""
        offers: dict[tuple, _Offer] = pairs.kept.setdefault(cls, {})
        if (height, needs) not in offers:
            rows = np.arange(len(pairs)) if height is None else pairs.of_one_height(height)
            given = pairs if len(rows) == len(pairs) else pairs[rows]
            offers[height, needs] = cls(rows, given, _why_not_called(needs, pairs, given), {})
        return offers[height, needs]


def _why_not_called(needs: Needs, pairs: Pairs, given: Pairs) -> str:
    """Why the pairs given to a method are less than it needs; empty when they are not."""
    shortage = pairs.correspondences.shortage
    reason = why_too_few(pairs.map_a, pairs.map_b, len(pairs), needs.pairs, shortage)
    if not reason and len(given) < needs.pairs:
        n, least = len(given), needs.pairs
        reason = f"the heights of {n} correspondences agree, at least {least} are needed"
    return reason or needs.why_without_extent(given)


def _content(fit: Fit) -> tuple:
    """All that a fit says; two of the same content are the same answer."""
    fitted = None if fit.fitted is None else fit.fitted.correspondences
    indices = (None, None) if fitted is None else (fitted.index_a, fitted.index_b)
    arrays = (fit.T_a_b, fit.inlier, fit.weight, fit.gain, *indices)
    told = (None if array is None else np.asarray(array).tobytes() for array in arrays)
    return (*told, fit.gate_m, fit.refusal)


def alignment_of_fit(
    found: Fit | Undetermined, pairs: Pairs, rows: np.ndarray, started_s: float
) -> Alignment:
    """A method's answer with drift and covariance judged from the residuals that it fitted.

    It was given `rows` (n,) of all N pairs, at `time.perf_counter()` `started_s`.
    """
    if isinstance(found, Undetermined):
        return undetermined(found.reason, len(pairs), started_s)
    inlier = np.zeros(len(pairs), dtype=bool)
    inlier[rows[found.inlier]] = True
    fitted = pairs[inlier] if found.fitted is None else found.fitted
    refusal, n_inliers = found.refusal, int(np.count_nonzero(inlier))
    if n_inliers < MIN_PAIRS and not refusal:
        refusal = f"{n_inliers} correspondences agree, at least {MIN_PAIRS} are needed"
    covariance, drift = np.full((3, 3), np.nan), np.nan
    if len(fitted) >= 2:
        gain = found.gain
        if gain is None:
            gain = least_squares_gain(found.T_a_b, fitted.p_b, found.weight)
        own = residual_covariances(found.T_a_b, fitted.covariance_a, fitted.covariance_b)
        e = residuals(found.T_a_b, fitted.p_a, fitted.p_b)
        drift = estimate_drift_m(e, own, found.gate_m)
        covariance = motion_covariance(gain, own + drift**2 * np.eye(2))
        covariance = covariance + calibration_covariance(found.T_a_b, fitted, drift)
    return Alignment(
        found.T_a_b,
        covariance,
        inlier,
        time.perf_counter() - started_s,
        Status.REFUSED if refusal else Status.ACCEPTED,
        refusal,
        drift,
    )


def as_aligner(method: Method | Aligner) -> Aligner:
    """The method as one that answers whole: by `align` where it has it, else around `find`."""
    return method if hasattr(method, "align") else MethodAligner(method)  # type: ignore[return-value]


class Registered(NamedTuple):
    """One registration of two maps.

    Attributes:
        estimated: the method's answer.
        refined: after the common least squares; a method that did not run leaves its answer here.
        verdict: on the refined one.
    """

    estimated: Alignment
    refined: Alignment
    verdict: Verdict

    @property
    def applied(self) -> Alignment:
        """What merging may use: the refined alignment, refused where the verdict says so."""
        return self.verdict.applied_to(self.refined)

    def explained(self, note: str) -> "Registered":
        """Return the same with a note on the maps behind each reason why it is not accepted."""
        if not note or self.verdict.accepted or self.estimated.status in NOT_RUN:
            return self
        estimated, refined, verdict = (
            {"reason": f"{each.reason}; {note}"}
            if each.reason and each.status is not Status.ACCEPTED
            else {}
            for each in self
        )
        return Registered(
            replace(self.estimated, **estimated),
            replace(self.refined, **refined),
            replace(self.verdict, **verdict),
        )


@dataclass(frozen=True)
class Registration:
    """Estimate, refine, judge.

    Attributes:
        method: what finds the motion, or answers with a whole alignment.
        refinement: the least squares after it.
        judge: gives the verdict after that; None accepts whatever the refinement does.
    """

    method: Method | Aligner
    refinement: Refinement = field(default_factory=Refinement)
    judge: Judge | None = field(default_factory=Judge)

    @property
    def randomised(self) -> bool:
        """Whether another generator can give another answer."""
        return self.method.randomised

    def on(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        evidence: PairEvidence | None = None,
    ) -> "PairRegistration":
        """Made ready for two maps, to be run any number of times.

        Args:
            map_a: frame a.
            map_b: frame b.
            correspondences: of the two.
            evidence: what was found for them before; sought where it is needed if None.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        pairs = Pairs(map_a, map_b, correspondences)
        return PairRegistration(
            self.method, Completion(pairs, self.refinement, self.judge, evidence)
        )

    def register(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Registered:
        """Register two maps once.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        return self.on(map_a, map_b, correspondences).register(rng)


class PairRegistration:
    """A method on one pair of maps, and the completion of what it estimates.

    Several methods on the same pair may share the completion.
    """

    def __init__(self, method: Method | Aligner, completion: Completion) -> None:
        self._aligner, self._completion = as_aligner(method), completion

    @property
    def judge(self) -> PairJudge | None:
        """Who gives the verdict; None where whatever the refinement does is accepted."""
        return self._completion.judge

    def register(self, rng: np.random.Generator) -> Registered:
        """Estimate once more, and complete it."""
        estimated = self._estimated(rng)
        done = Registered(estimated, *self._completion.of(estimated))
        if done.verdict.accepted:
            return done
        n_support = int(np.count_nonzero(done.refined.inlier))
        return done.explained(self._completion.pairs.note(n_support))

    def _estimated(self, rng: np.random.Generator) -> Alignment:
        pairs = self._completion.pairs
        if isinstance(self._aligner, MethodAligner):
            return self._aligner.align_again(pairs, rng)
        return self._aligner.align(pairs.map_a, pairs.map_b, pairs.correspondences, rng)


def supported_by(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, started_s: float, refusal: str = ""
) -> Alignment:
    """The answer of a method whose motion is the least squares, equally weighted, of some pairs.

    `inlier` (N,) marks those it was fitted to; `started_s` is `time.perf_counter()` at the start,
    `refusal` why the estimate is not to be trusted, if so.
    """
    found = supported(pairs, inlier, T_a_b, refusal)
    return alignment_of_fit(found, pairs, np.arange(len(pairs)), started_s)
