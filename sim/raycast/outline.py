"""How much of each pixel convex outlines cover, exactly, and which pixels' middles lie in them.

Each edge adds, to the pixels that it crosses in a row, the change of the covered area to its right;
sums from the left are the covered shares (Levien 2016, font-rs; the same as FreeType's "cells").
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float

_LEAST_WIDTH_PX = 1e-12  # of an edge within a row, to divide by


@kernel
def fill_coverage(edges: Float, covered: Float) -> None:
    """Fill in shares (H, W), zeros before, of a window's unit squares that an outline covers.

    Its edges (E, 4) go from u and v to u and v, all in one sense around it, in any order. The
    window's first pixel has its middle at (0, 0).
    """
    height, width = covered.shape
    for k in range(len(edges)):
        u_0, v_0, u_1, v_1 = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
        u_0, v_0, u_1, v_1 = (
            u_0 + 0.5,
            v_0 + 0.5,
            u_1 + 0.5,
            v_1 + 0.5,
        )  # from its upper left corner
        if v_0 == v_1:
            continue
        sign = 1.0 if v_0 < v_1 else -1.0
        if v_0 > v_1:
            u_0, v_0, u_1, v_1 = u_1, v_1, u_0, v_0
        slope, least, most = (u_1 - u_0) / (v_1 - v_0), min(u_0, u_1), max(u_0, u_1)
        for row in range(max(int(np.floor(v_0)), 0), min(int(np.ceil(v_1)), height)):
            top, bottom = max(float(row), v_0), min(row + 1.0, v_1)
            at_top = min(max(u_0 + slope * (top - v_0), least), most)
            at_bottom = min(max(u_0 + slope * (bottom - v_0), least), most)
            left, right = min(at_top, at_bottom), max(at_top, at_bottom)
            # what lies left of the window counts in its first column
            first, last = max(int(np.floor(left)), 0), max(int(np.floor(right)) + 1, 0)
            area, before = _area(left, right, float(first)), 0.0
            for column in range(first, min(last + 1, width)):
                area_after = _area(left, right, column + 1.0)
                share = sign * (bottom - top) * (area_after - area)
                covered[row, column] += share - before
                area, before = area_after, share
    for row in range(height):
        total = 0.0
        for column in range(width):
            total += covered[row, column]
            covered[row, column] = min(abs(total), 1.0)


@kernel_part
def _area(left: float, right: float, border: float) -> float:
    """Between an edge from `left` to `right` and a border to the right of it, for a unit's rise."""
    inside = min(max(border - left, 0.0), right - left)
    return inside * inside / (2 * max(right - left, _LEAST_WIDTH_PX)) + max(border - right, 0.0)


@kernel
def fill_least(edges: Float, in_row: Float, per_column: Float, least: Float) -> None:
    """Fill in the least of K linear functions at the pixels (H, W) whose middles an outline holds.

    The outline's edges are as above. The functions have the values `in_row` (H, K) in the first
    column, and change by `per_column` (K,).
    """
    height, width = least.shape
    for row in range(height):
        begin, stop = np.inf, -np.inf
        for k in range(len(edges)):
            u_0, v_0, u_1, v_1 = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
            if min(v_0, v_1) <= row <= max(v_0, v_1) and v_0 != v_1:
                u = u_0 + (row - v_0) / (v_1 - v_0) * (u_1 - u_0)
                begin, stop = min(begin, u), max(stop, u)
        begin, stop = max(np.ceil(begin), 0.0), min(np.floor(stop), width - 1.0)
        if begin > stop:
            continue
        first, last = int(begin), int(stop)
        inside = least[row, first : last + 1]
        for i in range(len(inside)):
            inside[i] = np.inf
        for k in range(len(per_column)):
            step = per_column[k]
            at = in_row[row, k] + step * first
            for i in range(len(inside)):
                inside[i] = min(inside[i], at + step * i)
