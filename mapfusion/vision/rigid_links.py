"""Which links between two frames one motion of the robot explains; the others are slips.

A corner may jump along an edge, sit where one wall ends before another, or belong to something that
moves. Such links look like the others, descriptor by descriptor, and err by several pixels where
the rest errs by a tenth; one in twenty is enough to turn a map. The world stands still, so all true
links agree on one motion in the plane.
"""

import math

import numpy as np
from numba import njit

from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float
from mapfusion.symmetric import cofactors

_MIN_LINKS = 4  # two links determine a motion; one slip among three would be anyone's guess
# Added to the noise: from a tolerance beside which all points are equally certain to none.
_TOLERANCES_M = (1.0, 0.25, 0.06, 0.015, 0.004, 0.001, 0.0)
_ALL_AFTER = 3  # place in it after which all links are used, whatever the start left out
_STEPS = 2  # of Gauss-Newton at each tolerance; the answer of the one before is near
_PARTS = 3  # near, middle and far links; each start but one leaves one of them out
_ONE_PLACE = 1e-12  # share of a normal matrix's diagonal that its determinant is by rounding alone


def rigid_links(
    p_before_m: Float,
    covariance_before_m2: Float,
    p_after_m: Float,
    covariance_after_m2: Float,
    probability: float,
) -> np.ndarray:
    """Links (N,) bool that agree with the motion on which most agree.

    Least squares over the links inside the gate, again and again, while a tolerance that is added
    to all covariances falls from far above the noise to nothing. At first every link has one vote;
    at last each counts by its own precision. That finds the motion in spite of slips anywhere, but
    not always of another robot nearby: some points known to a millimetre pull at one end, where a
    wall at one distance leaves open whether the robot turned or slid. So there are four starts, of
    all links and without the near, the middle and the far third; that with most links wins.
    Points (N, 3) are in the robot frame of either frame; all True where fewer than four links leave
    nothing to compare.
    """
    n = len(p_before_m)
    if n < _MIN_LINKS:
        return np.ones(n, dtype=bool)
    gate = chi_square_bound(probability, 3)
    start = starts(p_before_m)
    agree = start.copy()
    _narrow(start, agree, p_before_m, covariance_before_m2, p_after_m, covariance_after_m2, gate)
    return agree[np.argmax(agree.sum(axis=1))]


def starts(p_before_m: Float) -> np.ndarray:
    """Links (4, N) bool that each start uses: all, and without a third by distance."""
    by_distance = np.argsort(np.argsort(np.linalg.norm(p_before_m, axis=1), kind="stable"))
    part = by_distance * _PARTS // len(p_before_m)
    return np.not_equal(part, np.array([-1, *range(_PARTS)])[:, None])


@njit(cache=True, error_model="numpy")
def _narrow(
    start: np.ndarray,
    agree: np.ndarray,
    p_before: Float,
    S_before: Float,
    p_after: Float,
    S_after: Float,
    gate: float,
) -> None:
    """Fill in the links (B, N) that agree in the end, from those of the starts (B, N)."""
    n = start.shape[1]
    lever, residual, information = np.empty((n, 2)), np.empty((n, 3)), np.empty((n, 6))
    for b in range(len(start)):
        motion, step = np.zeros(3), np.zeros(3)
        for i in range(len(_TOLERANCES_M)):
            variance = _TOLERANCES_M[i] ** 2
            for _ in range(_STEPS):
                _differences(motion, p_before, p_after, lever, residual)
                _information(motion[2], variance, S_before, S_after, information)
                _solve(lever, residual, information, agree[b], step)
                for k in range(3):
                    motion[k] += step[k]
            for j in range(n):
                near = _square(lever[j], residual[j], information[j], step) <= gate
                agree[b, j] = near and (i >= _ALL_AFTER or start[b, j])


@njit(cache=True, error_model="numpy")
def _differences(
    motion: Float, p_before: Float, p_after: Float, lever: Float, residual: Float
) -> None:
    """Before minus after (N, 3) under a motion T_before_after, and d(after) / d(turn) (N, 2)."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    for j in range(len(residual)):
        x = cos * p_after[j, 0] - sin * p_after[j, 1]
        y = sin * p_after[j, 0] + cos * p_after[j, 1]
        lever[j, 0], lever[j, 1] = -y, x
        residual[j, 0] = p_before[j, 0] - x - motion[0]
        residual[j, 1] = p_before[j, 1] - y - motion[1]
        residual[j, 2] = p_before[j, 2] - p_after[j, 2]


@njit(cache=True, error_model="numpy")
def _information(
    turn: float, variance: float, S_before: Float, S_after: Float, information: Float
) -> None:
    """Of the differences: the inverse covariances' upper entries (N, 6) under a turn."""
    c, s = math.cos(turn), math.sin(turn)
    for j in range(len(information)):
        before, after = S_before[j], S_after[j]
        xx, xy, yy = after[0, 0], after[0, 1], after[1, 1]
        axx, axy, axz, ayy, ayz, azz, determinant = cofactors(
            before[0, 0] + variance + c * c * xx - 2 * c * s * xy + s * s * yy,
            before[0, 1] + c * s * (xx - yy) + (c * c - s * s) * xy,
            before[0, 2] + c * after[0, 2] - s * after[1, 2],
            before[1, 1] + variance + s * s * xx + 2 * c * s * xy + c * c * yy,
            before[1, 2] + s * after[0, 2] + c * after[1, 2],
            before[2, 2] + variance + after[2, 2],
        )
        own, scale = information[j], 1 / determinant
        own[0], own[1], own[2] = scale * axx, scale * axy, scale * axz
        own[3], own[4], own[5] = scale * ayy, scale * ayz, scale * azz


@njit(cache=True, error_model="numpy")
def _solve(
    lever: Float, residual: Float, information: Float, used: np.ndarray, step: Float
) -> None:
    """The Gauss-Newton step (3,) of x, y and turn over the links in use."""
    xx = xy = xt = yy = yt = tt = x = y = t = 0.0
    for j in range(len(used)):
        if used[j]:
            own = information[j]
            ixx, ixy, ixz, iyy, iyz = own[0], own[1], own[2], own[3], own[4]
            lx, ly = lever[j, 0], lever[j, 1]
            rx, ry, rz = residual[j, 0], residual[j, 1], residual[j, 2]
            tx, ty = ixx * lx + ixy * ly, ixy * lx + iyy * ly
            gx, gy = ixx * rx + ixy * ry + ixz * rz, ixy * rx + iyy * ry + iyz * rz
            xx, xy, yy = xx + ixx, xy + ixy, yy + iyy
            xt, yt, tt = xt + tx, yt + ty, tt + lx * tx + ly * ty
            x, y, t = x + gx, y + gy, t + lx * gx + ly * gy
    axx, axy, axt, ayy, ayt, att, determinant = cofactors(xx, xy, xt, yy, yt, tt)
    if determinant > _ONE_PLACE * xx * yy * tt:
        step[0] = (axx * x + axy * y + axt * t) / determinant
        step[1] = (axy * x + ayy * y + ayt * t) / determinant
        step[2] = (axt * x + ayt * y + att * t) / determinant
    else:  # one point leaves the turn open, so it stays; none leaves all
        step[0] = (yy * x - xy * y) / att if att > 0 else 0.0
        step[1] = (xx * y - xy * x) / att if att > 0 else 0.0
        step[2] = 0.0


@njit(cache=True, error_model="numpy")
def _square(lever: Float, residual: Float, information: Float, step: Float) -> float:
    """Squared distance of a link's points, in standard deviations, after the step."""
    xx, xy, xz = information[0], information[1], information[2]
    yy, yz, zz = information[3], information[4], information[5]
    x = residual[0] - step[0] - lever[0] * step[2]
    y = residual[1] - step[1] - lever[1] * step[2]
    z = residual[2]
    return xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
