"""ICP from a random minimal set of correspondences (section 5)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.box_tree import BoxTree
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.method import Fit, Needs
from mapfusion.align.nearest_points import GROUP, Groups, look_up_group, room_for_groups
from mapfusion.align.pairs import Pairs
from mapfusion.align.rigid import fit_rigid
from mapfusion.arguments import Range, require_in_range
from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float

MAX_ROUNDS = 200  # of pairing and solving
_CHANGES, _REPEATS = -2, -1  # how a descent ended, where it met no other one
_NO_ROUNDS = np.empty(0, np.int64)


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
        return ClosestPoints.of(pairs).descend(start, self.max_rounds)


def draw_motion(pairs: Pairs, rows: np.ndarray, rng: np.random.Generator) -> Float:
    """T_a_b (3,) of two of the pairs `rows` drawn at random."""
    chosen = rng.choice(rows, size=2, replace=False)
    return np.array(fit_rigid(pairs.p_a, pairs.p_b, chosen))


class ClosestPoints:
    """Pairs each landmark of map b with the nearest of map a (planar maps: in the plane).

    Descents that come to the same motion go on as one: what was met on the way is kept, and a
    descent that meets it again ends where that one did.
    """

    def __init__(self, pairs: Pairs) -> None:
        upright = np.array([1.0, 1.0, 0.0 if pairs.planar else 1.0])
        self._pairs = pairs
        self._tree = BoxTree.of(pairs.map_a.position_m * upright)
        self._p_b = pairs.map_b.position_m * upright
        self._groups = Groups.of(self._p_b)
        self._ends: list[tuple[Float, np.ndarray]] = []  # T_a_b and what was nearest of each
        # T_a_b of each round that led to one of them, which one, and after how many more
        self._met, self._end, self._to_go = np.empty((0, 3)), _NO_ROUNDS, _NO_ROUNDS

    @classmethod
    def of(cls, pairs: Pairs) -> "ClosestPoints":
        """Those of the last call with these pairs, if there was one."""
        if cls not in pairs.kept:
            pairs.kept[cls] = cls(pairs)
        return pairs.kept[cls]

    def cost_m2(self, T_a_b: Float, most_m2: float = math.inf) -> float:
        """Summed squared distance of map b's landmarks under T_a_b to their nearest in map a.

        Beyond `most_m2` it is not summed up: what comes back is more than that.
        """
        return summed_square_distance(T_a_b, self._groups, self._tree, most_m2)

    def nearest_of(self, starts: Sequence[Float]) -> Float:
        """The first of the motions with the least cost."""
        nearest, least_m2 = starts[0], math.inf
        for T_a_b in starts:
            cost_m2 = self.cost_m2(T_a_b, least_m2)
            if cost_m2 < least_m2:
                nearest, least_m2 = T_a_b, cost_m2
        return nearest

    def descend(self, T_a_b: Float, max_rounds: int) -> Fit:
        """Pair and solve from T_a_b on until the pairing repeats; fitted to the last pairing."""
        way, nearest, met = pair_and_solve(
            T_a_b, max_rounds, self._p_b, self._groups, self._tree, self._met, self._to_go
        )
        if met == _CHANGES:
            return self._fit(
                way[-1].copy(), nearest, f"pairs still changed after {max_rounds} rounds"
            )
        if met == _REPEATS:
            new, end, further = way, len(self._ends), 0
            self._ends.append((way[-1].copy(), nearest))
        else:
            new, end, further = way[:-1], self._end[met], self._to_go[met]
        to_go = further + len(way) - 1 - np.arange(len(new))
        self._met = np.concatenate([self._met, new])
        self._end = np.concatenate([self._end, np.full(len(new), end)])
        self._to_go = np.concatenate([self._to_go, to_go])
        return self._fit(*self._ends[end])

    def _fit(self, T_a_b: Float, nearest: np.ndarray, refusal: str = "") -> Fit:
        pairs, index_a, index_b = self._pairs, self._tree.row[nearest], np.arange(len(nearest))
        every = Correspondences(index_a, index_b, np.zeros(len(nearest)))
        return Fit(
            T_a_b,
            index_a[pairs.index_b] == pairs.index_a,
            fitted=Pairs(pairs.map_a, pairs.map_b, every),
            refusal=refusal,
        )


@kernel
def summed_square_distance(T_a_b: Float, groups: Groups, tree: BoxTree, most: float) -> float:
    """Sum over all points of the squared distance under T_a_b to the nearest point of the tree.

    It ends with the first group that makes it exceed `most`.
    """
    room, nobody = room_for_groups(), np.full(len(groups.row), -1)
    total = 0.0
    for first in range(0, groups.n, GROUP):
        look_up_group(T_a_b, first, groups, tree, nobody, room)
        for q in range(min(GROUP, groups.n - first)):
            total += room.square[q]
        if total > most:
            break
    return total


@kernel
def pair_and_solve(
    T_start: Float,
    max_rounds: int,
    p_b: Float,
    groups: Groups,
    tree: BoxTree,
    met: Float,
    to_go: np.ndarray,
) -> tuple[Float, np.ndarray, int]:
    """Pair p_b (N, 3), in groups, with the nearest of a tree and solve, until no pair changes.

    All that follows, follows from the motion: at one of `met` (M, 3), from which `to_go` (M,) more
    rounds lead to an end, there is nothing left to do.

    Returns:
        T_a_b of each round (R, 3), index into the tree's points of each one's nearest (N,), and the
        row of `met` that it came to; if to none, whether it repeats.
    """
    p, n = tree.p, len(p_b)
    T_a_b, everyone, room = T_start.copy(), np.arange(n), room_for_groups()
    row_of, found = groups.row, room.nearest
    nearest, in_group, matched = np.full(n, -1), np.full(len(row_of), -1), np.empty((n, 3))
    way = np.empty((max_rounds + 1, 3))
    for rounds in range(max_rounds + 1):
        way[rounds, 0], way[rounds, 1], way[rounds, 2] = T_a_b[0], T_a_b[1], T_a_b[2]
        row = _row_of(T_a_b, met)
        # one round more than that if it came there by other pairs
        if row >= 0 and rounds + to_go[row] < max_rounds:
            return way[: rounds + 1], nearest, row
        changed = False
        for first in range(0, len(in_group), GROUP):
            look_up_group(T_a_b, first, groups, tree, in_group, room)
            for q in range(GROUP):
                i, k = first + q, int(found[q])
                if k != in_group[i]:
                    changed, in_group[i], nearest[row_of[i]] = True, k, k
                    for axis in range(3):
                        matched[row_of[i], axis] = p[k, axis]
        if not changed:
            return way[: rounds + 1], nearest, _REPEATS
        if rounds < max_rounds:
            T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(matched, p_b, everyone)
    return way, nearest, _CHANGES


@kernel_part
def _row_of(T_a_b: Float, met: Float) -> int:
    """Where a motion (3,) is among (M, 3), to the last bit; -1: nowhere."""
    for row in range(len(met)):
        if met[row, 2] == T_a_b[2] and met[row, 0] == T_a_b[0] and met[row, 1] == T_a_b[1]:
            return row
    return -1
