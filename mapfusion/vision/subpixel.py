"""Sub-pixel disparity by least squares on grey levels, for windows that show part of a plane.

The disparity of a plane is linear in the image: d(x, y) = d + a x + b y around the window's centre.

Between columns the right picture is the cubic of Catmull and Rom. Each loop does one thing: those
that only look up and those that only reckon run in the processor's vectors, one that does both does
not. And each goes over a whole window: handing over its arrays takes as long as a row takes.
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

# Of a window's pixels, row by row (4, S * S) with S = 2 half + 1: grey levels of the left picture,
# their slopes along u and along v, and right - left under the plane.
LEVEL, SLOPE, DOWN, RESIDUAL = range(4)
FIELDS = 4
# On the way (2, S * S) uint32: column of the right picture before the one to the left of where a
# pixel is read, and the grey levels of four columns from there on, the bytes of one number.
_COLUMN, _LEVELS = range(2)
ROOM = 2
MOST_HALF_PX = 100  # half side of the largest window
# Sums of one product down the columns of a window have room for the widest, in whole vectors: so it
# is known how far those of two products lie apart when loops over them are compiled, and that these
# may run in the processor's vectors.
_AT_ONCE = 8
WIDE = np.uintp(-(-(2 * MOST_HALF_PX + 1) // _AT_ONCE) * _AT_ONCE)
_ONE = np.uintp(1)  # indices without a sign, which a kernel need not wrap around
_BYTE, _LOW = np.uint32(8), np.uint32(0xFF)


@kernel
def parts_inside(image: np.ndarray, u: int, v: int, half: int) -> tuple[int, int, int, int]:
    """First and last row and column, from (u, v), of a window's part with a column to spare."""
    height, width = image.shape
    return max(-half, -v), min(half, height - 1 - v), max(-half, 1 - u), min(half, width - 2 - u)


@kernel
def fill_left(left: np.ndarray, u: int, v: int, half: int, window: Float) -> None:
    """Fill in the left picture's grey levels around (u, v), and their slopes along u."""
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
    """Fill in the slopes along v; at the border that to the row inside."""
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
    room: np.ndarray,
    share: Float,
) -> None:
    """Fill in right - left, where `fill_left` has filled in.

    Args:
        right: (H, W) uint8.
        u: centre of the window in the left picture.
        v: likewise.
        half: side of the window.
        plane: (N, 3) of d, a, b.
        n: which of them.
        window: (FIELDS, S * S), its residuals are changed.
        room: (ROOM, S * S) uint32, on the way.
        share: (S * S,) likewise.
    """
    # Where pixels are read; at the border what is beside the picture is left out by others.
    d = plane[n, 0]
    a = plane[n, 1]
    b = plane[n, 2]
    highest, side = np.int32(right.shape[1] - 4), 2 * half + 1
    for y in range(-half, half + 1):
        start, at = u - d - b * y, np.uintp((y + half) * side)
        for i in range(side):
            x = float(i - half)
            place = start + x - a * x
            column = min(max(np.int32(place) - np.int32(1), np.int32(0)), highest)
            room[_COLUMN, at + np.uintp(i)] = column
            share[at + np.uintp(i)] = place - float(column + np.int32(1))
    side = 2 * half + 1
    for y in range(-half, half + 1):
        row, at = np.uintp(min(max(v + y, 0), len(right) - 1)), np.uintp((y + half) * side)
        for i in range(side):
            m = at + np.uintp(i)
            k = np.uintp(room[_COLUMN, m])
            levels = np.uint32(right[row, k])
            levels |= np.uint32(right[row, k + _ONE]) << _BYTE
            levels |= np.uint32(right[row, k + _ONE + _ONE]) << (_BYTE + _BYTE)
            levels |= np.uint32(right[row, k + _ONE + _ONE + _ONE]) << (_BYTE + _BYTE + _BYTE)
            room[_LEVELS, m] = levels
    for i in range(len(share)):
        levels, t = room[_LEVELS, i], share[i]
        a, b = float(levels & _LOW), float((levels >> _BYTE) & _LOW)
        c, d = float((levels >> (_BYTE + _BYTE)) & _LOW), float(levels >> (_BYTE + _BYTE + _BYTE))
        cubic = c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))
        window[RESIDUAL, i] = b + 0.5 * t * cubic - window[LEVEL, i]


_MAX_STEPS = 20  # a few on rich texture; where it is poor, slopes take long
_CONVERGED_PX = 0.005  # anywhere in the window; far below what noise lets one measure
# Noise adds half its variance to the mean square of slopes, which promise that much more than they
# keep (errors in variables, Fuller 1987, section 1.1). So much of it is taken for texture at least.
_LEAST_TEXTURE = 0.25
_AT = tuple(np.uintp(k) * WIDE for k in range(4))  # sums down columns, see there
_SINGULAR = 1e-9  # pivot, as a share of its diagonal element, that is rounding error


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
        half: half side of the window, `MOST_HALF_PX` at most.
        slope_sigma: standard deviation of the prior on a and b, around zero.
        noise: standard deviation of one image's grey levels.
        alike_px: what residuals hold beyond noise is alike over so many pixels each way.
        row_sigma: standard deviation of the rows by which the images are off, pixels; one shift for
            all of a window.

    Returns:
        Planes (N, 3) of d, a, b, and the variances (N,) of d + a x + b y at the offsets; NaN where
        the fit left the image or the texture is too poor.
    """
    plane, variance = np.zeros((len(pixel), 3)), np.empty(len(pixel))
    weight = np.empty((len(pixel), 4))
    plane[:, 0] = start
    pictures, noises = (left, right, pixel, offset), (slope_sigma, noise, alike_px)
    _fit_all(*pictures, half, *noises, plane, variance, weight)
    if row_sigma > 0:
        _add_rows(left, pixel, half, row_sigma, weight, variance)
    return plane, variance


@kernel
def _fit_all(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    offset: np.ndarray,
    half: int,
    slope_sigma: float,
    noise: float,
    alike_px: float,
    plane: Float,
    variance: Float,
    weight: Float,
) -> None:
    """Fit planes (N, 3), which hold the starts; fill in variances (N,) without that of rows.

    And how each estimate follows from the moments J^T r: its `weight` (N, 4).
    """
    area = (2 * half + 1) ** 2
    window, room, share = (
        np.empty((FIELDS, area)),
        np.empty((ROOM, area), np.uint32),
        np.empty(area),
    )
    for n in range(len(pixel)):
        variance[n] = _fit_plane(
            left,
            right,
            pixel[n, 0],
            pixel[n, 1],
            offset,
            half,
            slope_sigma,
            noise,
            alike_px,
            window,
            room,
            share,
            plane,
            weight,
            n,
        )


@kernel
def _fit_plane(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    offset: np.ndarray,
    half: int,
    slope_sigma: float,
    noise: float,
    alike_px: float,
    window: Float,
    room: np.ndarray,
    share: Float,
    plane: np.ndarray,
    weight: Float,
    n: int,
) -> float:
    """Move row n of `plane` to the least squares and return the variance at the offset.

    Gauss-Newton steps after Lucas and Kanade (1981). The derivatives are those of the left image,
    so the normal matrix is built once (inverse composition, Baker and Matthews 2004). What noise
    adds to it shortens the steps, most where texture is poor, and moves nothing of where they end.
    """
    seen, factor, step = np.zeros((4, 4)), np.empty((4, 4)), np.empty(4)
    fill_left(left, u, v, half, window)
    # Add up the lower half of J^T J, of the offset in brightness, d, a and b.
    # Slopes are multiples of a half, so that in whatever order the sums are exact.
    for y in range(-half, half + 1):
        g0 = g1 = s0 = s1 = s2 = 0.0
        middle = (y + half) * (2 * half + 1) + half
        for x in range(-half, half + 1):
            g = window[SLOPE, middle + x]
            gx = g * x
            g0, g1 = g0 + g, g1 + gx
            s0, s1, s2 = s0 + g * g, s1 + g * gx, s2 + gx * gx
        seen[0, 0] += 2 * half + 1
        seen[1, 0] += g0
        seen[2, 0] += g1
        seen[3, 0] += g0 * y
        seen[1, 1] += s0
        seen[2, 1] += s1
        seen[2, 2] += s2
        seen[3, 1] += s0 * y
        seen[3, 2] += s1 * y
        seen[3, 3] += s0 * y * y
    variance_grey = _settle(
        right, u, v, half, seen, slope_sigma, noise, window, room, share, plane, n
    )
    if math.isnan(variance_grey):
        return np.nan
    # J^T J (4, 4), its lower half, less what the noise of slopes has added to their squares.
    copy_lower(seen, factor)
    added = noise**2 / 2 * (2 * half + 1) ** 2
    for i in range(1, 4):
        factor[i, i] -= min(added, (1 - _LEAST_TEXTURE) * seen[i, i])
        added = noise**2 / 2 * (2 * half + 1) ** 2 * half * (half + 1) / 3  # mean of x^2
    for i in range(1, 4):  # the moments' covariance
        seen[i, i] = (seen[i, i] + factor[i, i]) / 2
    prior = variance_grey / slope_sigma**2
    factor[2, 2] += prior
    factor[3, 3] += prior
    if not cholesky(factor, _SINGULAR):
        _give_up(plane, n)
        return np.nan
    step[0], step[1], step[2], step[3] = 0.0, 1.0, offset[n, 0], offset[n, 1]
    solve_lower(factor, step)
    solve_upper(factor, step)
    for i in range(4):
        weight[n, i] = step[i]
    return _counted(variance_grey, noise, alike_px) * _square(seen, prior, step)


@kernel
def _settle(
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    seen: np.ndarray,
    slope_sigma: float,
    noise: float,
    window: Float,
    room: np.ndarray,
    share: Float,
    plane: np.ndarray,
    n: int,
) -> float:
    """Take steps until plane moves nowhere in the window; the residuals' variance, or NaN."""
    count = (2 * half + 1) ** 2
    factor, step = np.empty((4, 4)), np.empty(4)
    down = np.empty(len(_AT) * WIDE)
    variance_grey = 2 * noise**2
    for _ in range(_MAX_STEPS):
        first = u - half - plane[n, 0] + plane[n, 1] * half
        last = u + half - plane[n, 0] - plane[n, 1] * half
        lean = abs(plane[n, 2]) * half
        if not (first - lean >= 1 and last + lean < right.shape[1] - 2 and first < last):
            _give_up(plane, n)
            return np.nan
        fill_residuals(right, u, v, half, plane, n, window, room, share)
        # Sum of the squared residuals; `moment` gets J^T r.
        # Sums are taken down the columns first, into `down`: so loops run in vectors.
        side = 2 * half + 1
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
        copy_lower(seen, factor)
        factor[2, 2] += prior
        factor[3, 3] += prior
        step[2] -= prior * plane[n, 1]
        step[3] -= prior * plane[n, 2]
        if not cholesky(factor, _SINGULAR):
            _give_up(plane, n)
            return np.nan
        solve_lower(factor, step)
        solve_upper(factor, step)
        for i in range(3):
            plane[n, i] += step[i + 1]
        variance_grey = max(square - count * step[0] ** 2, 0.0) / (count - 4)
        if abs(step[1]) + half * (abs(step[2]) + abs(step[3])) < _CONVERGED_PX:
            break
    return variance_grey


@kernel
def _give_up(plane: np.ndarray, n: int) -> None:
    for i in range(3):
        plane[n, i] = np.nan


@kernel
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


@kernel
def _add_rows(
    left: np.ndarray, pixel: np.ndarray, half: int, row_sigma: float, weight: Float, variance: Float
) -> None:
    """Add to variances (N,) what estimates change by when the right windows' rows are off.

    That makes residuals the slope along v, and of these follows, by `weight`, the change.
    """
    for n in range(len(pixel)):
        u, v, change = pixel[n, 0], pixel[n, 1], 0.0
        for y in range(v - half, v + half + 1):
            # the window's own rows where the next one lies outside the image
            above, below = max(y - 1, 0), min(y + 1, left.shape[0] - 1)
            for x in range(-half, half + 1):
                slope = 0.5 * (float(left[y, u + x + 1]) - float(left[y, u + x - 1]))
                down = (float(left[below, u + x]) - float(left[above, u + x])) / (below - above)
                along = weight[n, 1] + weight[n, 2] * x + weight[n, 3] * (y - v)
                change += (weight[n, 0] + slope * along) * down
        variance[n] += (row_sigma * change) ** 2


@kernel
def _counted(variance_grey: float, noise: float, alike_px: float) -> float:
    """Variance of residuals as if all were independent: noise is, what exceeds it is not."""
    independent = min(variance_grey, 2 * noise**2)
    return independent + alike_px**2 * (variance_grey - independent)
