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
from numba import njit

from mapfusion.se2 import Float
from mapfusion.symmetric import solve_lower, solve_upper
from mapfusion.vision.template import N_PARAMETERS, WEIGHT, WINDOW_HALF_PX, Templates, grey

_MAX_STEPS = 15
_CONVERGED_PX = 0.005  # far below what noise lets one measure
# Where a window's far side would shrink to a half, it is no piece of a wall that one looks at.
_LEAST_SCALE = 0.5


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
    given = (templates.window, templates.factor, templates.tolerated)
    return _fit_all(*given, rows, after, warp, bend)


@njit(cache=True)
def _fit_all(
    window: Float,
    factor: Float,
    tolerated: Float,
    rows: np.ndarray,
    after: np.ndarray,
    warp: Float,
    bend: Float,
) -> np.ndarray:
    found, shown = np.empty(len(rows), dtype=np.bool_), np.empty(after.shape[1:])
    for n in range(len(rows)):
        i = rows[n]
        for v in range(after.shape[1]):
            for u in range(after.shape[2]):
                shown[v, u] = after[n, v, u]
        found[n] = _fit(window[i], factor[i], float(tolerated[i]), shown, warp[n], bend[n])
    return found


@njit(cache=True)
def _fit(
    window: Float, factor: Float, tolerated: float, after: Float, warp: Float, bend: Float
) -> bool:
    step = np.empty(N_PARAMETERS)
    if tolerated < 0:
        return False
    for _ in range(_MAX_STEPS):
        square = _residuals(window, after, warp, bend, step)
        if square < 0:
            return False
        solve_lower(factor, step)
        for i in range(N_PARAMETERS):
            square -= step[i] ** 2  # what the step explains: all of gain and offset
        solve_upper(factor, step)
        _compose(warp, step)
        if abs(step[0]) < _CONVERGED_PX and abs(step[1]) < _CONVERGED_PX:
            return square <= tolerated
    return False


@njit(cache=True)
def _residuals(window: Float, after: Float, warp: Float, bend: Float, moment: Float) -> float:
    """Weighted squared differences after - before under the warp; `moment` gets J^T W r.

    Negative where the window leaves the patch.
    """
    half, middle = WINDOW_HALF_PX, after.shape[0] // 2
    at_u, at_v = np.empty(2 * half + 1), np.empty(2 * half + 1)
    least = 1.0 - (abs(bend[0]) + abs(bend[1])) * half
    if not least > _LEAST_SCALE:
        return -1.0
    for r in range(2):
        reach = (abs(warp[r, 0]) + abs(warp[r, 1])) * half / least + abs(warp[r, 2])
        if not reach + 1 <= middle:
            return -1.0
    square = m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = 0.0
    h_u, h_v = bend[0], bend[1]
    uu, uv, u_0 = warp[0, 0], warp[0, 1], warp[0, 2]
    vu, vv, v_0 = warp[1, 0], warp[1, 1], warp[1, 2]
    for y in range(-half, half + 1):
        # where the row lies, apart from what is read there: several divisions at once
        for k in range(2 * half + 1):
            x = k - half
            scale = 1.0 / (1.0 + h_u * x + h_v * y)
            at_u[k] = middle + u_0 + scale * (uu * x + uv * y)
            at_v[k] = middle + v_0 + scale * (vu * x + vv * y)
        for x in range(-half, half + 1):
            pixel = window[y + half, x + half]
            level, gu, gv = pixel[0], pixel[1], pixel[2]
            residual = grey(after, at_u[x + half], at_v[x + half]) - level
            weighted = WEIGHT[y + half, x + half] * residual
            square += weighted * residual
            m0, m1 = m0 + weighted * gu, m1 + weighted * gv
            m2, m3 = m2 + weighted * (gu * x), m3 + weighted * (gu * y)
            m4, m5 = m4 + weighted * (gv * x), m5 + weighted * (gv * y)
            m6, m7 = m6 + weighted, m7 + weighted * level
    moment[0], moment[1], moment[2], moment[3] = m0, m1, m2, m3
    moment[4], moment[5], moment[6], moment[7] = m4, m5, m6, m7
    return square


@njit(cache=True)
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
