"""The one way from two maps to an Alignment of the estimators that judge by covariances."""

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.drift import DRIFT_FLOOR_M
from mapfusion.align.pairs import Pairs, finish, gather, undetermined, why_one_place, why_too_few
from mapfusion.align.result import Alignment
from mapfusion.align.rigid import least_squares_gain
from mapfusion.align.support import PlanarPairs, in_plan, mean_variances, settle_at_best_scale
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

# Shares of the largest s_drift that are tried as well: maps without drift deserve the narrow gate
# that their covariances allow, and half-way steps lose little between.
_SCALES = np.array([0.0, 0.5, 1.0])


@dataclass(frozen=True)
class ConsensusAligner(ABC):
    """Finds a motion that many pairs support; what counts as support follows from covariances.

    Pairs whose heights disagree are left out. The method then gives a motion; it is fitted to its
    support in closed form, at the s_drift under which the residuals are likeliest.

    Attributes:
        drift_sigma_m: largest s_drift expected, per axis, of both maps together: 0.1 m is usual
            between two maps of one loop. Half of it and none are tried, too.
        probability: of a true pair to lie inside its gate.
        height: which pairs can be true by their heights (not for planar maps).
    """

    drift_sigma_m: float = 0.1
    probability: float = 0.99
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        if not self.drift_sigma_m >= 0:
            raise ValueError("drift_sigma_m: must not be negative")
        if not 0 < self.probability < 1:
            raise ValueError("probability: must lie between 0 and 1")

    @property
    def bound(self) -> float:
        """Most for e^T C^-1 e of a true pair (chi-square, 2 degrees of freedom)."""
        return chi_square_bound(self.probability, 2)

    @property
    def variances_m2(self) -> Float:
        """(L,) s_drift^2 of the scales tried, ascending."""
        return np.unique(np.maximum(self.drift_sigma_m * _SCALES, DRIFT_FLOOR_M) ** 2)

    @abstractmethod
    def find(self, pairs: PlanarPairs, rng: np.random.Generator) -> Float:
        """T_a_b (3,) from two pairs or more; NaN when there is none."""

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
        pairs = gather(map_a, map_b, correspondences)
        rows = pairs.of_one_height(self.height)
        reason = why_too_few(map_a, map_b, len(pairs), needed=2)
        if not reason and len(rows) < 2:
            reason = f"the heights of {len(rows)} correspondences agree, at least 2 are needed"
        if reason:
            return undetermined(reason, len(pairs), started_s)
        planar = in_plan(pairs[rows])
        T_a_b = self.find(planar, rng)
        if np.all(np.isfinite(T_a_b)):
            return self._settled(T_a_b, pairs, rows, planar, started_s)
        reason = f"no two of {len(rows)} correspondences agree on a motion"
        return undetermined(reason, len(pairs), started_s)

    def _settled(
        self,
        T_a_b: Float,
        pairs: Pairs,
        rows: np.ndarray,
        planar: PlanarPairs,
        started_s: float,
    ) -> Alignment:
        inside = np.zeros(len(rows), dtype=bool)
        _, level = settle_at_best_scale(T_a_b, planar, self.variances_m2, self.bound, inside)
        if level < 0:
            reason = "fewer than 2 correspondences support the motion found"
            return undetermined(reason, len(pairs), started_s)
        inlier = np.zeros(len(pairs), dtype=bool)
        inlier[rows[inside]] = True
        fitted, variance = pairs[inlier], self.variances_m2[level]
        reason = why_one_place(fitted, variance)
        if reason:
            return undetermined(reason, len(pairs), started_s)
        weight = 1 / mean_variances(planar, variance)[inside]
        gain = least_squares_gain(T_a_b, fitted.p_b, weight)
        return finish(fitted, gain, T_a_b, inlier, started_s)
