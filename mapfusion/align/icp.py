"""ICP from a random minimal set of correspondences; ImpICP from the best of a few (section 5)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from mapfusion.align.alignment import Fit, Needs, Pairs
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.nearest_neighbours import (
    GROUP,
    BoxTree,
    Groups,
    find_nearest_of_group,
    new_search_state,
)
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.parameters import Range, require_in_range

MAX_ROUNDS = 200  # rounds of pairing and fitting


@dataclass(frozen=True)
class Icp:
    """Iterative closest point.

    It starts from the motion of two random correspondences. Each round pairs every landmark of map
    b with its nearest in map a and fits a motion in closed form, until no pair changes. Descriptors
    only affect the start. A correspondence is an inlier if the last pairing contains it.

    Attributes:
        max_rounds: largest number of rounds; an estimate that has not converged is refused.
    """

    randomised: ClassVar[bool] = True
    needs: ClassVar[Needs] = Needs(dimensions=1)
    max_rounds: Annotated[int, Range(1, 100_000, "rounds")] = MAX_ROUNDS

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit:
        """Estimate T_a_b as the fit to the last pairing."""
        start = draw_motion(pairs, np.arange(len(pairs)), rng)
        return ClosestPoints.of(pairs).descend(start, self.max_rounds)


def draw_motion(pairs: Pairs, rows: np.ndarray, rng: np.random.Generator) -> Float:
    """Return T_a_b (3,) of two pairs drawn from `rows`."""
    chosen = rng.choice(rows, size=2, replace=False)
    return np.array(fit_rigid(pairs.p_a, pairs.p_b, chosen))


class ClosestPoints:
    """Pairing of each landmark of map b with the nearest in map a (planar maps: in the plane)."""

    def __init__(self, pairs: Pairs) -> None:
        upright = np.array([1.0, 1.0, 0.0 if pairs.planar else 1.0])
        self._pairs = pairs
        self._tree = BoxTree.of(pairs.map_a.position_m * upright)
        self._p_b = pairs.map_b.position_m * upright
        self._groups = Groups.of(self._p_b)

    @classmethod
    def of(cls, pairs: Pairs) -> "ClosestPoints":
        """Return the value kept with the pairs, made at the first call."""
        if cls not in pairs.cache:
            pairs.cache[cls] = cls(pairs)
        return pairs.cache[cls]

    def cost_m2(self, T_a_b: Float, most_m2: float = math.inf) -> float:
        """Return the sum of squared distances from map b's landmarks to their nearest in map a.

        The sum may be incomplete if it exceeds `most_m2`.
        """
        return summed_square_distance(T_a_b, self._groups, self._tree, most_m2)

    def nearest_of(self, starts: Sequence[Float]) -> Float:
        """Return the motion with the smallest cost, the first if several have it."""
        nearest, least_m2 = starts[0], math.inf
        for T_a_b in starts:
            cost_m2 = self.cost_m2(T_a_b, least_m2)
            if cost_m2 < least_m2:
                nearest, least_m2 = T_a_b, cost_m2
        return nearest

    def descend(self, T_a_b: Float, max_rounds: int) -> Fit:
        """Iterate from T_a_b until the pairing repeats.

        The fit is the least-squares motion of the last pairing.
        """
        T_a_b, nearest, repeats = pair_and_solve(
            T_a_b, max_rounds, self._p_b, self._groups, self._tree
        )
        pairs, index_a, index_b = self._pairs, self._tree.row[nearest], np.arange(len(nearest))
        every = Correspondences(index_a, index_b, np.zeros(len(nearest)))
        return Fit(
            T_a_b,
            index_a[pairs.index_b] == pairs.index_a,
            fitted=Pairs(pairs.map_a, pairs.map_b, every),
            refusal="" if repeats else f"pairs still changed after {max_rounds} rounds",
        )


@kernel
def summed_square_distance(T_a_b: Float, groups: Groups, tree: BoxTree, max_sum: float) -> float:
    """Return the sum over all points of the squared distance to the nearest point of the tree.

    The sum ends after the group with which it exceeds `max_sum`.
    """
    room, nobody = new_search_state(), np.full(len(groups.row), -1)
    total = 0.0
    for first in range(0, groups.n, GROUP):
        find_nearest_of_group(T_a_b, first, groups, tree, nobody, room)
        for q in range(min(GROUP, groups.n - first)):
            total += room.square[q]
        if total > max_sum:
            break
    return total


@kernel
def pair_and_solve(
    T_start: Float, max_rounds: int, p_b: Float, groups: Groups, tree: BoxTree
) -> tuple[Float, np.ndarray, bool]:
    """Pair points p_b (N, 3) with the nearest of a tree and fit a motion, until no pair changes.

    Returns:
        T_a_b (3,), the index of the nearest tree point of each point (N,), and True if the last
        round changed no pair.
    """
    p, n = tree.p, len(p_b)
    T_a_b, everyone, room = T_start.copy(), np.arange(n), new_search_state()
    row_of, nearest_index = groups.row, room.nearest
    nearest, in_group, matched = np.full(n, -1), np.full(len(row_of), -1), np.empty((n, 3))
    for rounds in range(max_rounds + 1):
        changed = False
        for first in range(0, len(in_group), GROUP):
            find_nearest_of_group(T_a_b, first, groups, tree, in_group, room)
            for q in range(GROUP):
                i, k = first + q, int(nearest_index[q])
                if k != in_group[i]:
                    changed, in_group[i], nearest[row_of[i]] = True, k, k
                    for axis in range(3):
                        matched[row_of[i], axis] = p[k, axis]
        if not changed:
            return T_a_b, nearest, True
        if rounds < max_rounds:
            T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(matched, p_b, everyone)
    return T_a_b, nearest, False


@dataclass(frozen=True)
class ImpIcp:
    """ICP from the best of a few starts.

    The paper describes ImpICP only as an ad hoc modification of ICP that makes a good estimate more
    probable. This implementation draws a few minimal sets among the correspondences with the
    smallest descriptor distances, and starts from the motion with the smallest RMS distance of map
    b's landmarks to their nearest in map a, the cost of ICP.

    Attributes:
        sets: number of minimal sets.
        best_share: share of the correspondences, by descriptor distance, that sets are drawn from.
        max_rounds: largest number of rounds; an estimate that has not converged is refused.
    """

    randomised: ClassVar[bool] = True
    needs: ClassVar[Needs] = Needs(dimensions=1)
    sets: Annotated[int, Range(1, 100_000, "sets")] = 3
    best_share: Annotated[float, Range(1e-3, 1, "1")] = 0.25
    max_rounds: Annotated[int, Range(1, 100_000, "rounds")] = MAX_ROUNDS

    def __post_init__(self) -> None:
        require_in_range(self)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit:
        """Estimate T_a_b as the fit to the last pairing."""
        # pairs at the limiting distance are all included (labels have equal distances)
        last = np.sort(pairs.distance)[max(int(self.best_share * len(pairs)), 2) - 1]
        best = np.flatnonzero(pairs.distance <= last)
        closest = ClosestPoints.of(pairs)
        starts = [draw_motion(pairs, best, rng) for _ in range(self.sets)]
        return closest.descend(closest.nearest_of(starts), self.max_rounds)
