"""Nearest landmarks of a map: a tree of boxes, each about half of the points of the one above it.

Landmarks lie on walls. A box about a piece of wall is flat, so a point that is far from all of them
(as under a motion that is wrong) still finds its nearest in few boxes; a grid looks at all the
empty cells between.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.se2 import Float

_POINTS_PER_LEAF = 32  # at most; distances to neighbours in memory cost less than a box to be asked
_DEEPEST = 64  # no array has 2^64 points


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


class Todo(NamedTuple):
    """Room for a search: nodes that are still to be asked, how far they are, a leaf's distances."""

    node: np.ndarray
    square: Float
    in_leaf: Float


@njit(cache=True)
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
            low, high = math.inf, -math.inf
            for k in range(first[node], end[node]):
                low, high = min(low, p[row[k], axis]), max(high, p[row[k], axis])
            box[node, axis], box[node, 3 + axis] = low, high
            if high - low > extent:
                widest, extent = axis, high - low
        if node < n_leaves - 1:
            middle = (first[node] + end[node]) // 2
            _halve(p[:, widest], row, first[node], end[node], middle)
            first[2 * node + 1], end[2 * node + 1] = first[node], middle
            first[2 * node + 2], end[2 * node + 2] = middle, end[node]
    in_order = p[row]
    x, y, z = in_order[:, 0].copy(), in_order[:, 1].copy(), in_order[:, 2].copy()
    return BoxTree(in_order, x, y, z, row, box, first, end)


@njit(cache=True)
def _halve(x: Float, row: np.ndarray, first: int, end: int, middle: int) -> None:
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


@njit(cache=True)
def room_for_search() -> Todo:
    """What `look_up` needs; one for any number of searches, one after the other."""
    return Todo(np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST), np.empty(_POINTS_PER_LEAF))


@njit(cache=True, inline="always")
def _square_to_box(box: Float, node: int, x: float, y: float, z: float) -> float:
    dx = max(box[node, 0] - x, x - box[node, 3], 0.0)
    dy = max(box[node, 1] - y, y - box[node, 4], 0.0)
    dz = max(box[node, 2] - z, z - box[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def put_in_order(x: float, y: float, z: float, p: Float, near: np.ndarray, square: Float) -> None:
    """Order points `near` (K,) of p (N, 3) by how far they are, and tell it; -1 is no point."""
    for i in range(len(near)):
        k, away, j = near[i], math.inf, i
        if k >= 0:
            dx, dy, dz = p[k, 0] - x, p[k, 1] - y, p[k, 2] - z
            away = dx * dx + dy * dy + dz * dz
        while j > 0 and square[j - 1] > away:
            near[j], square[j] = near[j - 1], square[j - 1]
            j -= 1
        near[j], square[j] = k, away


@njit(cache=True)
def look_up(
    x: float, y: float, z: float, tree: BoxTree, near: np.ndarray, square: Float, todo: Todo
) -> None:
    """Fill in the K nearest points of the tree, nearest first, and their squared distances (K,).

    What is in `near` already, in order, makes it shorter; -1 is no point.
    """
    _, px, py, pz, _, box, starts, ends = tree
    nodes, squares, in_leaf = todo
    node, n_todo, inner, last = 0, 0, len(starts) // 2, len(near) - 1
    most = square[last]
    while True:
        if node < inner:
            closer, other = 2 * node + 1, 2 * node + 2
            away = _square_to_box(box, closer, x, y, z)
            other_away = _square_to_box(box, other, x, y, z)
            if other_away < away:
                closer, other, away, other_away = other, closer, other_away, away
            if other_away < most:
                nodes[n_todo], squares[n_todo] = other, other_away
                n_todo += 1
            if away < most:
                node = closer
                continue
        else:
            first, n = starts[node], ends[node] - starts[node]
            xs, ys, zs = px[first : first + n], py[first : first + n], pz[first : first + n]
            for k in range(n):  # apart from what is decided by it: several at once
                dx, dy, dz = xs[k] - x, ys[k] - y, zs[k] - z
                in_leaf[k] = dx * dx + dy * dy + dz * dz
            for k in range(n):
                if in_leaf[k] < most:
                    known = False
                    for i in range(len(near)):
                        known = known or near[i] == first + k
                    if known:
                        continue
                    i = last
                    while i > 0 and square[i - 1] > in_leaf[k]:
                        near[i], square[i] = near[i - 1], square[i - 1]
                        i -= 1
                    near[i], square[i] = first + k, in_leaf[k]
                    most = square[last]
        while n_todo > 0 and squares[n_todo - 1] >= most:
            n_todo -= 1
        if n_todo == 0:
            return
        n_todo -= 1
        node = nodes[n_todo]
