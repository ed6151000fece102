"""Registration of two maps: estimate with an aligner, refine by least squares, verify."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mapfusion.align.aligners import Aligner, MethodAligner, alignment_of_fit, as_aligner
from mapfusion.align.alignment import (
    NOT_RUN,
    Alignment,
    Method,
    Pairs,
    Status,
    supported,
)
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.refinement import Refinement
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Verdict
from mapfusion.verification.verdict import PairEvidence, PairVerifier, Verifier


class VerifiedRefinement:
    """Refinement and verdict for estimates on one pair of maps.

    Equal estimates are refined once, and equal refined alignments are verified once.

    Args:
        pairs: correspondences of the two maps.
        refinement: least squares after the estimate.
        verifier: gives the verdict; None accepts what the refinement accepts.
        evidence: evidence found earlier for these maps; None to compute it when needed.
    """

    def __init__(
        self,
        pairs: Pairs,
        refinement: Refinement,
        verifier: Verifier | None,
        evidence: PairEvidence | None = None,
    ) -> None:
        self.pairs, self._refinement = pairs, refinement
        self.verifier: PairVerifier | None = verifier and verifier.on(pairs, evidence)
        self._refined: dict[tuple, Alignment] = {}
        self._verdicts: dict[tuple, Verdict] = {}

    def verify(self, estimated: Alignment) -> tuple[Alignment, Verdict]:
        """Return the refined alignment of an estimate, and the verdict on it."""
        refined = estimated
        if estimated.status not in NOT_RUN:
            known = (estimated.T_a_b.tobytes(), estimated.status, estimated.reason)
            if known not in self._refined:
                found = self._refinement.refine(self.pairs, estimated.T_a_b)
                if np.isnan(estimated.T_a_b).any():  # only the estimator knows the reason
                    found = replace(found, reason=estimated.reason)
                self._refined[known] = found
            refined = self._refined[known]
        arrays = (array.tobytes() for array in (refined.T_a_b, refined.covariance, refined.inlier))
        known = (
            *arrays,
            refined.drift_sigma_m,
            refined.lower_bound,
            refined.status,
            refined.reason,
        )
        if known not in self._verdicts:
            self._verdicts[known] = (
                Verdict(refined.status, np.nan, refined.reason)
                if self.verifier is None
                else self.verifier.verify(refined)
            )
        return refined, self._verdicts[known]


class Registered(NamedTuple):
    """Result of one registration of two maps.

    Attributes:
        estimated: alignment of the method.
        refined: alignment after least squares; equals `estimated` if the method did not run.
        verdict: verdict on the refined alignment.
    """

    estimated: Alignment
    refined: Alignment
    verdict: Verdict

    @property
    def applied(self) -> Alignment:
        """Refined alignment with the status of the verdict, for merging."""
        return self.verdict.applied_to(self.refined)

    def with_note(self, note: str) -> "Registered":
        """Append a note on the maps to each reason for a rejection."""
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
    """Registration of two maps: estimate, refine, verify.

    Attributes:
        method: estimates the motion.
        refinement: least squares after the estimate.
        verifier: gives the verdict; None accepts what the refinement accepts.
    """

    method: Method | Aligner
    refinement: Refinement = field(default_factory=Refinement)
    verifier: Verifier | None = field(default_factory=Verifier)

    @property
    def randomised(self) -> bool:
        """True if the result depends on the random generator."""
        return self.method.randomised

    def on(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        evidence: PairEvidence | None = None,
    ) -> "PairRegistration":
        """Return the registration of two maps, which can run any number of times.

        Args:
            map_a: map in frame a.
            map_b: map in frame b.
            correspondences: correspondences of the two maps.
            evidence: evidence found earlier for these maps; None to compute it when needed.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        pairs = Pairs(map_a, map_b, correspondences)
        return PairRegistration(
            self.method, VerifiedRefinement(pairs, self.refinement, self.verifier, evidence)
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
    """Registration of one pair of maps with one method.

    Several methods on the same pair may share the refinement.
    """

    def __init__(self, method: Method | Aligner, refinement: VerifiedRefinement) -> None:
        self._aligner, self._refinement = as_aligner(method), refinement

    @property
    def verifier(self) -> PairVerifier | None:
        """Verifier of the pair; None accepts what the refinement accepts."""
        return self._refinement.verifier

    def register(self, rng: np.random.Generator) -> Registered:
        """Estimate, refine and verify once."""
        pairs = self._refinement.pairs
        if isinstance(self._aligner, MethodAligner):
            estimated = self._aligner.align_pairs(pairs, rng)
        else:
            estimated = self._aligner.align(pairs.map_a, pairs.map_b, pairs.correspondences, rng)
        registered = Registered(estimated, *self._refinement.verify(estimated))
        if registered.verdict.accepted:
            return registered
        n_support = int(np.count_nonzero(registered.refined.inlier))
        return registered.with_note(pairs.note(n_support))


def supported_by(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, started_s: float, refusal: str = ""
) -> Alignment:
    """Return the alignment of a motion fitted to some pairs by least squares with equal weights.

    Args:
        pairs: all N pairs.
        inlier: (N,) bool, True for the fitted pairs.
        T_a_b: (3,) the motion.
        started_s: `time.perf_counter()` at the start.
        refusal: reason to reject the estimate; empty for none.
    """
    found = supported(pairs, inlier, T_a_b, refusal)
    return alignment_of_fit(found, pairs, np.arange(len(pairs)), started_s)
