"""Sub-pixel disparity of planar windows by a least-squares fit of grey levels.

The disparity of a plane is linear in the image: d(x, y) = d + a x + b y around the window's centre.

Grey levels of the right image between columns are interpolated by the cubic of Catmull and Rom.
Memory access and arithmetic are in separate loops: only then does the compiler vectorise the
arithmetic. Each loop covers a whole window, because passing arrays takes as long as a row.
"""

import math

import numpy as np

from mapfusion.geometry.numerics import (
    Float,
    cholesky,
    copy_lower,
    kernel,
    solve_lower,
    solve_upper,
)

# Fields of a window's pixels, row by row, shape (4, S * S) with S = 2 half + 1: grey levels of the
# left image, their slopes along u and along v, and right - left under the plane.
LEVEL, SLOPE, DOWN, RESIDUAL = range(4)
FIELDS = 4
# Work array of the interpolation, shape (2, S * S) uint32: the first of four columns of the right
# image around a pixel's position, and the grey levels of the four columns, packed into one word.
_COLUMN, _LEVELS = range(2)
LEVEL_FIELDS = 2
MOST_HALF_PX = 100  # half side of the largest window
# Length of the column sums of one product, in whole vectors and for the widest window. A constant
# length lets the compiler vectorise loops over several products.
_VECTOR_LENGTH = 8
WIDE = np.uintp(-(-(2 * MOST_HALF_PX + 1) // _VECTOR_LENGTH) * _VECTOR_LENGTH)
_ONE = np.uintp(1)  # unsigned indices need no wraparound check
_BYTE, _LOW = np.uint32(8), np.uint32(0xFF)


@kernel
def parts_inside(image: np.ndarray, u: int, v: int, half: int) -> tuple[int, int, int, int]:
    """Return the first and last row and column of a window inside the image, relative to (u, v).

    A column to spare at both sides stays outside.
    """
    height, width = image.shape
    return max(-half, -v), min(half, height - 1 - v), max(-half, 1 - u), min(half, width - 2 - u)


@kernel
def fill_left(left: np.ndarray, u: int, v: int, half: int, window: Float) -> None:
    """Fill in the left image's grey levels around (u, v) and their slopes along u."""
    side = 2 * half + 1
    top, bottom, first, last = parts_inside(left, u, v, half)
    for y in range(top, bottom + 1):
        row, at = np.uintp(v + y), np.uintp((y + half) * side + half + first)
        before = np.uintp(u + first - 1)
        for i in range(last + 1 - first):
            k, m = before + np.uintp(i), at + np.uintp(i)
            slope = np.int32(left[row, k + _ONE + _ONE]) - np.int32(left[row, k])
            window[LEVEL, m], window[SLOPE, m] = left[row, k + _ONE], 0.5 * slope


@kernel
def fill_down(left: np.ndarray, u: int, v: int, half: int, window: Float) -> None:
    """Fill in the slopes along v; one-sided differences at the image border."""
    side = 2 * half + 1
    top, bottom, first, last = parts_inside(left, u, v, half)
    for y in range(top, bottom + 1):
        above, below = np.uintp(max(v + y - 1, 0)), np.uintp(min(v + y + 1, len(left) - 1))
        share = 1 / float(below - above)
        begin, at = np.uintp(u + first), np.uintp((y + half) * side + half + first)
        for i in range(last + 1 - first):
            k = begin + np.uintp(i)
            down = np.int32(left[below, k]) - np.int32(left[above, k])
            window[DOWN, at + np.uintp(i)] = share * down


@kernel
def fill_residuals(
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    plane: Float,
    n: int,
    window: Float,
    levels: np.ndarray,
    share: Float,
) -> None:
    """Fill in the residuals right - left of a window; `fill_left` comes first.

    Args:
        right: shape (H, W) uint8.
        u: column of the window's centre in the left image.
        v: row of the window's centre.
        half: half side of the window.
        plane: d, a, b of all windows, shape (N, 3).
        n: index of the window's plane.
        window: shape (FIELDS, S * S); RESIDUAL is filled in.
        levels: work array, shape (LEVEL_FIELDS, S * S) uint32.
        share: work array, shape (S * S,): fractional part of each pixel's column.
    """
    # Columns in the right image; the caller leaves out pixels beyond the border.
    d = plane[n, 0]
    a = plane[n, 1]
    b = plane[n, 2]
    highest, side = np.int32(right.shape[1] - 4), 2 * half + 1
    for y in range(-half, half + 1):
        start, at = u - d - b * y, np.uintp((y + half) * side)
        for i in range(side):
            x = float(i - half)
            u_right = start + x - a * x
            column = min(max(np.int32(u_right) - np.int32(1), np.int32(0)), highest)
            levels[_COLUMN, at + np.uintp(i)] = column
            share[at + np.uintp(i)] = u_right - float(column + np.int32(1))
    # Grey levels of the four columns around each position.
    for y in range(-half, half + 1):
        row, at = np.uintp(min(max(v + y, 0), len(right) - 1)), np.uintp((y + half) * side)
        for i in range(side):
            m = at + np.uintp(i)
            k = np.uintp(levels[_COLUMN, m])
            four = np.uint32(right[row, k])
            four |= np.uint32(right[row, k + _ONE]) << _BYTE
            four |= np.uint32(right[row, k + _ONE + _ONE]) << (_BYTE + _BYTE)
            four |= np.uint32(right[row, k + _ONE + _ONE + _ONE]) << (_BYTE + _BYTE + _BYTE)
            levels[_LEVELS, m] = four
    # Cubic interpolation.
    for i in range(len(share)):
        four, t = levels[_LEVELS, i], share[i]
        a, b = float(four & _LOW), float((four >> _BYTE) & _LOW)
        c, d = float((four >> (_BYTE + _BYTE)) & _LOW), float(four >> (_BYTE + _BYTE + _BYTE))
        cubic = c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))
        window[RESIDUAL, i] = b + 0.5 * t * cubic - window[LEVEL, i]


_MAX_STEPS = 20  # slopes converge slowly on poor texture
_CONVERGED_PX = 0.005  # largest step anywhere in the window; far below the effect of noise
# Noise adds half its variance to the mean square of slopes, so the normal matrix is too large
# (errors in variables, Fuller 1987, section 1.1). The correction leaves at least this share.
_LEAST_TEXTURE = 0.25
_AT = tuple(np.uintp(k) * WIDE for k in range(4))  # offsets of the column sums
_SINGULAR = 1e-9  # largest pivot by rounding errors, as a share of its diagonal entry


@kernel
def fit_planes(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    offset: np.ndarray,
    start: np.ndarray,
    half: int,
    slope_sigma: float,
    noise: float,
    correlation_px: float,
    row_sigma: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit disparity, its slopes and a brightness offset to each window.

    Args:
        left: shape (H, W) uint8.
        right: shape (H, W) uint8.
        pixel: centres (u, v) of the windows, shape (N, 2) int64. The windows lie inside the left
            image with one pixel to spare.
        offset: positions for the variance, relative to the centres, shape (N, 2).
        start: initial disparities, correct to a pixel or two, shape (N,).
        half: half side of the window, `MOST_HALF_PX` at most.
        slope_sigma: standard deviation of the prior on a and b, around zero.
        noise: standard deviation of the grey levels of one image.
        correlation_px: correlation length of the residuals beyond noise.
        row_sigma: standard deviation of the row error between the images, pixels; one error for a
            whole window.

    Returns:
        Planes d, a, b, shape (N, 3), and the variances of d + a x + b y at the offsets, shape (N,).
        Both are NaN where the fit leaves the image or the texture is too poor.

    The estimate is w' J^T r with w = (N_0 + prior)^-1 row. N is the normal matrix of the observed
    slopes, N_0 is N without the contribution of noise. The moments J^T r have the covariance
    M = (N_0 + N) / 2: noise of the slopes times noise of the right image. The product with noise of
    the left image cancels between neighbours. So the variance is w' (M + prior) w times the
    variance of the grey levels; the prior accounts for the bias of the slopes.
    """
    plane, variance = np.zeros((len(pixel), 3)), np.empty(len(pixel))
    area, side = (2 * half + 1) ** 2, 2 * half + 1
    window, share = np.empty((FIELDS, area)), np.empty(area)
    levels = np.empty((LEVEL_FIELDS, area), np.uint32)
    normal, factor, weight = np.zeros((4, 4)), np.empty((4, 4)), np.empty(4)
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        plane[n, 0] = start[n]
        fill_left(left, u, v, half, window)

        # Lower half of J^T J of the brightness offset, d, a and b. Slopes are multiples of a half,
        # so the sums are exact in any order.
        for i in range(4):
            for j in range(i + 1):
                normal[i, j] = 0.0
        for y in range(-half, half + 1):
            g0 = g1 = s0 = s1 = s2 = 0.0
            middle = (y + half) * side + half
            for x in range(-half, half + 1):
                g = window[SLOPE, middle + x]
                gx = g * x
                g0, g1 = g0 + g, g1 + gx
                s0, s1, s2 = s0 + g * g, s1 + g * gx, s2 + gx * gx
            normal[0, 0] += side
            normal[1, 0] += g0
            normal[2, 0] += g1
            normal[3, 0] += g0 * y
            normal[1, 1] += s0
            normal[2, 1] += s1
            normal[2, 2] += s2
            normal[3, 1] += s0 * y
            normal[3, 2] += s1 * y
            normal[3, 3] += s0 * y * y

        variance_grey = _gauss_newton(
            right, u, v, half, normal, slope_sigma, noise, window, levels, share, plane, n
        )
        if math.isnan(variance_grey):
            plane[n, 0] = plane[n, 1] = plane[n, 2] = variance[n] = np.nan
            continue

        # N_0 in `factor`, M in the diagonal of `normal`.
        copy_lower(normal, factor)
        added = noise**2 / 2 * side**2
        for i in range(1, 4):
            factor[i, i] -= min(added, (1 - _LEAST_TEXTURE) * normal[i, i])
            added = noise**2 / 2 * side**2 * half * (half + 1) / 3  # mean of x^2
        for i in range(1, 4):
            normal[i, i] = (normal[i, i] + factor[i, i]) / 2
        prior = variance_grey / slope_sigma**2
        factor[2, 2] += prior
        factor[3, 3] += prior
        if not cholesky(factor, _SINGULAR):
            plane[n, 0] = plane[n, 1] = plane[n, 2] = variance[n] = np.nan
            continue
        weight[0], weight[1], weight[2], weight[3] = 0.0, 1.0, offset[n, 0], offset[n, 1]
        solve_lower(factor, weight)
        solve_upper(factor, weight)

        square = prior * (weight[2] ** 2 + weight[3] ** 2)
        for i in range(4):
            square += weight[i] ** 2 * normal[i, i]
            for j in range(i):
                square += 2 * weight[i] * weight[j] * normal[i, j]
        # Noise is independent; the residuals beyond noise are correlated.
        independent = min(variance_grey, 2 * noise**2)
        correlated = correlation_px**2 * (variance_grey - independent)
        variance[n] = (independent + correlated) * square

        # A row error makes the residuals the slope along v times the error.
        if row_sigma > 0:
            change = 0.0
            for y in range(v - half, v + half + 1):
                # the window's own rows where the next one lies outside the image
                above, below = max(y - 1, 0), min(y + 1, left.shape[0] - 1)
                for x in range(-half, half + 1):
                    slope = 0.5 * (float(left[y, u + x + 1]) - float(left[y, u + x - 1]))
                    down = (float(left[below, u + x]) - float(left[above, u + x])) / (below - above)
                    along = weight[1] + weight[2] * x + weight[3] * (y - v)
                    change += (weight[0] + slope * along) * down
            variance[n] += (row_sigma * change) ** 2
    return plane, variance


@kernel
def _gauss_newton(
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    normal: np.ndarray,
    slope_sigma: float,
    noise: float,
    window: Float,
    levels: np.ndarray,
    share: Float,
    plane: np.ndarray,
    n: int,
) -> float:
    """Iterate plane n to convergence; return the variance of the residuals, or NaN."""
    count, side = (2 * half + 1) ** 2, 2 * half + 1
    factor, step = np.empty((4, 4)), np.empty(4)
    down = np.empty(len(_AT) * WIDE)
    variance_grey = 2 * noise**2
    for _ in range(_MAX_STEPS):
        first = u - half - plane[n, 0] + plane[n, 1] * half
        last = u + half - plane[n, 0] - plane[n, 1] * half
        lean = abs(plane[n, 2]) * half
        if not (first - lean >= 1 and last + lean < right.shape[1] - 2 and first < last):
            return np.nan
        fill_residuals(right, u, v, half, plane, n, window, levels, share)

        # Sum of squared residuals and J^T r: first sums per column, in `down`, which vectorise.
        for i in range(side):
            m = np.uintp(i)
            down[m] = down[m + _AT[1]] = down[m + _AT[2]] = down[m + _AT[3]] = 0.0
        for row in range(side):
            y, at = float(row - half), np.uintp(row * side)
            for i in range(side):
                m, k = np.uintp(i), at + np.uintp(i)
                r = window[RESIDUAL, k]
                along = window[SLOPE, k] * r
                down[m] += r * r
                down[m + _AT[1]] += r
                down[m + _AT[2]] += along
                down[m + _AT[3]] += along * y
        square = m0 = m1 = m2 = m3 = 0.0
        for i in range(side):
            m = np.uintp(i)
            along = down[m + _AT[2]]
            square, m0, m1 = square + down[m], m0 + down[m + _AT[1]], m1 + along
            m2, m3 = m2 + along * (i - half), m3 + down[m + _AT[3]]
        step[0], step[1], step[2], step[3] = m0, m1, m2, m3

        prior = variance_grey / slope_sigma**2
        copy_lower(normal, factor)
        factor[2, 2] += prior
        factor[3, 3] += prior
        step[2] -= prior * plane[n, 1]
        step[3] -= prior * plane[n, 2]
        if not cholesky(factor, _SINGULAR):
            return np.nan
        solve_lower(factor, step)
        solve_upper(factor, step)
        for i in range(3):
            plane[n, i] += step[i + 1]
        variance_grey = max(square - count * step[0] ** 2, 0.0) / (count - 4)
        if abs(step[1]) + half * (abs(step[2]) + abs(step[3])) < _CONVERGED_PX:
            break
    return variance_grey
