"""What windows hold against the planes that were fitted to them, read once for both tests.

Row by row, and to the left of its middle, in the middle and to the right of it: sums of what the
silhouette's test (`silhouette_test.py`) and the test for one plane (`plane_test.py`) ask for.
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.vision.plane_test import COLUMNS, SQUARES, SUMS, score
from mapfusion.vision.silhouette_test import fill_in_halves
from mapfusion.vision.window import (
    DOWN,
    FIELDS,
    LEVEL,
    RESIDUAL,
    ROOM,
    SLOPE,
    fill_down,
    fill_left,
    fill_residuals,
    parts_inside,
)

# Sums over parts of a window: of 1, L, L^2, r and L r, of g^2, h^2 and r^2, with L the grey levels
# of the left picture, g and h their slopes along u and v, r = right - left.
_PARTS = 8


@kernel
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
        silhouette_half: half side of the window of the silhouette test, pixels.
        plane_half: half side of the window of the test for one plane, pixels.

    Returns:
        Of each half (left, right, upper, lower) of each window (N, 4, 4) the number of pixels, and
        the sums of squared residuals without the window's offset in brightness, of squared slopes
        of the grey levels along u and along v. Then (N, 3): the score of the test for one plane,
        see there, and the mean squared slopes along u and along v.
    """
    half = max(silhouette_half, plane_half)
    area, ends = (2 * half + 1) ** 2, np.empty((2 * half + 1, 2), dtype=np.int64)
    window, room, share = (
        np.empty((FIELDS, area)),
        np.empty((ROOM, area), np.uint32),
        np.empty(area),
    )
    grid, parts, total = np.empty((3, 5, 3, SUMS)), np.empty((3, 3, _PARTS)), np.empty(_PARTS)
    normal, moment = np.empty((COLUMNS, COLUMNS)), np.empty(COLUMNS)
    squares, scores = np.empty((len(pixel), 4, 4)), np.empty((len(pixel), 3))
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        _find_ends(right, u, v, half, plane, n, ends)
        fill_left(left, u, v, half, window)
        fill_down(left, u, v, half, window)
        fill_residuals(right, u, v, half, plane, n, window, room, share)
        shade = float(left[v, u])  # grey levels are counted from it: small numbers lose less
        _add_up(window, ends, half, plane_half, shade, grid, parts)
        for k in range(_PARTS):
            total[k] = 0.0
            for i in range(3):
                total[k] += parts[i, 0, k] + parts[i, 1, k] + parts[i, 2, k]
        count = max(total[0], 1.0)
        scores[n, 0] = score(grid, total, normal, moment)
        scores[n, 1], scores[n, 2] = total[5] / count, total[6] / count
        if silhouette_half != plane_half:
            _add_up(window, ends, half, silhouette_half, shade, grid, parts)
        fill_in_halves(parts, squares, n)
    return squares, scores


@kernel_part
def _find_ends(
    right: np.ndarray, u: int, v: int, half: int, plane: Float, n: int, ends: np.ndarray
) -> None:
    """Fill in (S, 2): of each row of a window the first and the last x that lie in both pictures.

    Where none does the last comes before the first.
    """
    top, bottom, left_end, right_end = parts_inside(right, u, v, half)
    d, a, b = plane[n, 0], plane[n, 1], plane[n, 2]
    for y in range(-half, half + 1):
        first, last, start = left_end, right_end, u - d - b * y
        if not top <= y <= bottom:
            last = first - 1
        while first <= last and not 1 <= start + first - a * first < right.shape[1] - 2:
            first += 1
        while first <= last and not 1 <= start + last - a * last < right.shape[1] - 2:
            last -= 1
        ends[y + half, 0], ends[y + half, 1] = first, last


@kernel
def _add_up(
    window: Float, ends: np.ndarray, half: int, own: int, shade: float, grid: Float, parts: Float
) -> None:
    """Sums over the pixels of a window that are up to `own` from its middle.

    Args:
        window: of half side `half`.
        ends: of its rows.
        half: of the window.
        own: of what is looked at.
        shade: what grey levels are counted from.
        grid: (3, 5, 3, SUMS), changed: of y^q (q to 4) times what `_sum_up` gives, of the rows
            above the middle, of that in it and of those below, and likewise along rows.
        parts: (3, 3, _PARTS), changed: of the same parts of the window.
    """
    row = np.empty((3, SUMS))
    _clear(grid, parts)
    for y in range(-own, own + 1):
        part, middle = 1 + (y > 0) - (y < 0), (y + half) * (2 * half + 1) + half
        first, last = max(ends[y + half, 0], -own), min(ends[y + half, 1], own)
        for side in range(3):
            begin = max(first, (first, 0, 1)[side])
            end = min(last, (-1, 0, last)[side])
            _sum_up(window, middle, begin, end, shade, row, side, parts, part)
        power = 1.0
        for q in range(5):
            # what is not squared is asked for with y^2 at most, squares with x^k y^(4 - k)
            for side in range(3):
                for k in range(0 if q <= 2 else SQUARES, SUMS - q):
                    grid[part, q, side, k] += power * row[side, k]
            power *= y


@kernel_part
def _clear(grid: Float, parts: Float) -> None:
    for part in range(3):
        for side in range(3):
            for k in range(_PARTS):
                parts[part, side, k] = 0.0
            for q in range(5):
                for k in range(SUMS):
                    grid[part, q, side, k] = 0.0


@kernel_part
def _sum_up(
    window: Float,
    middle: int,
    begin: int,
    end: int,
    shade: float,
    row: Float,
    side: int,
    parts: Float,
    part: int,
) -> None:
    """Sums over the pixels `begin` to `end` of the row whose middle is pixel `middle`.

    Fills in `row[side]`: g x^k (k to 2) times 1, L and r, and g^2 x^k (k to 4); adds to `parts`.
    """
    g0 = g1 = g2 = l0 = l1 = l2 = r0 = r1 = r2 = s0 = s1 = s2 = s3 = s4 = 0.0
    own = own2 = off = own_off = down2 = off2 = 0.0
    for x in range(begin, end + 1):
        k = np.uintp(middle + x)
        L, g = window[LEVEL, k] - shade, window[SLOPE, k]
        h, r = window[DOWN, k], window[RESIDUAL, k]
        gx = g * x
        gxx = gx * x
        g0, g1, g2 = g0 + g, g1 + gx, g2 + gxx
        l0, l1, l2 = l0 + g * L, l1 + gx * L, l2 + gxx * L
        r0, r1, r2 = r0 + g * r, r1 + gx * r, r2 + gxx * r
        s0, s1, s2, s3, s4 = s0 + g * g, s1 + g * gx, s2 + gx * gx, s3 + gx * gxx, s4 + gxx * gxx
        own, own2, off, own_off = own + L, own2 + L * L, off + r, own_off + L * r
        down2, off2 = down2 + h * h, off2 + r * r
    for k, value in enumerate((g0, g1, g2, l0, l1, l2, r0, r1, r2, s0, s1, s2, s3, s4)):
        row[side, k] = value
    count = float(max(end + 1 - begin, 0))
    for k, value in enumerate((count, own, own2, off, own_off, s0, down2, off2)):
        parts[part, side, k] += value
