"""What windows hold against the planes that were fitted to them, read once for both tests.

These are sums over their pixels, which the silhouette's test (`silhouette_test.py`) and the test
for one plane (`plane_test.py`) ask for.
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.vision import plane_test, silhouette_test
from mapfusion.vision.plane_test import COLUMNS, score
from mapfusion.vision.silhouette_test import fill_in_halves
from mapfusion.vision.window import (
    DOWN,
    FIELDS,
    LEVEL,
    RESIDUAL,
    ROOM,
    SLOPE,
    WIDE,
    fill_down,
    fill_left,
    fill_residuals,
    parts_inside,
)
from mapfusion.vision.window_moments import (
    GG,
    HH,
    N_PRODUCTS,
    ONE,
    SIDES,
    column_weights,
    moment,
)

_ASKED = (plane_test.ASKED, silhouette_test.ASKED, (moment(ONE), moment(GG), moment(HH)))
# Each sum is taken once, and so are those down the columns that several go on from.
_SUMS, _place = np.unique([m for asked in _ASKED for m in asked], axis=0, return_inverse=True)
_DOWN_SUMS, _FROM = np.unique(_SUMS[:, :2], axis=0, return_inverse=True)
_OF_PLANE, _OF_HALVES, _OF_SLOPES = np.split(_place, np.cumsum([len(a) for a in _ASKED[:-1]]))
# Where sums of each product begin, and those of the rows of the next part.
_AT = tuple(np.uintp(k) * WIDE for k in range(N_PRODUCTS))
_PART = np.uintp(N_PRODUCTS) * WIDE
_INSIDE = FIELDS  # of a window's pixels, after its other fields: 1 in both pictures, else 0


def window_sums(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: Float,
    silhouette_half: int,
    plane_half: int,
) -> tuple[Float, Float]:
    """What the two tests look at.

    Args:
        left: (H, W) uint8.
        right: (H, W) uint8.
        pixel: (N, 2) int64 centres of the windows; what leaves an image is not looked at.
        plane: (N, 3) from `fit_planes`.
        silhouette_half: half side of the window of the silhouette test, `MOST_HALF_PX` at most.
        plane_half: half side of the window of the test for one plane, likewise.

    Returns:
        Of each half (left, right, upper, lower) of each window (N, 4, 4) the number of pixels, and
        the sums of squared residuals without the window's offset in brightness, of squared slopes
        of the grey levels along u and along v. Then (N, 3): the score of the test for one plane,
        see there, and the mean squared slopes along u and along v.
    """
    squares, scores = np.empty((len(pixel), 4, 4)), np.empty((len(pixel), 3))
    weight = column_weights(max(silhouette_half, plane_half))
    _look_at_all(left, right, pixel, plane, silhouette_half, plane_half, weight, squares, scores)
    return squares, scores


@kernel
def _look_at_all(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: Float,
    silhouette_half: int,
    plane_half: int,
    weight: Float,
    squares: Float,
    scores: Float,
) -> None:
    half = max(silhouette_half, plane_half)
    area = (2 * half + 1) ** 2
    window, share = np.empty((FIELDS + 1, area)), np.empty(area)
    room, down = np.empty((ROOM, area), np.uint32), np.empty(3 * N_PRODUCTS * WIDE)
    column, sums = np.empty(2 * half + 1), np.empty(len(_SUMS))
    normal, moments = np.empty((COLUMNS, COLUMNS)), np.empty(COLUMNS)
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        fill_left(left, u, v, half, window)
        fill_down(left, u, v, half, window)
        fill_residuals(right, u, v, half, plane, n, window, room, share)
        shade = float(left[v, u])  # grey levels are counted from it: small numbers lose less
        _leave_out(right, u, v, half, plane, n, shade, window)
        for own in (plane_half, silhouette_half):
            _sum_down(window, half, own, shade, down)
            _sum_along(down, half, own, weight, column, sums)
            if own == plane_half:
                pixels = max(sums[_OF_SLOPES[0]], 1.0)
                scores[n, 0] = score(sums, _OF_PLANE, normal, moments)
                scores[n, 1] = sums[_OF_SLOPES[1]] / pixels
                scores[n, 2] = sums[_OF_SLOPES[2]] / pixels
            if own == silhouette_half:
                fill_in_halves(sums, _OF_HALVES, squares, n)
                break


@kernel_part
def _leave_out(
    right: np.ndarray, u: int, v: int, half: int, plane: Float, n: int, shade: float, window: Float
) -> None:
    """Mark which pixels of a window lie in both pictures, and let the others add nothing."""
    top, bottom, left_end, right_end = parts_inside(right, u, v, half)
    d, a, b = plane[n, 0], plane[n, 1], plane[n, 2]
    for k in range(window.shape[1]):
        window[_INSIDE, k] = 1.0
    for y in range(-half, half + 1):
        first, last, start = left_end, right_end, u - d - b * y
        if not top <= y <= bottom:
            last = first - 1
        while first <= last and not 1 <= start + first - a * first < right.shape[1] - 2:
            first += 1
        while first <= last and not 1 <= start + last - a * last < right.shape[1] - 2:
            last -= 1
        if first == -half and last == half:
            continue
        middle = (y + half) * (2 * half + 1) + half
        for x in range(-half, half + 1):
            if not first <= x <= last:
                window[LEVEL, middle + x] = shade
                window[SLOPE, middle + x] = window[DOWN, middle + x] = 0.0
                window[RESIDUAL, middle + x] = window[_INSIDE, middle + x] = 0.0


@kernel_part
def _sum_down(window: Float, half: int, own: int, shade: float, down: Float) -> None:
    """Sums down the columns of a window that are up to `own` from its middle, as far up and down.

    Args:
        window: of half side `half`.
        half: of the window.
        own: of what is looked at.
        shade: what grey levels are counted from.
        down: (3 * N_PRODUCTS * WIDE,), changed: of the rows above the middle, of that in it and of
            those below the sums of each product.
    """
    for k in range(3 * N_PRODUCTS):
        first = np.uintp(k) * WIDE
        for i in range(2 * own + 1):
            down[first + np.uintp(i)] = 0.0
    for y in range(-own, own + 1):
        part = np.uintp((1 + (y > 0) - (y < 0)) * N_PRODUCTS) * WIDE
        at, q = np.uintp((y + half) * (2 * half + 1) + half - own), float(y)
        for i in range(2 * own + 1):
            m, k = part + np.uintp(i), at + np.uintp(i)
            L, g, h = window[LEVEL, k] - shade, window[SLOPE, k], window[DOWN, k]
            r, gy = window[RESIDUAL, k], g * q
            gyy = gy * q
            down[m] += g * g
            down[m + _AT[1]] += g * gy
            down[m + _AT[2]] += gy * gy
            down[m + _AT[3]] += gy * gyy
            down[m + _AT[4]] += gyy * gyy
            down[m + _AT[5]] += g
            down[m + _AT[6]] += gy
            down[m + _AT[7]] += gyy
            down[m + _AT[8]] += g * L
            down[m + _AT[9]] += gy * L
            down[m + _AT[10]] += gyy * L
            down[m + _AT[11]] += g * r
            down[m + _AT[12]] += gy * r
            down[m + _AT[13]] += gyy * r
            down[m + _AT[14]] += L
            down[m + _AT[15]] += L * L
            down[m + _AT[16]] += r
            down[m + _AT[17]] += L * r
            down[m + _AT[18]] += h * h
            down[m + _AT[19]] += r * r
            down[m + _AT[20]] += window[_INSIDE, k]


@kernel_part
def _sum_along(down: Float, half: int, own: int, weight: Float, column: Float, sums: Float) -> None:
    """Fill in what is asked for from sums down the columns; `column` is room for those of a row."""
    last = -1
    for n in range(len(_SUMS)):
        if _FROM[n] != last:
            last = _FROM[n]
            product, t = np.uintp(_DOWN_SUMS[last, 0]), _DOWN_SUMS[last, 1]
            above, at, below = SIDES[t, 0], SIDES[t, 1], SIDES[t, 2]
            m = product * WIDE
            for i in range(2 * own + 1):
                k = m + np.uintp(i)
                column[i] = above * down[k] + at * down[k + _PART] + below * down[k + _PART + _PART]
        w, total = _SUMS[n, 2], 0.0
        for i in range(2 * own + 1):
            total += column[i] * weight[w, np.uintp(half - own + i)]
        sums[n] = total
