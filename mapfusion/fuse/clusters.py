"""Which landmarks of several maps are one point: pairs joined, each map at most once a point."""

from typing import NamedTuple

import numpy as np

from mapfusion.aligned_landmarks import ABSENT


class Pair(NamedTuple):
    """Landmarks of two maps that may be one point: n of them.

    Attributes:
        a: place of the one map.
        b: place of the other.
        row_a: (n,) landmarks of the one.
        row_b: (n,) landmarks of the other.
        unlike: (n,) how little they look alike.
    """

    a: int
    b: int
    row_a: np.ndarray
    row_b: np.ndarray
    unlike: np.ndarray


def joined(pairs: list[Pair], sizes: list[int]) -> np.ndarray:
    """Points (C, M): the row of each of M maps, ABSENT for none; those of one map come last.

    What is most alike is joined first, unless the point would then have two landmarks of one map.
    The order of maps and of pairs makes no difference but for the order of the points.

    Args:
        pairs: what may be one.
        sizes: landmarks of each map.
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    of_map = np.repeat(np.arange(len(sizes)), sizes)
    members = {int(i): {int(of_map[i]): int(i)} for i in range(first[-1])}
    root = np.arange(first[-1])
    nothing = [np.empty(0, np.int64)]
    one = np.concatenate([first[pair.a] + pair.row_a for pair in pairs] or nothing)
    other = np.concatenate([first[pair.b] + pair.row_b for pair in pairs] or nothing)
    unlike = np.concatenate([pair.unlike for pair in pairs] or nothing)
    for row in np.argsort(unlike, kind="stable"):
        i, j = int(root[one[row]]), int(root[other[row]])
        if i == j or members[i].keys() & members[j].keys():
            continue
        root[list(members[j].values())] = i
        members[i] |= members.pop(j)
    points = np.full((len(members), len(sizes)), ABSENT)
    for row, own in enumerate(members.values()):
        for k, i in own.items():
            points[row, k] = i - first[k]
    several = np.count_nonzero(points != ABSENT, axis=1) > 1
    return np.concatenate([points[several], points[~several]])
