"""Sub-pixel disparity by least squares on grey levels, for windows that show a piece of a plane.

The disparity of a plane is linear in the image: d(x, y) = d + a x + b y around the window's centre.
"""

import math

import numpy as np
from numba import njit

from mapfusion.symmetric import cholesky, copy_lower, solve_lower, solve_upper

_MAX_STEPS = 20  # a few on rich texture; where it is poor, slopes take long
_CONVERGED_PX = 0.005  # anywhere in the window; far below what noise lets one measure
# Noise adds half its variance to the mean square of slopes, which promise that much more than they
# keep (errors in variables, Fuller 1987, section 1.1). So much of it is taken for texture at least.
_LEAST_TEXTURE = 0.25
_SINGULAR = 1e-9  # pivot, as a share of its diagonal element, that is rounding error


@njit(cache=True)
def fit_planes(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    offset: np.ndarray,
    start: np.ndarray,
    half: int,
    slope_sigma: float,
    noise: float,
    alike_px: float,
    row_sigma: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit disparity, slopes and an offset in brightness to each window.

    Args:
        left: (H, W) uint8.
        right: (H, W) uint8.
        pixel: (N, 2) int64 centres (u, v) of the windows, which lie inside the left image with one
            pixel to spare.
        offset: (N, 2) from the centres to the points whose variance is wanted.
        start: (N,) disparities right to a pixel or two.
        half: half side of the window, pixels.
        slope_sigma: standard deviation of the prior on a and b, around zero.
        noise: standard deviation of one image's grey levels.
        alike_px: what residuals hold beyond noise is alike over so many pixels each way.
        row_sigma: standard deviation of the rows by which the images are off, pixels; one shift for
            all of a window.

    Returns:
        Planes (N, 3) of d, a, b, and the variances (N,) of d + a x + b y at the offsets; NaN where
        the fit left the image or the texture is too poor.
    """
    plane = np.zeros((len(pixel), 3))
    variance = np.empty(len(pixel))
    for n in range(len(pixel)):
        plane[n, 0] = start[n]
        variance[n] = _fit_plane(
            left,
            right,
            pixel[n],
            offset[n],
            half,
            slope_sigma,
            noise,
            alike_px,
            row_sigma,
            plane[n],
        )
    return plane, variance


@njit(cache=True)
def grey_at(image: np.ndarray, x: float, y: int) -> float:
    """Grey level between columns by the cubic of Catmull and Rom, for 1 <= x < width - 2."""
    k = int(x)
    t = x - k
    p0, p1 = float(image[y, k - 1]), float(image[y, k])
    p2, p3 = float(image[y, k + 1]), float(image[y, k + 2])
    return p1 + 0.5 * t * (
        p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0))
    )


@njit(cache=True)
def _fit_plane(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    offset: np.ndarray,
    half: int,
    slope_sigma: float,
    noise: float,
    alike_px: float,
    row_sigma: float,
    plane: np.ndarray,
) -> float:
    """Move `plane` (3,) to the least squares and return the variance at the offset.

    Gauss-Newton steps after Lucas and Kanade (1981). The derivatives are those of the left image,
    so the normal matrix is built once (inverse composition, Baker and Matthews 2004). What noise
    adds to it shortens the steps, most where texture is poor, and moves nothing of where they end.
    """
    u, v = pixel[0], pixel[1]
    seen, factor, step = np.zeros((4, 4)), np.empty((4, 4)), np.empty(4)
    _normal_matrix(left, u, v, half, seen)
    variance_grey = _settle(left, right, u, v, half, seen, slope_sigma, noise, plane)
    if math.isnan(variance_grey):
        return np.nan
    _without_noise(seen, half, noise, factor)
    for i in range(1, 4):  # the moments' covariance
        seen[i, i] = (seen[i, i] + factor[i, i]) / 2
    prior = variance_grey / slope_sigma**2
    factor[2, 2] += prior
    factor[3, 3] += prior
    if not cholesky(factor, _SINGULAR):
        plane[:] = np.nan
        return np.nan
    step[0], step[1], step[2], step[3] = 0.0, 1.0, offset[0], offset[1]
    solve_lower(factor, step)
    solve_upper(factor, step)
    variance = _counted(variance_grey, noise, alike_px) * _square(seen, prior, step)
    if row_sigma > 0:
        variance += (row_sigma * _by_row(left, u, v, half, step)) ** 2
    return variance


@njit(cache=True)
def _settle(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    seen: np.ndarray,
    slope_sigma: float,
    noise: float,
    plane: np.ndarray,
) -> float:
    """Take steps until plane moves nowhere in the window; the residuals' variance, or NaN."""
    count = (2 * half + 1) ** 2
    factor, step = np.empty((4, 4)), np.empty(4)
    variance_grey = 2 * noise**2
    for _ in range(_MAX_STEPS):
        first = u - half - plane[0] + plane[1] * half
        last = u + half - plane[0] - plane[1] * half
        lean = abs(plane[2]) * half
        if not (first - lean >= 1 and last + lean < right.shape[1] - 2 and first < last):
            plane[:] = np.nan
            return np.nan
        square = _residuals(left, right, u, v, half, plane, step)
        prior = variance_grey / slope_sigma**2
        copy_lower(seen, factor)
        factor[2, 2] += prior
        factor[3, 3] += prior
        step[2] -= prior * plane[1]
        step[3] -= prior * plane[2]
        if not cholesky(factor, _SINGULAR):
            plane[:] = np.nan
            return np.nan
        solve_lower(factor, step)
        solve_upper(factor, step)
        plane += step[1:]
        variance_grey = max(square - count * step[0] ** 2, 0.0) / (count - 4)
        if abs(step[1]) + half * (abs(step[2]) + abs(step[3])) < _CONVERGED_PX:
            break
    return variance_grey


@njit(cache=True)
def _square(moments: np.ndarray, prior: float, weight: np.ndarray) -> float:
    """Of an estimate w' J^T r: w' (M + prior) w, in variances of the grey levels.

    With N the matrix that is seen and N_0 the same less what noise adds, w = (N_0 + prior)^-1 row.
    The moments J^T r have the covariance M = (N_0 + N) / 2: noise of slopes times that of the right
    picture; times that of the left one, which it is itself, neighbours cancel. Slopes that the
    prior holds back are off by what it says.
    """
    square = prior * (weight[2] ** 2 + weight[3] ** 2)
    for i in range(4):
        square += weight[i] ** 2 * moments[i, i]
        for j in range(i):
            square += 2 * weight[i] * weight[j] * moments[i, j]
    return square


@njit(cache=True)
def _without_noise(seen: np.ndarray, half: int, noise: float, normal: np.ndarray) -> None:
    """J^T J (4, 4), its lower half, less what the noise of slopes has added to their squares."""
    copy_lower(seen, normal)
    added = noise**2 / 2 * (2 * half + 1) ** 2
    for i in range(1, 4):
        normal[i, i] -= min(added, (1 - _LEAST_TEXTURE) * seen[i, i])
        added = noise**2 / 2 * (2 * half + 1) ** 2 * half * (half + 1) / 3  # mean of x^2


@njit(cache=True)
def _normal_matrix(left: np.ndarray, u: int, v: int, half: int, normal: np.ndarray) -> None:
    """Add up the lower half of J^T J, of the offset in brightness, d, a and b."""
    row = np.empty(4)
    for y in range(v - half, v + half + 1):
        for x in range(-half, half + 1):
            slope = 0.5 * (float(left[y, u + x + 1]) - float(left[y, u + x - 1]))
            row[0], row[1], row[2], row[3] = 1.0, slope, slope * x, slope * (y - v)
            for i in range(4):
                for j in range(i + 1):
                    normal[i, j] += row[i] * row[j]


@njit(cache=True)
def _by_row(left: np.ndarray, u: int, v: int, half: int, weight: np.ndarray) -> float:
    """How much an estimate changes when the right window is one row off.

    `weight` (4,) is how it follows from the moments J^T r; such a shift makes r the slope along v.
    """
    change = 0.0
    for y in range(v - half, v + half + 1):
        # the window's own rows where the next one lies outside the image
        above, below = max(y - 1, 0), min(y + 1, left.shape[0] - 1)
        for x in range(-half, half + 1):
            slope = 0.5 * (float(left[y, u + x + 1]) - float(left[y, u + x - 1]))
            down = (float(left[below, u + x]) - float(left[above, u + x])) / (below - above)
            along = weight[1] + weight[2] * x + weight[3] * (y - v)
            change += (weight[0] + slope * along) * down
    return change


@njit(cache=True)
def _counted(variance_grey: float, noise: float, alike_px: float) -> float:
    """Variance of residuals as if all were independent: noise is, what exceeds it is not."""
    independent = min(variance_grey, 2 * noise**2)
    return independent + alike_px**2 * (variance_grey - independent)


@njit(cache=True)
def _residuals(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    plane: np.ndarray,
    moment: np.ndarray,
) -> float:
    """Sum of the squared differences right - left under `plane`; `moment` gets J^T r."""
    square = 0.0
    moment[:] = 0.0
    for y in range(-half, half + 1):
        start = u - plane[0] - plane[2] * y
        for x in range(-half, half + 1):
            residual = grey_at(right, start + x - plane[1] * x, v + y) - float(left[v + y, u + x])
            slope = 0.5 * (float(left[v + y, u + x + 1]) - float(left[v + y, u + x - 1]))
            square += residual * residual
            moment[0] += residual
            moment[1] += slope * residual
            moment[2] += slope * x * residual
            moment[3] += slope * y * residual
    return square
