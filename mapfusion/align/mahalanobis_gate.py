"""Mahalanobis gate: the pairs that support a motion, given the landmarks' covariances.

The residual of a true pair has the covariance C = S_a + R S_b R^T + s_drift^2 I and satisfies
e^T C^-1 e <= bound with a given probability (chi-square). The unknown s_drift is the one of a few
values with the largest likelihood of all residuals, a mixture of true and false pairs.

A false pair far from all others has high leverage: the motion follows it and its residual is small.
The module therefore also tests whether a motion rests on one pair.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.align.rigid_motion import fit_weighted, residual_covariances
from mapfusion.geometry.numerics import Float, kernel, source_of
from mapfusion.geometry.se2 import add_turned, lever, residual, transform_points

# Lower bound of s_drift, which keeps the weights of noise-free data finite.
DRIFT_FLOOR_M = 1e-6

_ROUNDS = 20  # rounds of fit and support; two to five usually suffice
# e^T C^-1 e above which the density of true pairs (e^-100 of its peak) is negligible
_BEYOND = 200.0
_LARGE = 1e100  # product of likelihood ratios at which its logarithm is taken, to avoid overflow


class PlanarPairs(NamedTuple):
    """N correspondences in plan, as arrays for kernels.

    Attributes:
        p_a, p_b: positions in metres, each in its own frame, shape (N, 2).
        S_a, S_b: covariances, shape (N, 2, 2).
    """

    p_a: Float
    p_b: Float
    S_a: Float
    S_b: Float


def mean_variances(pairs: PlanarPairs, variance_m2: float = 0.0) -> Float:
    """Return the mean variances per axis of residuals, half the trace of C, shape (N,)."""
    S_a, S_b = pairs.S_a, pairs.S_b
    return (S_a[:, 0, 0] + S_a[:, 1, 1] + S_b[:, 0, 0] + S_b[:, 1, 1]) / 2 + variance_m2


@kernel
def residual_covariance(
    cos: float, sin: float, S_a: Float, S_b: Float, i: int, variance_m2: float
) -> tuple[float, float, float]:
    """Return the entries xx, xy, yy of C = S_a + R S_b R^T + s_drift^2 I of pair i."""
    axx, axy, ayy = S_a[i, 0, 0], S_a[i, 0, 1], S_a[i, 1, 1]
    bxx, bxy, byy = S_b[i, 0, 0], S_b[i, 0, 1], S_b[i, 1, 1]
    xx, xy, yy = add_turned(axx, axy, ayy, cos, sin, bxx, bxy, byy)
    return xx + variance_m2, xy, yy + variance_m2


@kernel
def _square_and_det(ex: float, ey: float, xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Return e^T C^-1 e and |C| of one residual."""
    det = xx * yy - xy * xy
    return (yy * ex * ex - 2 * xy * ex * ey + xx * ey * ey) / det, det


@kernel
def mark_supporters(
    T_a_b: Float,
    pairs: PlanarPairs,
    own_m2: Float,
    variance_m2: float,
    bound: float,
    inside: np.ndarray,
) -> tuple[int, float]:
    """Mark the pairs with e^T C^-1 e <= bound in `inside` (N,).

    `own_m2` are the `mean_variances` without s_drift. Returns the number of supporters and their
    sum of bound - e^T C^-1 e, which is minus the truncated cost up to a constant.
    """
    p_a, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    count, score = 0, 0.0
    for i in range(len(p_a)):
        ex, ey = residual(T_a_b, cos, sin, p_a, p_b, i)
        inside[i] = False
        # cheap exclusion: no direction has a variance above the trace
        if ex * ex + ey * ey > 2 * bound * (own_m2[i] + variance_m2):
            continue
        xx, xy, yy = residual_covariance(cos, sin, S_a, S_b, i, variance_m2)
        square, _ = _square_and_det(ex, ey, xx, xy, yy)
        if square <= bound:
            inside[i] = True
            count += 1
            score += bound - square
    return count, score


@kernel
def log_likelihood(
    T_a_b: Float, pairs: PlanarPairs, variance_m2: float, share: float, area_m2: float
) -> float:
    """Return the log-likelihood ratio of all residuals, `share` of true pairs over none.

    True pairs have residuals of covariance C, false ones are uniform over an area (MLESAC: Torr and
    Zisserman 2000, eq. 9).
    """
    p_a, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    log, product = 0.0, 1.0
    for i in range(len(p_a)):
        ex, ey = residual(T_a_b, cos, sin, p_a, p_b, i)
        xx, xy, yy = residual_covariance(cos, sin, S_a, S_b, i, variance_m2)
        ratio = 1 - share
        if ex * ex + ey * ey <= _BEYOND * (xx + yy):
            square, det = _square_and_det(ex, ey, xx, xy, yy)
            density = math.exp(-square / 2) / (2 * math.pi * math.sqrt(det))
            ratio += share * area_m2 * density
        product *= ratio
        if not 1 / _LARGE < product < _LARGE:
            log += math.log(product)
            product = 1.0
    return log + math.log(product)


@kernel
def refit_to_support(
    T_a_b: Float,
    pairs: PlanarPairs,
    own_m2: Float,
    variance_m2: float,
    bound: float,
    inside: np.ndarray,
) -> int:
    """Alternate fit and support until the support repeats; T_a_b and inside are changed.

    `own_m2` are the `mean_variances` without s_drift. Returns the number of supporters; with fewer
    than two, T_a_b is unchanged.
    """
    weight = np.empty(len(own_m2))
    count, _ = mark_supporters(T_a_b, pairs, own_m2, variance_m2, bound, inside)
    for _ in range(_ROUNDS):
        if count < 2:
            break
        for i in range(len(own_m2)):
            weight[i] = 1 / (own_m2[i] + variance_m2) if inside[i] else 0.0
        fit_weighted(pairs.p_a, pairs.p_b, weight, T_a_b)
        count, _ = mark_supporters(T_a_b, pairs, own_m2, variance_m2, bound, inside)
        changed = 0
        for i in range(len(own_m2)):
            changed += inside[i] != (weight[i] > 0)
        if changed == 0:
            break
    return count


def spread_area_m2(p: Float) -> float:
    """Return the area of a rectangle with uniform points of the covariance of points (N, 2)."""
    x, y = p.T - np.mean(p, axis=0)[:, None]
    determinant = np.mean(x * x) * np.mean(y * y) - np.mean(x * y) ** 2
    return 12 * math.sqrt(max(determinant, 0.0))  # a side L has the variance L^2 / 12


class PairSpread(NamedTuple):
    """Properties of N pairs that do not depend on the motion.

    Attributes:
        own_m2: `mean_variances` without s_drift, shape (N,).
        area_m2: larger `spread_area_m2` of the two maps.
    """

    own_m2: Float
    area_m2: float

    @classmethod
    def of(cls, pairs: PlanarPairs) -> "PairSpread":
        """Return the properties of at least one pair."""
        area_m2 = max(spread_area_m2(pairs.p_a), spread_area_m2(pairs.p_b))
        return cls(mean_variances(pairs), area_m2)


@kernel
def refit_at_best_drift(
    T_a_b: Float,
    pairs: PlanarPairs,
    spread: PairSpread,
    variances_m2: Float,
    bound: float,
    inside: np.ndarray,
) -> tuple[float, int]:
    """Refit T_a_b with each s_drift, from large to small, and keep the most likely result.

    T_a_b (3,) and inside (N,) are changed. `variances_m2` (L,) are ascending values of s_drift^2.
    Returns the log-likelihood and the index of s_drift, -1 if no value has two supporters.
    """
    n = len(pairs.p_a)
    own_m2, area = spread.own_m2, spread.area_m2
    T, marks = T_a_b.copy(), np.empty(n, np.bool_)
    for i in range(n):
        inside[i] = False
    best, best_level = -math.inf, -1
    for level in range(len(variances_m2) - 1, -1, -1):
        count = refit_to_support(T, pairs, own_m2, variances_m2[level], bound, marks)
        if count < 2:
            break
        # one false pair counted before any is seen keeps the share below 1
        log = log_likelihood(T, pairs, variances_m2[level], count / (n + 1), area)
        if log > best:
            best, best_level = log, level
            for k in range(3):
                T_a_b[k] = T[k]
            for i in range(n):
                inside[i] = marks[i]
    return best, best_level


# Probability that a true pair among all pairs of two maps is called false, equal to the false-alarm
# bound of the test against chance.
_CALLED_FALSE = 1e-3


def is_outlier_to_others(
    T_without: Float, covariance: Float, variance_m2: float, pairs: PlanarPairs, left_out: int
) -> bool:
    """Return True if the residual of a pair is an outlier to the fit of the other pairs.

    The test is the externally studentised residual (Cook and Weisberg 1982). D is the squared
    residual under the motion without the pair, in units of S + s_drift^2 I + J cov J', with
    m = 2 (n - 1) - 3 degrees of freedom of s_drift. For a true pair D is distributed as 2 F(2, m),
    with the tail (1 + D / m)^(-m / 2). The bound allows for n tests (Bonferroni).

    Args:
        T_without: motion without the pair, shape (3,).
        covariance: covariance of T_without, shape (3, 3).
        variance_m2: s_drift^2 without the pair.
        pairs: all n pairs.
        left_out: row of the pair.
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


def why_rests_on_one_pair(
    T_a_b: Float, T_without: Float | None, pairs: PlanarPairs, truth: Float, gate_m: float
) -> str:
    """Return why the motion rests on the pair of highest leverage; empty if it does not.

    Without this pair the motion must not move true pairs by more than the gate.

    Args:
        T_a_b: motion, shape (3,).
        T_without: motion without the pair; None if the other pairs determine none.
        pairs: all N pairs.
        truth: probability of each pair to be true, shape (N,).
        gate_m: distance up to which pairs take part.
    """
    if T_without is None:
        return "rests on one correspondence: without it there is no motion"
    p_b = pairs.p_b[truth > 0.5]
    apart = transform_points(T_a_b, p_b) - transform_points(T_without, p_b)
    moved_m = float(np.sqrt(np.max(np.sum(apart**2, axis=1))))
    if moved_m <= gate_m:
        return ""
    return f"rests on one correspondence: without it landmarks move by {moved_m:.2g} m"


@kernel
def highest_leverage_pair(
    T_a_b: Float, pairs: PlanarPairs, variance_m2: float, truth: Float, covariance: Float
) -> int:
    """Return the pair of highest leverage, the largest trace of J cov J' W.

    This is the block of the hat matrix of weighted least squares (Hoaglin and Welsch 1978), with
    W = truth C^-1 and C = S_a + R S_b R^T + s_drift^2 I. `truth` (N,) is the probability of each
    pair to be true, `covariance` (3, 3) that of T_a_b.
    """
    _, p_b, S_a, S_b = pairs
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    cxx, cxy, cyy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    cxt, cyt, ctt = covariance[0, 2], covariance[1, 2], covariance[2, 2]
    max_leverage, best_pair = -1.0, 0
    for i in range(len(p_b)):
        xx, xy, yy = residual_covariance(cos, sin, S_a, S_b, i, variance_m2)
        jx, jy = lever(cos, sin, p_b, i)
        # J cov J': covariance of the point from the uncertainty of the motion
        txx = cxx + 2 * jx * cxt + jx * jx * ctt
        tyy = cyy + 2 * jy * cyt + jy * jy * ctt
        txy = cxy + jx * cyt + jy * cxt
        txy += jx * jy * ctt
        leverage = truth[i] * (txx * yy - 2 * txy * xy + tyy * xx) / (xx * yy - xy * xy)
        if leverage > max_leverage:
            max_leverage, best_pair = leverage, i
    return best_pair
