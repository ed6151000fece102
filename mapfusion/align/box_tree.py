"""A map's landmarks in a tree of boxes, each about half of the points of the one above it.

Landmarks lie on walls. A box about a piece of wall is flat, so a point that is far from all of them
(as under a motion that is wrong) still finds its nearest in few boxes; a grid looks at all the
empty cells between.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float

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
        rows, boxes, ends = in_leaves(p, -(-len(p) // n_leaves_of(len(p), POINTS_PER_LEAF)))
        in_order = p[rows]
        x, y, z = np.ascontiguousarray(in_order.T)
        return cls(in_order, x, y, z, rows, boxes, ends[0], ends[1])


def n_leaves_of(n: int, size: int) -> int:
    """How many leaves n points take if each may hold so many: a power of two."""
    n_leaves = 1
    while n > n_leaves * size:
        n_leaves *= 2
    return n_leaves


def in_leaves(p: Float, size: int) -> tuple[np.ndarray, Float, np.ndarray]:
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
