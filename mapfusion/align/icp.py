"""ICP from a random minimal set of correspondences (section 5)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numba import njit

from mapfusion.align.box_tree import BoxTree, look_up, put_in_order, room_for_search
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.method import Fit, Needs
from mapfusion.align.pairs import Pairs
from mapfusion.align.rigid import fit_rigid
from mapfusion.arguments import Range, require_in_range
from mapfusion.landmark_map import LandmarkMap
from mapfusion.planar import moved_point
from mapfusion.se2 import Float

MAX_ROUNDS = 200  # of pairing and solving
# Points near a landmark that are kept: with fewer it has to be looked up more often, more take
# longer to find and to put in order than they save.
_KEPT = 4


@dataclass(frozen=True)
class Icp:
    """Iterative closest point.

    Starts from the motion of two correspondences drawn at random, then pairs every landmark of
    map b with its nearest in map a and solves in closed form, until no pair changes. Descriptors
    only decide the start. A correspondence is an inlier when the last pairing holds it too.

    Attributes:
        max_rounds: an estimate that still changes then is refused.
    """

    randomised: ClassVar[bool] = True
    needs: ClassVar[Needs] = Needs(dimensions=1)
    max_rounds: Annotated[int, Range(1, 100_000, "rounds")] = MAX_ROUNDS

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit:
        """T_a_b of the last pairing."""
        start = draw_motion(pairs, np.arange(len(pairs)), rng)
        return ClosestPoints(pairs.map_a, pairs.map_b).descend(start, pairs, self.max_rounds)


def draw_motion(pairs: Pairs, rows: np.ndarray, rng: np.random.Generator) -> Float:
    """T_a_b (3,) of two of the pairs `rows` drawn at random."""
    chosen = rng.choice(rows, size=2, replace=False)
    return np.array(fit_rigid(pairs.p_a, pairs.p_b, chosen))


class ClosestPoints:
    """Pairs each landmark of map b with the nearest of map a (planar maps: in the plane)."""

    def __init__(self, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        upright = np.array([1.0, 1.0, 0.0 if map_a.planar or map_b.planar else 1.0])
        self._tree = BoxTree.of(map_a.position_m * upright)
        self._maps = map_a, map_b
        self._p_b = map_b.position_m * upright

    def cost_m2(self, T_a_b: Float, most_m2: float = math.inf) -> float:
        """Summed squared distance of map b's landmarks under T_a_b to their nearest in map a.

        Beyond `most_m2` it is not summed up: what comes back is more than that.
        """
        return summed_square_distance(T_a_b, self._p_b, self._tree, most_m2)

    def nearest_of(self, starts: Sequence[Float]) -> Float:
        """The first of the motions with the least cost."""
        nearest, least_m2 = starts[0], math.inf
        for T_a_b in starts:
            cost_m2 = self.cost_m2(T_a_b, least_m2)
            if cost_m2 < least_m2:
                nearest, least_m2 = T_a_b, cost_m2
        return nearest

    def descend(self, T_a_b: Float, pairs: Pairs, max_rounds: int) -> Fit:
        """Pair and solve from T_a_b on until the pairing repeats; fitted to the last pairing."""
        T_a_b, nearest, repeats = pair_and_solve(T_a_b, max_rounds, self._p_b, self._tree)
        index_a, index_b = self._tree.row[nearest], np.arange(len(nearest))
        return Fit(
            T_a_b,
            index_a[pairs.index_b] == pairs.index_a,
            fitted=Pairs(*self._maps, Correspondences(index_a, index_b, np.zeros(len(nearest)))),
            refusal="" if repeats else f"pairs still changed after {max_rounds} rounds",
        )


@njit(cache=True)
def summed_square_distance(T_a_b: Float, p_b: Float, tree: BoxTree, most: float) -> float:
    """Sum over p_b (N, 3) of the squared distance under T_a_b to the nearest point of the tree.

    It ends with the first that makes it exceed `most`.
    """
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    near, square, todo = np.full(1, -1), np.empty(1), room_for_search()
    total = 0.0
    for i in range(len(p_b)):
        x, y = moved_point(T_a_b, cos, sin, p_b[i, 0], p_b[i, 1])
        put_in_order(x, y, p_b[i, 2], tree.p, near, square)  # that of the one before
        look_up(x, y, p_b[i, 2], tree, near, square, todo)
        total += square[0]
        if total > most:
            break
    return total


@njit(cache=True)
def pair_and_solve(
    T_start: Float, max_rounds: int, p_b: Float, tree: BoxTree
) -> tuple[Float, np.ndarray, bool]:
    """Pair p_b (N, 3) with the nearest points of a tree and solve, until no pair changes.

    Of each landmark a few that were near where it was looked up are kept. No other point is nearer
    than the last of them was, less how far it has moved since (triangle inequality): while one of
    them is, it is not looked up again.

    Returns:
        T_a_b (3,), index into the tree's points of each one's nearest (N,), whether it repeats.
    """
    p, n = tree.p, len(p_b)
    T_a_b, everyone, todo = T_start.copy(), np.arange(n), room_for_search()
    nearest, matched = np.full(n, -1), np.empty((n, 3))
    near, square = np.full((n, _KEPT), -1), np.empty(_KEPT)
    looked_up, clear = np.zeros((n, 2)), np.zeros(n)  # where, and how far the last one kept was
    for rounds in range(max_rounds + 1):
        cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
        changed = False
        for i in range(n):
            x, y = moved_point(T_a_b, cos, sin, p_b[i, 0], p_b[i, 1])
            z = p_b[i, 2]
            dx, dy = x - looked_up[i, 0], y - looked_up[i, 1]
            still = clear[i] - math.sqrt(dx * dx + dy * dy)
            k = -1
            if still > 0:
                least = still * still
                for j in range(_KEPT):
                    other = near[i, j]
                    dx, dy, dz = p[other, 0] - x, p[other, 1] - y, p[other, 2] - z
                    away = dx * dx + dy * dy + dz * dz
                    if away < least:
                        k, least = other, away
            if k < 0:
                own = near[i]
                put_in_order(x, y, z, p, own, square)
                look_up(x, y, z, tree, own, square, todo)
                looked_up[i, 0], looked_up[i, 1] = x, y
                clear[i] = math.sqrt(square[_KEPT - 1])
                k = own[0]
            if k != nearest[i]:
                changed, nearest[i] = True, k
                for axis in range(3):
                    matched[i, axis] = p[k, axis]
        if not changed:
            return T_a_b, nearest, True
        if rounds < max_rounds:
            T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(matched, p_b, everyone)
    return T_a_b, nearest, False
