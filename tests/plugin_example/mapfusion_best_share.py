"""An aligner from outside: least squares on the correspondences that match best."""

from dataclasses import dataclass

import numpy as np

from mapfusion.align.alignment import Needs, supported
from mapfusion.align.rigid_motion import fit_rigid


@dataclass(frozen=True)
class BestShare:
    """Closed-form motion of the share of pairs whose descriptors are nearest to each other."""

    randomised = False  # the generator is not used
    needs = Needs(pairs=3)
    share: float = 0.5

    def __post_init__(self):
        if not 0 < self.share <= 1:
            raise ValueError("share: must lie in (0, 1]")

    def find(self, pairs, rng):
        """The motion, and the pairs it rests on."""
        n_kept = max(3, round(self.share * len(pairs)))
        rows = np.argsort(pairs.distance, kind="stable")[:n_kept]
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows] = True
        return supported(pairs, inlier, np.array(fit_rigid(pairs.p_a, pairs.p_b, rows)))
