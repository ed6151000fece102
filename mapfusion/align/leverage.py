"""Whether a motion rests on one pair, which may be a false one.

A false pair far from all others turns the map about them and finds itself confirmed: its residual
is small because the motion follows it.
"""

import math

import numpy as np

from mapfusion.align.mahalanobis_gate import PlanarPairs, residual_covariance
from mapfusion.align.rigid import residual_covariances
from mapfusion.kernels import kernel_part, source_of
from mapfusion.planar import lever, residual
from mapfusion.se2 import Float, transform_points

# How seldom a true pair may be called false, among all pairs of two maps: as seldom as the test
# against chance accepts a false alignment.
_CALLED_FALSE = 1e-3


def is_unlike_the_others(
    T_without: Float, covariance: Float, variance_m2: float, pairs: PlanarPairs, left_out: int
) -> bool:
    """Whether a pair lies farther from where the others put it than they explain.

    Its squared distance D under the motion without it, in units of S + s_drift^2 I + J cov J' with
    an s_drift that m = 2 (n - 1) - 3 numbers of the others leave, is 2 F(2, m) for a true pair
    (the externally studentised residual; Cook and Weisberg 1982), beyond D with the probability
    (1 + D / m)^(-m / 2). Any of the n pairs might have been the one.
    """
    _, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_without[2]), math.sin(T_without[2])
    m = 2 * (len(p_b) - 1) - 3
    if m < 1:
        return False
    J = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    J[:, 2] = source_of(lever)(cos, sin, p_b, left_out)
    (S,) = residual_covariances(T_without, S_a[left_out, None], S_b[left_out, None])
    e = np.array(source_of(residual)(T_without, cos, sin, pairs.p_a, p_b, left_out))
    D = e @ np.linalg.solve(S + variance_m2 * np.eye(2) + J @ covariance @ J.T, e)
    return -m / 2 * math.log1p(D / m) < math.log(_CALLED_FALSE / len(p_b))


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


@kernel_part
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
    cxx, cxy, cyy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    cxt, cyt, ctt = covariance[0, 2], covariance[1, 2], covariance[2, 2]
    most, found = -1.0, 0
    for i in range(len(p_b)):
        xx, xy, yy = residual_covariance(cos, sin, S_a, S_b, i, variance_m2)
        jx, jy = lever(cos, sin, p_b, i)
        # J cov J': what the motion's own uncertainty makes of this point
        txx = cxx + 2 * jx * cxt + jx * jx * ctt
        tyy = cyy + 2 * jy * cyt + jy * jy * ctt
        txy = cxy + jx * cyt + jy * cxt
        txy += jx * jy * ctt
        leverage = truth[i] * (txx * yy - 2 * txy * xy + tyy * xx) / (xx * yy - xy * xy)
        if leverage > most:
            most, found = leverage, i
    return found
