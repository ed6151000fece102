"""Nearest-neighbour search among landmarks: a tree of boxes, and a grid.

Landmarks lie on walls, and a box around a piece of wall is flat. A point far from all landmarks (as
under a wrong motion) therefore finds its nearest landmark in few boxes, while a grid visits all
empty cells between them.

Query points search the tree in groups. A box, or a point of a leaf, is excluded if it is farther
from the bounding box of the group than the nearest points found so far. The distances of a group to
a point, and of a leaf's points to a bounding box, are computed by vector instructions.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import moved_point

# Largest number; the test of a box costs as much as that of about ten points.
POINTS_PER_LEAF = 64


class BoxTree(NamedTuple):
    """Binary tree of bounding boxes over N points, as arrays for kernels.

    Node 0 contains all points; the children of node k are nodes 2k + 1 and 2k + 2. Points are in
    the order of the leaves. Leaves are full, except the last one with points; the others are empty.

    Attributes:
        p: points, shape (N, 3).
        x, y, z: coordinates of the points, shape (N,).
        row: row of each point in the given array, shape (N,).
        box: lower and upper corner of each node, shape (M, 6); inf and -inf for empty nodes.
        first, end: first point of each node, and one past the last, shape (M,).
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
        """Build the tree over points (N, 3)."""
        rows, boxes, ends = split_into_leaves(p, -(-len(p) // n_leaves_of(len(p), POINTS_PER_LEAF)))
        in_order = p[rows]
        x, y, z = np.ascontiguousarray(in_order.T)
        return cls(in_order, x, y, z, rows, boxes, ends[0], ends[1])


def n_leaves_of(n: int, size: int) -> int:
    """Return the number of leaves for n points with at most `size` each, a power of two."""
    n_leaves = 1
    while n > n_leaves * size:
        n_leaves *= 2
    return n_leaves


def split_into_leaves(p: Float, size: int) -> tuple[np.ndarray, Float, np.ndarray]:
    """Split points (N, 3) along the longest side of their box until leaves hold at most `size`.

    The lower half is filled first, so that only the last leaf with points is not full.

    Returns:
        Rows of p, leaf by leaf (N,); boxes of all nodes, the root first (M, 6); and the first point
        and one past the last of each node (2, M).
    """
    n_leaves = n_leaves_of(len(p), max(size, 1))
    # NaN pads the array; padding sorts behind all points
    leaf_columns = np.full((4, 1, n_leaves * max(size, 1)), np.nan)
    leaf_columns[:3, 0, : len(p)], leaf_columns[3, 0, : len(p)] = p.T, np.arange(len(p))
    boxes, ranges = list[Float](), list[np.ndarray]()
    while True:
        lower = np.fmin.reduce(leaf_columns[:3], axis=2)
        upper = np.fmax.reduce(leaf_columns[:3], axis=2)
        boxes.append(np.concatenate([lower, upper]).T)
        n_nodes, n_held = leaf_columns.shape[1:]
        first = n_held * np.arange(n_nodes)
        ranges.append(np.minimum([first, first + n_held], len(p)))
        if n_nodes == n_leaves:
            break
        along = leaf_columns[np.argmax(upper - lower, axis=0), np.arange(n_nodes)]
        order = np.argpartition(along, n_held // 2, axis=1) + first[:, None]
        leaf_columns = (
            leaf_columns.reshape(4, -1).take(order, axis=1).reshape(4, 2 * n_nodes, n_held // 2)
        )
    box, rows = np.ascontiguousarray(np.concatenate(boxes)), leaf_columns[3].ravel()
    empty = np.isnan(box[:, 0])
    box[empty, :3], box[empty, 3:] = np.inf, -np.inf
    return rows[~np.isnan(rows)].astype(np.int64), box, np.concatenate(ranges, axis=1)


GROUP = 16  # points; enough for vector instructions, few enough to lie close together
_DEEPEST = 64  # largest depth of the tree


class Groups(NamedTuple):
    """N query points in M groups; the last group is padded with its first point.

    Attributes:
        n: number of points.
        row: row of each point in the given array, shape (M GROUP,).
        x, y, z: coordinates, shape (M GROUP,).
    """

    n: int
    row: np.ndarray
    x: Float
    y: Float
    z: Float

    @classmethod
    def of(cls, p: Float) -> "Groups":
        """Divide points (N, 3) into groups of neighbours."""
        row, _, _ = split_into_leaves(p, GROUP)
        row = np.append(row, np.full(-len(p) % GROUP, row[len(p) // GROUP * GROUP :][:1]))
        return cls(len(p), row, *np.ascontiguousarray(p[row].T))


class SearchState(NamedTuple):
    """Work space of the search for one group.

    Attributes:
        x, y, z: coordinates in the frame of the tree, shape (GROUP,).
        nearest: nearest tree point of each point, shape (GROUP,); float, so that all vectors have
            the same width.
        square: squared distances to the nearest points, shape (GROUP,).
        node: stack of nodes to visit.
        away: squared distances of these nodes.
        near: candidates among the points of a leaf.
        far: squared distances of all points of a leaf.
    """

    x: Float
    y: Float
    z: Float
    nearest: Float
    square: Float
    node: np.ndarray
    away: Float
    near: np.ndarray
    far: Float


@kernel
def new_search_state() -> SearchState:
    """Return a work space, which any number of groups may use in turn."""
    x, y, z, nearest = np.empty(GROUP), np.empty(GROUP), np.empty(GROUP), np.empty(GROUP)
    node, away = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    candidate_index = np.empty(POINTS_PER_LEAF, np.int64)
    candidate_distance = np.empty(POINTS_PER_LEAF)
    return SearchState(
        x, y, z, nearest, np.empty(GROUP), node, away, candidate_index, candidate_distance
    )


@kernel
def _largest(values: Float) -> float:
    largest = values[0]
    for q in range(1, GROUP):
        largest = max(largest, values[q])
    return largest


@kernel
def _between(low: float, high: float, box_low: float, box_high: float) -> float:
    """Return the distance between two intervals, 0 if they overlap."""
    return max(box_low - high, low - box_high, 0.0)


@kernel
def find_nearest_of_group(
    T_a_b: Float, first: int, groups: Groups, tree: BoxTree, nearest: np.ndarray, room: SearchState
) -> None:
    """Find the nearest tree points of a group under T_a_b.

    Args:
        T_a_b: motion, shape (3,).
        first: index of the first point of the group.
        groups: all groups.
        tree: tree of points.
        nearest: initial tree point of each point of all groups, shape (M GROUP,); -1 for none.
        room: work space; its `nearest` and `square` hold the result.
    """
    x, y, z, nearest_index, square, nodes, aways, candidate_index, candidate_distance = room
    _, _, own_x, own_y, own_z = groups
    _, px, py, pz, _, box, starts, ends = tree
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    # unsigned indices allow vector instructions
    start = np.uint64(first)
    for q in range(GROUP):
        i = start + np.uint64(q)
        x[q], y[q] = moved_point(T_a_b, cos, sin, own_x[i], own_y[i])
        z[q] = own_z[i]
    for q in range(GROUP):
        k = nearest[first + q]
        nearest_index[q], square[q] = k, math.inf
        if k >= 0:
            dx, dy, dz = px[k] - x[q], py[k] - y[q], pz[k] - z[q]
            square[q] = dx * dx + dy * dy + dz * dz
    # Search the tree, nearest boxes first.
    low_x, high_x, low_y, high_y, low_z, high_z = x[0], x[0], y[0], y[0], z[0], z[0]
    for q in range(1, GROUP):
        low_x, high_x = min(low_x, x[q]), max(high_x, x[q])
        low_y, high_y = min(low_y, y[q]), max(high_y, y[q])
        low_z, high_z = min(low_z, z[q]), max(high_z, z[q])
    node, n_todo, inner, max_square = 0, 0, len(starts) // 2, _largest(square)
    while True:
        if node < inner:
            closer, other = 2 * node + 1, 2 * node + 2
            dx = _between(low_x, high_x, box[closer, 0], box[closer, 3])
            dy = _between(low_y, high_y, box[closer, 1], box[closer, 4])
            dz = _between(low_z, high_z, box[closer, 2], box[closer, 5])
            away = dx * dx + dy * dy + dz * dz
            dx = _between(low_x, high_x, box[other, 0], box[other, 3])
            dy = _between(low_y, high_y, box[other, 1], box[other, 4])
            dz = _between(low_z, high_z, box[other, 2], box[other, 5])
            other_away = dx * dx + dy * dy + dz * dz
            if other_away < away:
                closer, other, away, other_away = other, closer, other_away, away
            if other_away < max_square:
                nodes[n_todo], aways[n_todo] = other, other_away
                n_todo += 1
            if away < max_square:
                node = closer
                continue
        else:
            start, n, n_near = np.uint64(starts[node]), ends[node] - starts[node], 0
            for c in range(n):
                k = start + np.uint64(c)
                dx = _between(low_x, high_x, px[k], px[k])
                dy = _between(low_y, high_y, py[k], py[k])
                dz = _between(low_z, high_z, pz[k], pz[k])
                candidate_distance[c] = dx * dx + dy * dy + dz * dz
            for c in range(n):  # without a branch: candidates that are too far are overwritten
                candidate_index[n_near] = c
                n_near += candidate_distance[c] < max_square
            for c in range(n_near):
                # update the nearest points of the group with point k
                k = starts[node] + candidate_index[c]
                at_x, at_y, at_z = px[k], py[k], pz[k]
                for q in range(GROUP):
                    dx, dy, dz = at_x - x[q], at_y - y[q], at_z - z[q]
                    away = dx * dx + dy * dy + dz * dz
                    nearer = away < square[q]
                    square[q] = away if nearer else square[q]
                    nearest_index[q] = k if nearer else nearest_index[q]
            max_square = _largest(square)
        while n_todo > 0 and aways[n_todo - 1] >= max_square:
            n_todo -= 1
        if n_todo == 0:
            return
        n_todo -= 1
        node = nodes[n_todo]


_WIDER = 1 + 1e-6  # factor on a query radius, so that rounding excludes no point on its edge
_LANDMARKS_PER_CELL = 2.0  # average; a compromise between points and empty cells per query


class Grid(NamedTuple):
    """N points sorted into square cells of the plane, as arrays for kernels.

    Attributes:
        p: points, cell by cell, shape (N, 2 or 3).
        row: row of each point in the given array, shape (N,).
        start: first point of each cell, shape (nx ny + 1,).
        corner_m: lower corner of the first cell, shape (2,).
        cell_m: side of a cell.
        shape: number of cells along x and y, shape (2,).
    """

    p: Float
    row: np.ndarray
    start: np.ndarray
    corner_m: Float
    cell_m: float
    shape: np.ndarray

    @classmethod
    def of(cls, p: Float) -> "Grid":
        """Build the grid over points (N, 2 or 3)."""
        n, (x, y) = len(p), np.ascontiguousarray(p[:, :2].T)
        corner_m, extent_m, cell_m = np.zeros(2), np.zeros(2), 1.0
        if n:
            corner_m = np.array([x.min(), y.min()])
            extent_m = np.array([x.max(), y.max()]) - corner_m
        if extent_m.any():
            # points on a line have no area: bound the cell by their spacing along the longer side
            area = extent_m[0] * extent_m[1]
            cell_m = max(math.sqrt(area * _LANDMARKS_PER_CELL / n), float(extent_m.max()) / n)
        shape = (extent_m / cell_m).astype(np.int64) + 1
        column = ((x - corner_m[0]) / cell_m).astype(np.int64)
        cell = ((y - corner_m[1]) / cell_m).astype(np.int64) * shape[0] + column
        # NumPy uses the faster radix sort for short integers
        row = np.argsort(cell.astype(np.min_scalar_type(shape[0] * shape[1])), kind="stable")
        start = np.zeros(shape[0] * shape[1] + 1, np.int64)
        np.cumsum(np.bincount(cell, minlength=len(start) - 1), out=start[1:])
        return cls(p[row], row, start, corner_m, cell_m, shape)


@kernel
def _cells(middle: float, radius: float, corner: float, cell: float, cells: int) -> tuple[int, int]:
    """Return the first cell that an interval meets along one axis, and one past the last."""
    wider = radius * _WIDER
    first = max(math.floor((middle - wider - corner) / cell), 0.0)
    last = min(math.floor((middle + wider - corner) / cell), cells - 1.0)
    return (int(first), int(last) + 1) if first <= last else (0, 0)


@kernel
def ranges_within(x: float, y: float, radius_m: float, grid: Grid, runs: np.ndarray) -> int:
    """Find ranges of grid.p that contain all points within a radius of (x, y), and others.

    The first point and one past the last of each range are written to `runs` (ny, 2). Returns the
    number of ranges.
    """
    nx, ny = grid.shape[0], grid.shape[1]
    left, right = _cells(x, radius_m, grid.corner_m[0], grid.cell_m, nx)
    low, high = _cells(y, radius_m, grid.corner_m[1], grid.cell_m, ny)
    if left == right:
        return 0
    for row in range(low, high):
        runs[row - low, 0] = grid.start[row * nx + left]
        runs[row - low, 1] = grid.start[row * nx + right]
    return high - low
