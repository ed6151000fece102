"""Where a point of an earlier picture lies in a later one: its surroundings, by least squares.

A corner is found anew in each picture, and nearer to the wall another place of it is the corner.
The surroundings of a point of a wall change by an affine map from view to view (Shi and Tomasi
1994), and by gain and offset in brightness. The six parameters of the map and the two of brightness
are least squares on the grey levels, Gauss-Newton with the earlier picture's derivatives, so that
the normal matrix is built once (inverse composition, Baker and Matthews 2004).
"""

import math

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky, solve_lower, solve_upper

_PATCH_HALF_PX = 17  # room for the window when what it shows has grown by half
PATCH_SIDE_PX = 2 * _PATCH_HALF_PX + 1
_WINDOW_HALF_PX = (
    10  # a smaller window tells scale from shift less well, a larger one is less a plane
)
_WINDOW_SIGMA_PX = 6.0  # of the Gaussian by which its pixels count
_MAX_STEPS = 15
_CONVERGED_PX = 0.005  # far below what noise lets one measure
_SINGULAR = 1e-9  # pivot, as a share of its diagonal element, that is rounding error
_N = 8  # parameters: shift u and v, their derivatives by u and v, offset and gain in brightness


def cut_patches(image: np.ndarray, uv_px: Float) -> np.ndarray:
    """What is around the pixels nearest to points (N, 2), (N, P, P); outside the border repeats."""
    side = np.arange(-_PATCH_HALF_PX, _PATCH_HALF_PX + 1)
    u, v = np.rint(uv_px).astype(np.int64).T
    rows = np.clip(v[:, None] + side, 0, image.shape[0] - 1)
    columns = np.clip(u[:, None] + side, 0, image.shape[1] - 1)
    return image[rows[:, :, None], columns[:, None, :]]


@njit(cache=True)
def fit_patches(
    before: np.ndarray,
    point: Float,
    after: np.ndarray,
    warp: Float,
    noise: float,
    max_misfit: float,
) -> np.ndarray:
    """Move each `warp` to the affine map from around a point of one patch into another patch.

    Args:
        before: (N, P, P) uint8 of earlier pictures.
        point: (N, 2) in them, u and v from their middles.
        after: (N, P, P) uint8 of the later picture.
        warp: (N, 2, 3), right to a few pixels; columns are d(u, v)/du, d(u, v)/dv, and where the
            point lies from the middle of `after`.
        noise: standard deviation of one picture's grey levels.
        max_misfit: the window may differ by noise and by what this error of its place would
            explain, pixels.

    Returns:
        (N,) bool: False where the window leaves a patch, has too little texture, or does not fit.
    """
    found = np.empty(len(before), dtype=np.bool_)
    for n in range(len(before)):
        found[n] = _fit(before[n], point[n], after[n], warp[n], noise, max_misfit)
    return found


@njit(cache=True)
def _fit(
    before: np.ndarray,
    point: Float,
    after: np.ndarray,
    warp: Float,
    noise: float,
    max_misfit: float,
) -> bool:
    n = 2 * _WINDOW_HALF_PX + 1
    grey, rows, weight = np.empty((n, n)), np.empty((n, n, _N)), np.empty((n, n))
    factor, step = np.empty((_N, _N)), np.empty(_N)
    if not _take_window(before, point, grey, rows, weight):
        return False
    tolerated = _normal_matrix(rows, weight, factor, 2 * noise**2, max_misfit**2)
    if not cholesky(factor, _SINGULAR):
        return False
    for _ in range(_MAX_STEPS):
        square = _residuals(grey, rows, weight, after, warp, step)
        if square < 0:
            return False
        solve_lower(factor, step)
        for i in range(_N):
            square -= step[i] ** 2  # what the step explains: all of gain and offset
        solve_upper(factor, step)
        _compose(warp, step)
        if abs(step[0]) < _CONVERGED_PX and abs(step[1]) < _CONVERGED_PX:
            return square <= tolerated
    return False


@njit(cache=True)
def _take_window(before: np.ndarray, point: Float, grey: Float, rows: Float, weight: Float) -> bool:
    """Grey levels on the grid around the point, their derivatives by the parameters, weights."""
    half, middle = _WINDOW_HALF_PX, before.shape[0] // 2
    if max(abs(point[0]), abs(point[1])) + half + 2 > middle:
        return False
    by_distance = np.empty(half + 1)
    for x in range(half + 1):
        by_distance[x] = math.exp(-(x * x) / (2 * _WINDOW_SIGMA_PX**2))
    for y in range(-half, half + 1):
        for x in range(-half, half + 1):
            u, v = middle + point[0] + x, middle + point[1] + y
            level, row = _grey(before, u, v), rows[y + half, x + half]
            gu = 0.5 * (_grey(before, u + 1, v) - _grey(before, u - 1, v))
            gv = 0.5 * (_grey(before, u, v + 1) - _grey(before, u, v - 1))
            row[0], row[1] = gu, gv
            row[2], row[3], row[4], row[5] = gu * x, gu * y, gv * x, gv * y
            row[6], row[7] = 1.0, level
            grey[y + half, x + half] = level
            weight[y + half, x + half] = by_distance[abs(x)] * by_distance[abs(y)]
    return True


@njit(cache=True)
def _grey(image: np.ndarray, u: float, v: float) -> float:
    """Grey level between pixels, bilinear."""
    i, j = int(u), int(v)
    a, b = u - i, v - j
    upper = (1 - a) * image[j, i] + a * image[j, i + 1]
    lower = (1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]
    return (1 - b) * upper + b * lower


@njit(cache=True)
def _normal_matrix(
    rows: Float, weight: Float, normal: Float, variance: float, square_misfit: float
) -> float:
    """Fills its lower half; returns which weighted sum of squared residuals is tolerated.

    An error e of the place along some direction changes a grey level by g e, g its slope along it.
    """
    tolerated = 0.0
    normal[:] = 0.0
    for y in range(len(weight)):
        for x in range(len(weight)):
            row = rows[y, x]
            square_slope = 0.5 * (row[0] * row[0] + row[1] * row[1])  # the mean over directions
            tolerated += weight[y, x] * (variance + square_misfit * square_slope)
            for i in range(_N):
                for j in range(i + 1):
                    normal[i, j] += weight[y, x] * row[i] * row[j]
    return tolerated


@njit(cache=True)
def _residuals(
    grey: Float, rows: Float, weight: Float, after: np.ndarray, warp: Float, moment: Float
) -> float:
    """Weighted squared differences after - before under the warp; `moment` gets J^T W r.

    Negative where the window leaves the patch.
    """
    half, middle = _WINDOW_HALF_PX, after.shape[0] // 2
    for r in range(2):
        reach = (abs(warp[r, 0]) + abs(warp[r, 1])) * half + abs(warp[r, 2])
        if not reach + 1 <= middle:
            return -1.0
    square = 0.0
    moment[:] = 0.0
    for y in range(-half, half + 1):
        for x in range(-half, half + 1):
            u = middle + warp[0, 2] + warp[0, 0] * x + warp[0, 1] * y
            v = middle + warp[1, 2] + warp[1, 0] * x + warp[1, 1] * y
            residual = _grey(after, u, v) - grey[y + half, x + half]
            weighted = weight[y + half, x + half] * residual
            square += weighted * residual
            for i in range(_N):
                moment[i] += weighted * rows[y + half, x + half, i]
    return square


@njit(cache=True)
def _compose(warp: Float, step: Float) -> None:
    """Warp after the inverse of the step's own, which moved the earlier picture."""
    a, b, c, d = 1 + step[2], step[3], step[4], 1 + step[5]
    determinant = a * d - b * c
    for r in range(2):
        first, second = warp[r, 0], warp[r, 1]
        warp[r, 0] = (first * d - second * c) / determinant
        warp[r, 1] = (second * a - first * b) / determinant
        warp[r, 2] -= warp[r, 0] * step[0] + warp[r, 1] * step[1]
