"""Whether a motion rests on one pair, which may be a false one.

A false pair far from all others turns the map about them and finds itself confirmed: its residual
is small because the motion follows it.
"""

import math

import numpy as np
from numba import njit

from mapfusion.align.mahalanobis_gate import PlanarPairs, residual_covariance
from mapfusion.planar import lever
from mapfusion.se2 import Float, transform_points


def why_one_pair(
    T_a_b: Float, T_without: Float | None, pairs: PlanarPairs, truth: Float, gate_m: float
) -> str:
    """Why the motion rests on the pair of most leverage; empty when it does not.

    Left out, it must not let the motion go further than the gate: other pairs would be true then.
    T_without is None where the others determine no motion; `truth` (N,) is the probability of being
    true, `gate_m` the distance up to which pairs take part.
    """
    if T_without is None:
        return "rests on one correspondence: without it there is no motion"
    p_b = pairs.p_b[truth > 0.5]
    apart = transform_points(T_a_b, p_b) - transform_points(T_without, p_b)
    moved_m = float(np.sqrt(np.max(np.sum(apart**2, axis=1))))
    if moved_m <= gate_m:
        return ""
    return f"rests on one correspondence: without it landmarks move by {moved_m:.2g} m"


@njit(cache=True)
def most_leverage(
    T_a_b: Float, pairs: PlanarPairs, variance_m2: float, truth: Float, covariance: Float
) -> int:
    """The pair whose residual moves its own fit most: the largest trace of J cov J' W.

    The hat matrix of weighted least squares (Hoaglin and Welsch 1978), with W = truth C^-1 and
    C = S_a + R S_b R^T + s_drift^2 I.
    `truth` (N,) is the probability of being true, `covariance` (3, 3) that of T_a_b.
    """
    _, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    most, found = -1.0, 0
    for i in range(len(p_b)):
        xx, xy, yy = residual_covariance(cos, sin, S_a, S_b, i, variance_m2)
        jx, jy = lever(cos, sin, p_b, i)
        # J cov J': what the motion's own uncertainty makes of this point
        txx = covariance[0, 0] + 2 * jx * covariance[0, 2] + jx * jx * covariance[2, 2]
        tyy = covariance[1, 1] + 2 * jy * covariance[1, 2] + jy * jy * covariance[2, 2]
        txy = covariance[0, 1] + jx * covariance[1, 2] + jy * covariance[0, 2]
        txy += jx * jy * covariance[2, 2]
        leverage = truth[i] * (txx * yy - 2 * txy * xy + tyy * xx) / (xx * yy - xy * xy)
        if leverage > most:
            most, found = leverage, i
    return found
