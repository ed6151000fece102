"""Graduated non-convexity with truncated least squares."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mapfusion.align.alignment import Fit, Pairs, Undetermined
from mapfusion.align.consensus import Consensus
from mapfusion.align.mahalanobis_gate import PlanarPairs, mean_variances
from mapfusion.align.rigid_motion import fit_weighted
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import residual

_MU_FACTOR = 1.4  # Yang et al. 2020, remark 5
_MAX_ROUNDS = 1000  # from a residual of 1 km at 1 mm of noise it takes 90


@dataclass(frozen=True)
class Gnc(Consensus):
    """Truncated least squares by graduated non-convexity (Yang et al. 2020).

    Minimises the sum of min(r^2, c^2), with the residual r over its standard deviation and the
    chi-square quantile c^2. It starts with all pairs and reduces the weights of large residuals in
    each round. There is no guarantee: a consistent majority of false pairs determines the result.
    """

    randomised: ClassVar[bool] = False

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """Estimate T_a_b with the largest s_drift and refit to the support; `rng` is not used."""
        del rng
        planar = pairs.in_plan()
        mean_m2 = mean_variances(planar, self.variances_m2[-1])
        return self.refitted(anneal(planar, mean_m2, self.bound)[0], pairs, planar)


@kernel
def anneal(pairs: PlanarPairs, mean_m2: Float, bound: float) -> tuple[Float, Float]:
    """Alternate closed-form fits and weights while the cost changes from convex to truncated.

    `mean_m2` (N,) is the variance of each residual per axis, `bound` is c^2. Returns T_a_b (3,),
    NaN if all weights are 0, and the weights (N,).
    """
    p_a, p_b = pairs.p_a, pairs.p_b
    n = len(p_a)
    T_a_b, weight, scaled, square = np.empty(3), np.ones(n), np.empty(n), np.empty(n)
    mu = 0.0
    for _ in range(_MAX_ROUNDS):
        for i in range(n):
            scaled[i] = weight[i] / mean_m2[i]
        fit_weighted(p_a, p_b, scaled, T_a_b)
        cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
        largest = 0.0
        for i in range(n):
            ex, ey = residual(T_a_b, cos, sin, p_a, p_b, i)
            square[i] = (ex * ex + ey * ey) / mean_m2[i]
            largest = max(largest, square[i])
        if mu == 0:  # remark 5: convex enough for the largest residual
            if largest <= bound:
                break
            mu = bound / (2 * largest - bound)
        binary, total = True, 0.0
        for i in range(n):  # eq. 14
            if square[i] <= mu / (mu + 1) * bound:
                weight[i] = 1.0
            elif square[i] >= (mu + 1) / mu * bound:
                weight[i] = 0.0
            else:
                weight[i] = math.sqrt(bound / square[i] * mu * (mu + 1)) - mu
                binary = False
            total += weight[i]
        if total == 0:
            T_a_b[:] = math.nan
            break
        if binary:
            break
        mu *= _MU_FACTOR
    return T_a_b, weight
