"""The best that correspondences allow: what is left over is the drift of the maps."""

import time
from dataclasses import dataclass, field

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.pairs import MIN_PAIRS, gather, undetermined, why_too_few
from mapfusion.align.refine import Refinement
from mapfusion.align.result import Alignment
from mapfusion.align.rigid import fit_rigid
from mapfusion.arguments import require_shape
from mapfusion.landmark_map import LandmarkMap


@dataclass(frozen=True)
class Oracle:
    """Aligns with the true pairs alone. Only for evaluation: it is told which ones are true.

    Attributes:
        refinement: the same least squares that every aligner's estimate goes through.
    """

    refinement: Refinement = field(default_factory=Refinement)

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        is_true: np.ndarray,
    ) -> Alignment:
        """Estimate T_a_b from the correspondences marked in `is_true` (N,) bool.

        Raises:
            ValueError: `is_true` has another length, or an index lies outside its map.
        """
        started_s = time.perf_counter()
        require_shape("is_true", is_true, (len(correspondences),))
        pairs = gather(map_a, map_b, correspondences)
        rows = np.flatnonzero(is_true)
        reason = why_too_few(map_a, map_b, len(rows), needed=MIN_PAIRS)
        if reason:
            return undetermined(f"true ones: {reason}", len(correspondences), started_s)
        true = correspondences[rows]
        start = fit_rigid(pairs.p_a, pairs.p_b, rows)
        found = self.refinement.refine(map_a, map_b, true, np.array(start))
        inlier = np.zeros(len(correspondences), dtype=bool)
        inlier[rows] = found.inlier
        return Alignment(
            found.T_a_b,
            found.covariance,
            inlier,
            time.perf_counter() - started_s,
            found.status,
            found.reason,
            found.drift_sigma_m,
        )
