"""Which pairs support a motion: a gate from the landmarks' covariances, and the chance of it.

The residual of a true pair has the covariance C = S_a + R S_b R^T + s_drift^2 I, so it lies inside
e^T C^-1 e <= chi-square with a stated probability. How large s_drift is, nobody says; of a few the
one is taken under which the residuals, true and false ones mixed, are most likely.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.align.pairs import Pairs
from mapfusion.se2 import Float

_ROUNDS = 20  # of fit and support; two to five are the rule


class PlanarPairs(NamedTuple):
    """N correspondences in plan, for the kernels.

    Attributes:
        p_a, p_b: (N, 2) positions in metres, each in its own frame.
        S_a, S_b: (N, 2, 2) covariances.
    """

    p_a: Float
    p_b: Float
    S_a: Float
    S_b: Float


def in_plan(pairs: Pairs) -> PlanarPairs:
    """The pairs without their heights."""
    return PlanarPairs(
        np.ascontiguousarray(pairs.p_a[:, :2]),
        np.ascontiguousarray(pairs.p_b[:, :2]),
        np.ascontiguousarray(pairs.covariance_a[:, :2, :2]),
        np.ascontiguousarray(pairs.covariance_b[:, :2, :2]),
    )


@njit(cache=True)
def mean_variances(pairs: PlanarPairs, variance_m2: float) -> Float:
    """Half the trace of C (N,): the residuals' variance per axis, the same for every theta."""
    S_a, S_b = pairs.S_a, pairs.S_b
    mean = np.empty(len(S_a))
    for i in range(len(S_a)):
        trace = S_a[i, 0, 0] + S_a[i, 1, 1] + S_b[i, 0, 0] + S_b[i, 1, 1]
        mean[i] = trace / 2 + variance_m2
    return mean


@njit(cache=True)
def fit_weighted(p_a: Float, p_b: Float, weight: Float, T_a_b: Float) -> None:
    """Fill T_a_b (3,) that minimises the sum of weight (N,) times |p_a - T p_b|^2.

    As `rigid.fit_rigid`, with weights: centroids, then theta from dot and cross products.
    """
    total = ax = ay = bx = by = 0.0
    for i in range(len(weight)):
        w = weight[i]
        total += w
        ax += w * p_a[i, 0]
        ay += w * p_a[i, 1]
        bx += w * p_b[i, 0]
        by += w * p_b[i, 1]
    ax, ay, bx, by = ax / total, ay / total, bx / total, by / total
    dot = cross = 0.0
    for i in range(len(weight)):
        w = weight[i]
        dx, dy, ex, ey = p_a[i, 0] - ax, p_a[i, 1] - ay, p_b[i, 0] - bx, p_b[i, 1] - by
        dot += w * (dx * ex + dy * ey)
        cross += w * (dy * ex - dx * ey)
    theta = math.atan2(cross, dot)
    cos, sin = math.cos(theta), math.sin(theta)
    T_a_b[0], T_a_b[1], T_a_b[2] = ax - cos * bx + sin * by, ay - sin * bx - cos * by, theta


@njit(cache=True)
def _square_and_det(
    ex: float, ey: float, cos: float, sin: float, S_a: Float, S_b: Float, variance_m2: float
) -> tuple[float, float]:
    """e^T C^-1 e and |C| of one residual; covariances (2, 2)."""
    xx, xy, yy = S_b[0, 0], S_b[0, 1], S_b[1, 1]
    Cxx = S_a[0, 0] + cos * cos * xx - 2 * cos * sin * xy + sin * sin * yy + variance_m2
    Cyy = S_a[1, 1] + sin * sin * xx + 2 * cos * sin * xy + cos * cos * yy + variance_m2
    Cxy = S_a[0, 1] + cos * sin * (xx - yy) + (cos * cos - sin * sin) * xy
    det = Cxx * Cyy - Cxy * Cxy
    return (Cyy * ex * ex - 2 * Cxy * ex * ey + Cxx * ey * ey) / det, det


@njit(cache=True)
def support_of(
    T_a_b: Float,
    pairs: PlanarPairs,
    mean_m2: Float,
    variance_m2: float,
    bound: float,
    inside: np.ndarray,
) -> tuple[int, float]:
    """Mark the pairs with e^T C^-1 e <= bound in `inside` (N,).

    Args:
        T_a_b: (3,).
        pairs: N correspondences.
        mean_m2: (N,) `mean_variances` for this s_drift.
        variance_m2: s_drift^2.
        bound: chi-square of 2 degrees of freedom.
        inside: (N,) bool, filled.

    Returns:
        Number of supporters, and the sum of what each stays below the bound: up to a constant,
        minus the truncated squares of all.
    """
    p_a, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    count, score = 0, 0.0
    for i in range(len(p_a)):
        ex = p_a[i, 0] - T_a_b[0] - cos * p_b[i, 0] + sin * p_b[i, 1]
        ey = p_a[i, 1] - T_a_b[1] - sin * p_b[i, 0] - cos * p_b[i, 1]
        inside[i] = False
        # no direction's variance is above the trace, so this loses none and spares most
        if ex * ex + ey * ey > 2 * bound * mean_m2[i]:
            continue
        square, _ = _square_and_det(ex, ey, cos, sin, S_a[i], S_b[i], variance_m2)
        if square <= bound:
            inside[i] = True
            count += 1
            score += bound - square
    return count, score


@njit(cache=True)
def log_likelihood(
    T_a_b: Float, pairs: PlanarPairs, variance_m2: float, share: float, area_m2: float
) -> float:
    """Of the residuals when `share` of the pairs are true, less that when none are.

    True ones have covariance C, false ones lie anywhere in an area (MLESAC: Torr and Zisserman
    2000, eq. 9).
    """
    p_a, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    log = 0.0
    for i in range(len(p_a)):
        ex = p_a[i, 0] - T_a_b[0] - cos * p_b[i, 0] + sin * p_b[i, 1]
        ey = p_a[i, 1] - T_a_b[1] - sin * p_b[i, 0] - cos * p_b[i, 1]
        square, det = _square_and_det(ex, ey, cos, sin, S_a[i], S_b[i], variance_m2)
        density = math.exp(-square / 2) / (2 * math.pi * math.sqrt(det))
        log += math.log(1 - share + share * area_m2 * density)
    return log


@njit(cache=True)
def settle(
    T_a_b: Float, pairs: PlanarPairs, variance_m2: float, bound: float, inside: np.ndarray
) -> int:
    """Fit to the support and take the support again until it repeats; T_a_b, inside are changed.

    Returns:
        Number of supporters; below two T_a_b is not fitted again.
    """
    mean = mean_variances(pairs, variance_m2)
    n = len(mean)
    before, weight = np.empty(n, np.bool_), np.empty(n)
    count, _ = support_of(T_a_b, pairs, mean, variance_m2, bound, inside)
    for _ in range(_ROUNDS):
        if count < 2:
            break
        for i in range(n):
            weight[i] = inside[i] / mean[i]
            before[i] = inside[i]
        fit_weighted(pairs.p_a, pairs.p_b, weight, T_a_b)
        count, _ = support_of(T_a_b, pairs, mean, variance_m2, bound, inside)
        same = True
        for i in range(n):
            same = same and inside[i] == before[i]
        if same:
            break
    return count


@njit(cache=True)
def spread_area_m2(p: Float) -> float:
    """Area of the rectangle over which points (N, 2) with this spread would be uniform."""
    n = len(p)
    mx = my = xx = xy = yy = 0.0
    for i in range(n):
        mx += p[i, 0] / n
        my += p[i, 1] / n
    for i in range(n):
        dx, dy = p[i, 0] - mx, p[i, 1] - my
        xx += dx * dx / n
        xy += dx * dy / n
        yy += dy * dy / n
    return 12 * math.sqrt(max(xx * yy - xy * xy, 0.0))  # a side L has the variance L^2 / 12


@njit(cache=True)
def settle_at_best_scale(
    T_a_b: Float, pairs: PlanarPairs, variances_m2: Float, bound: float, inside: np.ndarray
) -> tuple[float, int]:
    """Settle T_a_b at every scale, coarse to fine, and keep the likeliest.

    T_a_b (3,) and inside (N,) are changed.

    Args:
        T_a_b: (3,) to start from.
        pairs: N correspondences.
        variances_m2: (L,) s_drift^2, ascending.
        bound: chi-square of 2 degrees of freedom.
        inside: (N,) bool, filled with the support at the scale chosen.

    Returns:
        The log-likelihood, and the scale chosen; -1 when fewer than two pairs support any.
    """
    n = len(pairs.p_a)
    area = max(spread_area_m2(pairs.p_a), spread_area_m2(pairs.p_b))
    T, marks = T_a_b.copy(), np.empty(n, np.bool_)
    inside[:] = False
    best, best_level = -math.inf, -1
    for level in range(len(variances_m2) - 1, -1, -1):
        count = settle(T, pairs, variances_m2[level], bound, marks)
        if count < 2:
            break
        # one false pair counted before any is seen keeps the share below 1
        log = log_likelihood(T, pairs, variances_m2[level], count / (n + 1), area)
        if log > best:
            best, best_level = log, level
            T_a_b[:] = T
            inside[:] = marks
    return best, best_level
