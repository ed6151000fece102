"""An aligner from outside: least squares on the correspondences that match best."""

import time
from dataclasses import dataclass

import numpy as np

from mapfusion.align.alignment import gather, undetermined, why_too_few
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.verification.registration import supported_by


@dataclass(frozen=True)
class BestShare:
    """Closed-form motion of the share of pairs whose descriptors are nearest to each other."""

    randomised = False  # the generator is not used
    share: float = 0.5

    def __post_init__(self):
        if not 0 < self.share <= 1:
            raise ValueError("share: must lie in (0, 1]")

    def align(self, map_a, map_b, correspondences, rng):
        """T_a_b, its covariance and the pairs it rests on."""
        started_s = time.perf_counter()
        pairs = gather(map_a, map_b, correspondences)
        reason = why_too_few(map_a, map_b, len(pairs), needed=3)
        if reason:
            return undetermined(reason, len(pairs), started_s)
        n_kept = max(3, round(self.share * len(pairs)))
        rows = np.argsort(correspondences.distance, kind="stable")[:n_kept]
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows] = True
        T_a_b = np.array(fit_rigid(pairs.p_a, pairs.p_b, rows))
        return supported_by(pairs, inlier, T_a_b, started_s)
