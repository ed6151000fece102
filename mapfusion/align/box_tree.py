"""A map's landmarks in a tree of boxes, each about half of the points of the one above it.

Landmarks lie on walls. A box about a piece of wall is flat, so a point that is far from all of them
(as under a motion that is wrong) still finds its nearest in few boxes; a grid looks at all the
empty cells between.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.se2 import Float

_POINTS_PER_LEAF = 16  # at most; a box to be asked costs as much as some points of a leaf


class BoxTree(NamedTuple):
    """N points, in the order of the leaves, and boxes about them, for the kernels.

    Node 0 holds all points; the halves of node k are nodes 2k + 1 and 2k + 2.

    Attributes:
        p: (N, 3) the points.
        x, y, z: (N,) their coordinates, each by itself.
        row: (N,) where each was in the array given.
        box: (M, 6) lower corner and upper corner of each node.
        first, end: (M,) first point of each node, and one behind the last.
    """

    p: Float
    x: Float
    y: Float
    z: Float
    row: np.ndarray
    box: Float
    first: np.ndarray
    end: np.ndarray

    @classmethod
    def of(cls, p: Float) -> "BoxTree":
        """Tree over points (N, 3)."""
        return _boxes_about(np.ascontiguousarray(p))


@kernel
def _boxes_about(p: Float) -> BoxTree:
    n, n_leaves = len(p), 1
    while n > n_leaves * _POINTS_PER_LEAF:
        n_leaves *= 2
    n_nodes = 2 * n_leaves - 1
    row, box = np.arange(n), np.empty((n_nodes, 6))
    first, end = np.zeros(n_nodes, np.int64), np.zeros(n_nodes, np.int64)
    end[0] = n
    for node in range(n_nodes):
        widest, extent = 0, -math.inf
        for axis in range(3):
            low, high = span(p, row, first[node], end[node], axis)
            box[node, axis], box[node, 3 + axis] = low, high
            if high - low > extent:
                widest, extent = axis, high - low
        if node < n_leaves - 1:
            middle = (first[node] + end[node]) // 2
            halve(p[:, widest], row, first[node], end[node], middle)
            first[2 * node + 1], end[2 * node + 1] = first[node], middle
            first[2 * node + 2], end[2 * node + 2] = middle, end[node]
    in_order = p[row]
    x, y, z = in_order[:, 0].copy(), in_order[:, 1].copy(), in_order[:, 2].copy()
    return BoxTree(in_order, x, y, z, row, box, first, end)


@kernel
def span(p: Float, row: np.ndarray, first: int, end: int, axis: int) -> tuple[float, float]:
    """The least and the greatest coordinate of the points row[first:end] of p (N, D)."""
    low, high = math.inf, -math.inf
    for k in range(first, end):
        low, high = min(low, p[row[k], axis]), max(high, p[row[k], axis])
    return low, high


@kernel
def halve(x: Float, row: np.ndarray, first: int, end: int, middle: int) -> None:
    """Put row[first:end] so that x of none before `middle` is larger than x of any from there on.

    Quickselect (Hoare 1961).
    """
    low, high = first, end - 1
    while low < high:
        pivot, i, j = x[row[(low + high) // 2]], low, high
        while i <= j:
            while x[row[i]] < pivot:
                i += 1
            while x[row[j]] > pivot:
                j -= 1
            if i <= j:
                row[i], row[j] = row[j], row[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return
