"""What follows an estimate, whichever method made it: the common least squares, and the verdict."""

from dataclasses import replace

import numpy as np

from mapfusion.align.acceptance import Verdict
from mapfusion.align.pairs import Pairs
from mapfusion.align.refine import Refinement
from mapfusion.align.result import NOT_RUN, Alignment
from mapfusion.evidence.judge import Judge, PairJudge
from mapfusion.evidence.pair_evidence import PairEvidence


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
