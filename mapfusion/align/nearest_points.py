"""The nearest points of a tree, for groups of points that lie near each other.

A group goes down the tree together: a box that is farther from the box about the group than each
point from what it has found so far is nobody's, and so is a point of a leaf. Distances of a whole
group to a point of the tree, and of a leaf's points to the group's box, are a few instructions, as
the processor takes several numbers at once.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.align.box_tree import POINTS_PER_LEAF, BoxTree, in_leaves
from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.planar import moved_point
from mapfusion.se2 import Float

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
        row, _, _ = in_leaves(p, GROUP)
        row = np.append(row, np.full(-len(p) % GROUP, row[len(p) // GROUP * GROUP :][:1]))
        return cls(len(p), row, *np.ascontiguousarray(p[row].T))


class Room(NamedTuple):
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
def room_for_groups() -> Room:
    """One for any number of groups, one after the other."""
    x, y, z, nearest = np.empty(GROUP), np.empty(GROUP), np.empty(GROUP), np.empty(GROUP)
    node, away = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    near, far = np.empty(POINTS_PER_LEAF, np.int64), np.empty(POINTS_PER_LEAF)
    return Room(x, y, z, nearest, np.empty(GROUP), node, away, near, far)


@inner_kernel
def look_up_group(
    T_a_b: Float, first: int, groups: Groups, tree: BoxTree, nearest: np.ndarray, room: Room
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


@kernel_part
def _largest(values: Float) -> float:
    largest = values[0]
    for q in range(1, GROUP):
        largest = max(largest, values[q])
    return largest


@kernel_part
def _between(low: float, high: float, box_low: float, box_high: float) -> float:
    """How far two intervals are apart."""
    return max(box_low - high, low - box_high, 0.0)


@kernel_part
def _descend(tree: BoxTree, room: Room) -> None:
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
                k = starts[node] + near[c]
                _compare(k, px[k], py[k], pz[k], x, y, z, found, square)
            most = _largest(square)
        while n_todo > 0 and aways[n_todo - 1] >= most:
            n_todo -= 1
        if n_todo == 0:
            return
        n_todo -= 1
        node = nodes[n_todo]


@kernel_part
def _compare(
    k: int,
    px: float,
    py: float,
    pz: float,
    x: Float,
    y: Float,
    z: Float,
    found: Float,
    square: Float,
) -> None:
    """Let each of a group take point k for its nearest if it is."""
    for q in range(GROUP):
        dx, dy, dz = px - x[q], py - y[q], pz - z[q]
        away = dx * dx + dy * dy + dz * dz
        nearer = away < square[q]
        square[q] = away if nearer else square[q]
        found[q] = k if nearer else found[q]
