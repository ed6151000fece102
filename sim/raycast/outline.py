"""How much of each pixel a convex outline covers, exactly.

Each edge adds, to the pixels that it crosses in a row, the change of the covered area to its right;
sums from the left are the covered shares (Levien 2016, font-rs; the same as FreeType's "cells").
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float


@kernel
def hull(points: Float) -> Float:
    """Corners (K, 2) of the convex hull of points (N, 2), in one sense (Andrew 1979)."""
    order, n = _from_left(points), len(points)
    chain, k = np.empty((2 * n + 1, 2)), 0
    for half in range(2):
        begin = k
        for m in range(n):
            p = points[order[m] if half == 0 else order[n - 1 - m]]
            while k >= begin + 2 and _turn(chain[k - 2], chain[k - 1], p) <= 0:
                k -= 1
            chain[k, 0], chain[k, 1] = p[0], p[1]
            k += 1
        k -= 1  # the last of one half is the first of the other
    return chain[:k].copy()


@kernel_part
def _from_left(points: Float) -> np.ndarray:
    """The order (N,) of points (N, 2) by u, and by v where upright edges share u; N is small."""
    order = np.empty(len(points), dtype=np.int64)
    for m in range(len(points)):
        u, v = points[m]
        k = m
        while k > 0 and (points[order[k - 1], 0], points[order[k - 1], 1]) > (u, v):
            order[k] = order[k - 1]
            k -= 1
        order[k] = m
    return order


@kernel_part
def _turn(a: Float, b: Float, c: Float) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@kernel_part
def clip(polygon: Float, width: float, height: float) -> Float:
    """A convex polygon (K, 2) inside a rectangle from (0, 0) on; (0, 2) beside it.

    Sutherland and Hodgman (1974), one side after the other.
    """
    for side in range(4):
        axis, sign = side % 2, 1.0 if side < 2 else -1.0
        bound = 0.0 if side < 2 else -width if axis == 0 else -height
        kept, k = np.empty((2 * len(polygon) + 2, 2)), 0
        for m in range(len(polygon)):
            p, q = polygon[m], polygon[(m + 1) % len(polygon)]
            p_in, q_in = sign * p[axis] - bound, sign * q[axis] - bound
            if p_in >= 0:
                kept[k, 0], kept[k, 1] = p[0], p[1]
                k += 1
            if p_in * q_in < 0:
                other = 1 - axis
                kept[k, other] = p[other] + p_in / (p_in - q_in) * (q[other] - p[other])
                kept[k, axis] = sign * bound
                k += 1
        polygon = kept[:k].copy()
    return polygon


@kernel_part
def coverage(polygon: Float, height: int, width: int) -> Float:
    """Covered shares (height, width) of the unit squares that a polygon (K, 2) lies on.

    Its corners lie inside of 0 to width and 0 to height.
    """
    change = np.zeros((height, width + 2))
    for m in range(len(polygon)):
        _add_edge(polygon[m], polygon[(m + 1) % len(polygon)], change)
    covered = np.empty((height, width))
    for row in range(height):
        total = 0.0
        for column in range(width):
            total += change[row, column]
            covered[row, column] = min(abs(total), 1.0)
    return covered


@kernel_part
def _add_edge(start: Float, end: Float, change: Float) -> None:
    """Add one edge's changes of covered area, row by row."""
    if start[1] == end[1]:
        return
    sign = 1.0 if start[1] < end[1] else -1.0
    top, bottom = (start, end) if start[1] < end[1] else (end, start)
    slope = (bottom[0] - top[0]) / (bottom[1] - top[1])
    least, most = min(top[0], bottom[0]), max(top[0], bottom[0])
    for row in range(int(top[1]), min(int(np.ceil(bottom[1])), len(change))):
        y0, y1 = max(float(row), top[1]), min(row + 1.0, bottom[1])
        a = min(max(top[0] + slope * (y0 - top[1]), least), most)
        b = min(max(top[0] + slope * (y1 - top[1]), least), most)
        left, right, rise = min(a, b), max(a, b), sign * (y1 - y0)
        first, last = int(left), int(right)
        if first == last:
            inside = (left + right) / 2 - first
            change[row, first] += rise * (1 - inside)
            change[row, first + 1] += rise * inside
            continue
        # area to the right of the edge up to each pixel's right border, less that up to its left
        before = 0.0
        for column in range(first, last + 1):
            x0, x1 = max(left, float(column)), min(right, column + 1.0)
            crossed = rise * (x1 - x0) / (right - left)
            now = crossed * (column + 1 - (x0 + x1) / 2)
            change[row, column] += now + before
            before = crossed - now
        change[row, last + 1] += before
