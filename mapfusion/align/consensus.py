"""What the methods that judge by covariances share: parameters, and settling on the support."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.align.correspondences import HeightGate
from mapfusion.align.degeneracy import why_one_place
from mapfusion.align.drift import DRIFT_FLOOR_M
from mapfusion.align.mahalanobis_gate import (
    PlanarPairs,
    Spread,
    mean_variances,
    settle_at_best_scale,
)
from mapfusion.align.method import Fit, Undetermined
from mapfusion.align.pairs import Pairs
from mapfusion.arguments import Probability, Range, require_in_range
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float

# Shares of the largest s_drift that are tried as well: maps without drift deserve the narrow gate
# that their covariances allow, and half-way steps lose little between.
_SCALES = np.array([0.0, 0.5, 1.0])


@dataclass(frozen=True)
class Consensus:
    """What counts as support of a motion follows from the landmarks' covariances and s_drift.

    Attributes:
        drift_sigma_m: largest s_drift expected, per axis, of both maps together: 0.1 m is usual
            between two maps of one loop. Half of it and none are tried, too.
        probability: of a true pair to lie inside its gate.
        height: which pairs can be true by their heights (not for planar maps).
    """

    drift_sigma_m: Annotated[float, Range(0, 100, "m")] = 0.1
    probability: Probability = 0.99
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def bound(self) -> float:
        """Most for e^T C^-1 e of a true pair (chi-square, 2 degrees of freedom)."""
        return chi_square_bound(self.probability, 2)

    @property
    def variances_m2(self) -> Float:
        """(L,) s_drift^2 of the scales tried, ascending."""
        return np.unique(np.maximum(self.drift_sigma_m * _SCALES, DRIFT_FLOOR_M) ** 2)

    def settled(self, T_a_b: Float, pairs: Pairs, planar: PlanarPairs) -> Fit | Undetermined:
        """T_a_b (3,) fitted to its support at the likeliest s_drift; NaN when there is none.

        What was settled of these pairs before is not settled again: repetitions find the same.
        """
        fits: dict[tuple, Fit | Undetermined] = pairs.kept.setdefault(Consensus, {})
        key = self, T_a_b.tobytes()
        if key not in fits:
            fits[key] = self._settle(T_a_b, pairs, planar)
        return fits[key]

    def _settle(self, T_a_b: Float, pairs: Pairs, planar: PlanarPairs) -> Fit | Undetermined:
        inlier, level = np.zeros(len(pairs), dtype=bool), -1
        if np.all(np.isfinite(T_a_b)):
            given = planar, spread_of(pairs), self.variances_m2, self.bound
            _, level = settle_at_best_scale(T_a_b, *given, inlier)
        return self.fit_of(T_a_b, inlier, level, pairs, planar)

    def fit_of(
        self, T_a_b: Float, inlier: np.ndarray, level: int, pairs: Pairs, planar: PlanarPairs
    ) -> Fit | Undetermined:
        """The fit of a settled motion: its support (N,) at that level of s_drift, -1 for none."""
        if not np.all(np.isfinite(T_a_b)):
            return Undetermined(f"no two of {len(pairs)} correspondences agree on a motion")
        if level < 0:
            return Undetermined("fewer than 2 correspondences support the motion found")
        variance_m2, support = self.variances_m2[level], pairs[inlier]
        reason = why_one_place(support, variance_m2)
        if reason:
            return Undetermined(reason)
        weight = 1 / mean_variances(planar, variance_m2)[inlier]
        return Fit(T_a_b, inlier, weight=weight, fitted=support)


def spread_of(pairs: Pairs) -> Spread:
    """What no motion changes, of the last call with these pairs if there was one."""
    if Spread not in pairs.kept:
        pairs.kept[Spread] = Spread.of(pairs.in_plan())
    return pairs.kept[Spread]
