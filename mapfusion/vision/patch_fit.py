"""Where a point of an earlier picture lies in a later one: its surroundings, by least squares.

A corner is found anew in each picture, and nearer to the wall another place of it is the corner.
The surroundings of a point of a wall change by a homography from view to view, and by gain and
offset in brightness. Around the point, x from it in the earlier picture, it is

    u(x) = place + A x / (1 + h'x)      (Hartley and Zisserman 2004, section 13.1)

and h follows from disparities: what a camera comes nearer to grows, and grows more at its nearer
side. With h left out (Shi and Tomasi 1994) the place moves by half the second derivative, averaged
over the window: little, but on walls along the way always towards the robot. The six parameters of
place and A and the two of brightness are least squares on the grey levels, Gauss-Newton with the
earlier picture's derivatives, so that the normal matrix is built once (inverse composition, Baker
and Matthews 2004).
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.symmetric import solve_lower, solve_upper
from mapfusion.vision.template import (
    LEVEL,
    N_PARAMETERS,
    SLOPE_U,
    SLOPE_V,
    WEIGHT,
    WIDE,
    WINDOW_HALF_PX,
    Templates,
)

_MAX_STEPS = 15
_CONVERGED_PX = 0.005  # far below what noise lets one measure
# Where a window's far side would shrink to a half, it is no piece of a wall that one looks at.
_LEAST_SCALE = 0.5
_ONE = np.uintp(1)  # indices without a sign, which a kernel need not wrap around
_SIDE_PX = 2 * WINDOW_HALF_PX + 1
_AT = tuple(np.uintp(k * WIDE) for k in range(7))  # where sums of each product begin
_BYTE, _HALF, _LOW = np.uint32(8), np.uint32(16), np.uint32(0xFF)


def fit_patches(
    templates: Templates, rows: np.ndarray, after: np.ndarray, warp: Float, bend: Float
) -> np.ndarray:
    """Move each `warp` to the map from around a point to a patch of a later picture.

    Args:
        templates: how points looked.
        rows: (N,) which of them.
        after: (N, P, P) uint8 of the later picture.
        warp: (N, 2, 3), right to a few pixels; columns are d(u, v)/du, d(u, v)/dv, and where the
            point lies from the middle of `after`.
        bend: (N, 2) h, per pixel.

    Returns:
        (N,) bool: False where the window leaves a patch, has too little texture, or does not fit.
    """
    given = (templates.window, templates.factor, templates.tolerated, rows, after, warp, bend)
    found, area = np.zeros(len(rows), dtype=np.bool_), len(WEIGHT)
    cell, share, residual = np.empty(area, np.uint32), np.empty((2, area)), np.empty(area)
    _fit_all(*given, cell, share, residual, np.empty(len(_AT) * WIDE), found)
    return found


@kernel
def _fit_all(
    window: Float,
    factor: Float,
    tolerated: Float,
    rows: np.ndarray,
    after: np.ndarray,
    warp: Float,
    bend: Float,
    cell: np.ndarray,
    share: Float,
    residual: Float,
    down: Float,
    found: np.ndarray,
) -> None:
    """Move warps and mark what is found; from `cell` to `down` it is room on the way."""
    for n in range(len(rows)):
        i = rows[n]
        if tolerated[i] >= 0:
            square = _settle(
                window, i, factor[i], after, n, warp, bend, cell, share, residual, down
            )
            found[n] = 0 <= square <= tolerated[i]


@kernel_part
def _settle(
    window: Float,
    i: int,
    factor: Float,
    after: np.ndarray,
    n: int,
    warp: Float,
    bend: Float,
    cell: np.ndarray,
    share: Float,
    residual: Float,
    down: Float,
) -> float:
    """Move warp n until it stays; the weighted sum of squared residuals, negative if it does not.

    `cell`, `share`, `residual` and `down` are room for what is needed on the way.
    """
    step = np.empty(N_PARAMETERS)
    for _ in range(_MAX_STEPS):
        if not _stays_inside(after.shape[1] // 2, warp, bend, n):
            return -1.0
        _find_places(after.shape[1], warp, bend, n, cell, share)
        _look_up(after, n, cell)
        _compare(window, i, cell, share, residual)
        square = _moments(window, i, residual, down, step)
        solve_lower(factor, step)
        for k in range(N_PARAMETERS):
            square -= step[k] ** 2  # what the step explains: all of gain and offset
        solve_upper(factor, step)
        _compose(warp[n], step)
        if abs(step[0]) < _CONVERGED_PX and abs(step[1]) < _CONVERGED_PX:
            return max(square, 0.0)
    return -1.0


@kernel_part
def _stays_inside(middle: int, warp: Float, bend: Float, n: int) -> bool:
    """Whether all of a window lies on a patch."""
    least = 1.0 - (abs(bend[n, 0]) + abs(bend[n, 1])) * WINDOW_HALF_PX
    if not least > _LEAST_SCALE:
        return False
    for r in range(2):
        across = (abs(warp[n, r, 0]) + abs(warp[n, r, 1])) * WINDOW_HALF_PX
        if not across / least + abs(warp[n, r, 2]) + 1 <= middle:
            return False
    return True


@kernel(error_model="numpy")  # to ask whether it divides by zero takes longer than that
def _find_places(
    side: int, warp: Float, bend: Float, n: int, cell: np.ndarray, share: Float
) -> None:
    """Which pixel of a patch is before each of the window's, and shares of the way to the next."""
    half, middle, h_u, h_v = WINDOW_HALF_PX, side // 2, bend[n, 0], bend[n, 1]
    uu, uv, u_0 = warp[n, 0, 0], warp[n, 0, 1], warp[n, 0, 2]
    vu, vv, v_0 = warp[n, 1, 0], warp[n, 1, 1], warp[n, 1, 2]
    for y in range(-half, half + 1):
        first = np.uintp((y + half) * (2 * half + 1))
        for k in range(2 * half + 1):
            x = k - half
            scale = 1.0 / (1.0 + h_u * x + h_v * y)
            at_u = middle + u_0 + scale * (uu * x + uv * y)
            at_v = middle + v_0 + scale * (vu * x + vv * y)
            column, row = np.int32(at_u), np.int32(at_v)
            cell[first + np.uintp(k)] = row * np.int32(side) + column
            share[0, first + np.uintp(k)] = at_u - float(column)
            share[1, first + np.uintp(k)] = at_v - float(row)


@kernel_part
def _look_up(after: np.ndarray, n: int, cell: np.ndarray) -> None:
    """Replace pixels by the grey levels there, to the right and below, the bytes of one number."""
    side = np.uintp(after.shape[2])
    patch = after[n].ravel()
    for k in range(len(cell)):
        at = np.uintp(cell[k])
        upper = np.uint32(patch[at]) | np.uint32(patch[at + _ONE]) << _BYTE
        lower = np.uint32(patch[at + side]) | np.uint32(patch[at + side + _ONE]) << _BYTE
        cell[k] = upper | lower << _HALF


@kernel_part
def _compare(window: Float, i: int, cell: np.ndarray, share: Float, residual: Float) -> None:
    """Fill in after - before; between pixels grey levels are bilinear."""
    for k in range(len(cell)):
        a, b, levels = share[0, k], share[1, k], cell[k]
        p, q = float(levels & _LOW), float((levels >> _BYTE) & _LOW)
        r, s = float((levels >> _HALF) & _LOW), float(levels >> (_HALF + _BYTE))
        upper, lower = (1 - a) * p + a * q, (1 - a) * r + a * s
        residual[k] = (1 - b) * upper + b * lower - window[i, LEVEL, k]


@kernel_part
def _moments(window: Float, i: int, residual: Float, down: Float, moment: Float) -> float:
    """Weighted sum of squared residuals; `moment` gets J^T W r.

    Sums are taken down the columns first, into `down`: so loops run in vectors.
    """
    for k in range(len(down)):
        down[k] = 0.0
    for row in range(_SIDE_PX):
        y, at = float(row - WINDOW_HALF_PX), np.uintp(row * _SIDE_PX)
        for x in range(_SIDE_PX):
            m, k = np.uintp(x), at + np.uintp(x)
            gu, gv, off = window[i, SLOPE_U, k], window[i, SLOPE_V, k], residual[k]
            weighted = WEIGHT[k] * off
            along_u, along_v = weighted * gu, weighted * gv
            down[m] += weighted * off
            down[m + _AT[1]] += along_u
            down[m + _AT[2]] += along_v
            down[m + _AT[3]] += along_u * y
            down[m + _AT[4]] += along_v * y
            down[m + _AT[5]] += weighted
            down[m + _AT[6]] += weighted * window[i, LEVEL, k]
    square = m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = 0.0
    for k in range(_SIDE_PX):
        m, x = np.uintp(k), float(k - WINDOW_HALF_PX)
        along_u, along_v = down[m + _AT[1]], down[m + _AT[2]]
        square, m0, m1 = square + down[m], m0 + along_u, m1 + along_v
        m2, m3 = m2 + along_u * x, m3 + down[m + _AT[3]]
        m4, m5 = m4 + along_v * x, m5 + down[m + _AT[4]]
        m6, m7 = m6 + down[m + _AT[5]], m7 + down[m + _AT[6]]
    moment[0], moment[1], moment[2], moment[3] = m0, m1, m2, m3
    moment[4], moment[5], moment[6], moment[7] = m4, m5, m6, m7
    return square


@kernel_part
def _compose(warp: Float, step: Float) -> None:
    """Warp after the inverse of the step's own, which moved the earlier picture.

    To first order in h: steps go to zero, and with them what that leaves out.
    """
    a, b, c, d = 1 + step[2], step[3], step[4], 1 + step[5]
    determinant = a * d - b * c
    for r in range(2):
        first, second = warp[r, 0], warp[r, 1]
        warp[r, 0] = (first * d - second * c) / determinant
        warp[r, 1] = (second * a - first * b) / determinant
        warp[r, 2] -= warp[r, 0] * step[0] + warp[r, 1] * step[1]
