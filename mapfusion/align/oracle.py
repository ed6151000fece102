"""Oracle: alignment from the true correspondences, the best result that the maps allow."""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from mapfusion.align.alignment import MIN_PAIRS, Alignment, Pairs, undetermined, why_too_few
from mapfusion.align.refinement import Refinement
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.parameters import require_shape


@dataclass(frozen=True)
class Oracle:
    """Aligner that receives the true pairs, for evaluation only.

    Attributes:
        refinement: least squares, as for the estimate of every aligner.
    """

    refinement: Refinement = field(default_factory=Refinement)

    def align(self, pairs: Pairs, is_true: np.ndarray) -> Alignment:
        """Estimate T_a_b from the correspondences marked in `is_true` (N,) bool.

        Raises:
            ValueError: `is_true` has another length.
        """
        started_s = time.perf_counter()
        require_shape("is_true", is_true, (len(pairs),))
        rows = np.flatnonzero(is_true)
        reason = why_too_few(pairs.map_a, pairs.map_b, len(rows), MIN_PAIRS)
        if reason:
            return undetermined(f"true ones: {reason}", len(pairs), started_s)
        start = fit_rigid(pairs.p_a, pairs.p_b, rows)
        found = self.refinement.refine(pairs[rows], np.array(start))
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows] = found.inlier
        return replace(found, inlier=inlier, elapsed_s=time.perf_counter() - started_s)
