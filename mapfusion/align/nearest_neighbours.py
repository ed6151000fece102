"""Nearest-neighbour search among landmarks: a tree of boxes, and a grid.

Landmarks lie on walls. A box about a piece of wall is flat, so a point that is far from all of them
(as under a motion that is wrong) still finds its nearest in few boxes; a grid looks at all the
empty cells between.

A group goes down the tree together: a box that is farther from the box about the group than each
point from what it has found so far is nobody's, and so is a point of a leaf. Distances of a whole
group to a point of the tree, and of a leaf's points to the group's box, are a few instructions, as
the processor takes several numbers at once.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import moved_point

# At most. To ask a box costs as much as to pass over some ten points of a leaf.
POINTS_PER_LEAF = 64


class BoxTree(NamedTuple):
    """N points, in the order of the leaves, and boxes about them, for the kernels.

    Node 0 holds all points; the halves of node k are nodes 2k + 1 and 2k + 2. The first leaves are
    full, those behind the last point are empty.

    Attributes:
        p: (N, 3) the points.
        x, y, z: (N,) their coordinates, each by itself.
        row: (N,) where each was in the array given.
        box: (M, 6) lower corner and upper corner of each node; of an empty one inf and -inf.
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
        rows, boxes, ends = split_into_leaves(p, -(-len(p) // n_leaves_of(len(p), POINTS_PER_LEAF)))
        in_order = p[rows]
        x, y, z = np.ascontiguousarray(in_order.T)
        return cls(in_order, x, y, z, rows, boxes, ends[0], ends[1])


def n_leaves_of(n: int, size: int) -> int:
    """How many leaves n points take if each may hold so many: a power of two."""
    n_leaves = 1
    while n > n_leaves * size:
        n_leaves *= 2
    return n_leaves


def split_into_leaves(p: Float, size: int) -> tuple[np.ndarray, Float, np.ndarray]:
    """Points (N, 3) halved along the longest side of their box until `size` are left or fewer.

    The lower half is filled first, so that of all leaves with points only the last is not full.

    Returns:
        (N,) rows of p, leaf by leaf; and of all nodes, the root first, the boxes (M, 6) and from
        where to where their points are (2, M).
    """
    n_leaves = n_leaves_of(len(p), max(size, 1))
    # what there are too few of is beyond all others
    held = np.full((4, 1, n_leaves * max(size, 1)), np.nan)
    held[:3, 0, : len(p)], held[3, 0, : len(p)] = p.T, np.arange(len(p))
    boxes, ranges = list[Float](), list[np.ndarray]()
    while True:
        lower, upper = np.fmin.reduce(held[:3], axis=2), np.fmax.reduce(held[:3], axis=2)
        boxes.append(np.concatenate([lower, upper]).T)
        n_nodes, n_held = held.shape[1:]
        first = n_held * np.arange(n_nodes)
        ranges.append(np.minimum([first, first + n_held], len(p)))
        if n_nodes == n_leaves:
            break
        along = held[np.argmax(upper - lower, axis=0), np.arange(n_nodes)]
        order = np.argpartition(along, n_held // 2, axis=1) + first[:, None]
        held = held.reshape(4, -1).take(order, axis=1).reshape(4, 2 * n_nodes, n_held // 2)
    box, rows = np.ascontiguousarray(np.concatenate(boxes)), held[3].ravel()
    empty = np.isnan(box[:, 0])
    box[empty, :3], box[empty, 3:] = np.inf, -np.inf
    return rows[~np.isnan(rows)].astype(np.int64), box, np.concatenate(ranges, axis=1)


GROUP = 16  # points; of fewer the compiler makes no vectors, more lie farther from each other
_DEEPEST = 64  # no array has 2^64 points


class Groups(NamedTuple):
    """N points in groups that move as one body; the last one is filled up with its first point.

    Attributes:
        n: how many they are.
        row: (M GROUP,) where each was in the array given.
        x, y, z: (M GROUP,) their coordinates.
    """

    n: int
    row: np.ndarray
    x: Float
    y: Float
    z: Float

    @classmethod
    def of(cls, p: Float) -> "Groups":
        """Groups of points (N, 3)."""
        row, _, _ = split_into_leaves(p, GROUP)
        row = np.append(row, np.full(-len(p) % GROUP, row[len(p) // GROUP * GROUP :][:1]))
        return cls(len(p), row, *np.ascontiguousarray(p[row].T))


class SearchState(NamedTuple):
    """Of one group: where its points are, what each has found, and the boxes still to be asked.

    Attributes:
        x, y, z: (GROUP,) coordinates in the tree's frame.
        nearest: (GROUP,) number of the tree's point, as a float: vectors are of one width.
        square: (GROUP,) its squared distance.
        node: nodes to be asked.
        away: their squared distances.
        near: points of a leaf that may be somebody's nearest.
        far: squared distances of all of the leaf's.
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
    """One for any number of groups, one after the other."""
    x, y, z, nearest = np.empty(GROUP), np.empty(GROUP), np.empty(GROUP), np.empty(GROUP)
    node, away = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    near, far = np.empty(POINTS_PER_LEAF, np.int64), np.empty(POINTS_PER_LEAF)
    return SearchState(x, y, z, nearest, np.empty(GROUP), node, away, near, far)


@kernel
def find_nearest_of_group(
    T_a_b: Float, first: int, groups: Groups, tree: BoxTree, nearest: np.ndarray, room: SearchState
) -> None:
    """Fill in what a group, moved by T_a_b, has nearest, from what was nearest before.

    Args:
        T_a_b: (3,).
        first: number of the group's first point.
        groups: of which it is one.
        tree: the points.
        nearest: (M GROUP,) a point of the tree for each point of the groups, -1: none yet.
        room: filled in.
    """
    x, y, z, found, square, _, _, _, _ = room
    _, _, own_x, own_y, own_z = groups
    _, px, py, pz, _, _, _, _ = tree
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    # indices without a sign, else the compiler would take one point at a time
    begin = np.uint64(first)
    for q in range(GROUP):
        i = begin + np.uint64(q)
        x[q], y[q] = moved_point(T_a_b, cos, sin, own_x[i], own_y[i])
        z[q] = own_z[i]
    for q in range(GROUP):
        k = nearest[first + q]
        found[q], square[q] = k, math.inf
        if k >= 0:
            dx, dy, dz = px[k] - x[q], py[k] - y[q], pz[k] - z[q]
            square[q] = dx * dx + dy * dy + dz * dz
    _descend(tree, room)


@kernel
def _largest(values: Float) -> float:
    largest = values[0]
    for q in range(1, GROUP):
        largest = max(largest, values[q])
    return largest


@kernel
def _between(low: float, high: float, box_low: float, box_high: float) -> float:
    """How far two intervals are apart."""
    return max(box_low - high, low - box_high, 0.0)


@kernel
def _descend(tree: BoxTree, room: SearchState) -> None:
    """Go down the tree with a group, to the nearest boxes first."""
    _, px, py, pz, _, box, starts, ends = tree
    x, y, z, found, square, nodes, aways, near, far = room
    low_x, high_x, low_y, high_y, low_z, high_z = x[0], x[0], y[0], y[0], z[0], z[0]
    for q in range(1, GROUP):
        low_x, high_x = min(low_x, x[q]), max(high_x, x[q])
        low_y, high_y = min(low_y, y[q]), max(high_y, y[q])
        low_z, high_z = min(low_z, z[q]), max(high_z, z[q])
    node, n_todo, inner, most = 0, 0, len(starts) // 2, _largest(square)
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
            if other_away < most:
                nodes[n_todo], aways[n_todo] = other, other_away
                n_todo += 1
            if away < most:
                node = closer
                continue
        else:
            begin, n, n_near = np.uint64(starts[node]), ends[node] - starts[node], 0
            for c in range(n):
                k = begin + np.uint64(c)
                dx = _between(low_x, high_x, px[k], px[k])
                dy = _between(low_y, high_y, py[k], py[k])
                dz = _between(low_z, high_z, pz[k], pz[k])
                far[c] = dx * dx + dy * dy + dz * dz
            for c in range(n):  # all are written, those that are too far over one another
                near[n_near] = c
                n_near += far[c] < most
            for c in range(n_near):
                # let each of the group take point k for its nearest if it is
                k = starts[node] + near[c]
                at_x, at_y, at_z = px[k], py[k], pz[k]
                for q in range(GROUP):
                    dx, dy, dz = at_x - x[q], at_y - y[q], at_z - z[q]
                    away = dx * dx + dy * dy + dz * dz
                    nearer = away < square[q]
                    square[q] = away if nearer else square[q]
                    found[q] = k if nearer else found[q]
            most = _largest(square)
        while n_todo > 0 and aways[n_todo - 1] >= most:
            n_todo -= 1
        if n_todo == 0:
            return
        n_todo -= 1
        node = nodes[n_todo]


_WIDER = 1 + 1e-6  # than the radius asked for, so that rounding leaves out no point on its edge
_LANDMARKS_PER_CELL = 2.0  # on average; few enough to look at all, enough to skip empty space


class Grid(NamedTuple):
    """N points sorted into square cells of the plane, for the kernels.

    Attributes:
        p: (N, 2 or 3) the points, cell by cell.
        row: (N,) where each was in the array given.
        start: (nx ny + 1,) first point of each cell.
        corner_m: (2,) lower corner of the first cell.
        cell_m: side of a cell.
        shape: (2,) cells along x and y.
    """

    p: Float
    row: np.ndarray
    start: np.ndarray
    corner_m: Float
    cell_m: float
    shape: np.ndarray

    @classmethod
    def of(cls, p: Float) -> "Grid":
        """Grid over points (N, 2 or 3)."""
        n, (x, y) = len(p), np.ascontiguousarray(p[:, :2].T)
        corner_m, extent_m, cell_m = np.zeros(2), np.zeros(2), 1.0
        if n:
            corner_m = np.array([x.min(), y.min()])
            extent_m = np.array([x.max(), y.max()]) - corner_m
        if extent_m.any():
            # a line or a point has no area; cells as long as its share of the longer side do
            area = extent_m[0] * extent_m[1]
            cell_m = max(math.sqrt(area * _LANDMARKS_PER_CELL / n), float(extent_m.max()) / n)
        shape = (extent_m / cell_m).astype(np.int64) + 1
        column = ((x - corner_m[0]) / cell_m).astype(np.int64)
        cell = ((y - corner_m[1]) / cell_m).astype(np.int64) * shape[0] + column
        # of short numbers NumPy sorts by digits
        row = np.argsort(cell.astype(np.min_scalar_type(shape[0] * shape[1])), kind="stable")
        start = np.zeros(shape[0] * shape[1] + 1, np.int64)
        np.cumsum(np.bincount(cell, minlength=len(start) - 1), out=start[1:])
        return cls(p[row], row, start, corner_m, cell_m, shape)


@kernel
def _cells(middle: float, radius: float, corner: float, cell: float, cells: int) -> tuple[int, int]:
    """First cell that an interval meets along one axis, and one behind the last."""
    wider = radius * _WIDER
    first = max(math.floor((middle - wider - corner) / cell), 0.0)
    last = min(math.floor((middle + wider - corner) / cell), cells - 1.0)
    return (int(first), int(last) + 1) if first <= last else (0, 0)


@kernel
def ranges_within(x: float, y: float, radius_m: float, grid: Grid, runs: np.ndarray) -> int:
    """Ranges of grid.p with all points within a radius of (x, y), and others.

    They go into `runs` (ny, 2), first and one behind the last of each; returns how many.
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
