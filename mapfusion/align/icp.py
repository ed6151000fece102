"""ICP from a random minimal set of correspondences (section 5)."""

import math
import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from mapfusion.align.closest import Grid, nearest_two
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.pairs import (
    Pairs,
    finish,
    gather,
    undetermined,
    why_one_place,
    why_too_few,
)
from mapfusion.align.result import Alignment
from mapfusion.align.rigid import fit_rigid, least_squares_gain
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

MAX_ROUNDS = 200  # of pairing and solving; maps of 1600 landmarks take 10 to 60


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
    max_rounds: int = MAX_ROUNDS

    def __post_init__(self) -> None:
        if not self.max_rounds > 0:
            raise ValueError("max_rounds: must be positive")

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b.

        Raises:
            ValueError: an index of the correspondences lies outside its map.
        """
        started_s = time.perf_counter()
        pairs = gather(map_a, map_b, correspondences)
        reason = why_no_start(map_a, map_b, pairs)
        if reason:
            return undetermined(reason, len(pairs), started_s)
        start = draw_motion(pairs, np.arange(len(pairs)), rng)
        closest = ClosestPoints(map_a, map_b)
        return closest.align(start, correspondences, self.max_rounds, started_s)


def why_no_start(map_a: LandmarkMap, map_b: LandmarkMap, pairs: Pairs) -> str:
    """Why no minimal set gives a motion to start from; empty when one does."""
    return why_too_few(map_a, map_b, len(pairs), needed=2) or why_one_place(pairs)


def draw_motion(pairs: Pairs, rows: np.ndarray, rng: np.random.Generator) -> Float:
    """T_a_b (3,) of two of the pairs `rows` drawn at random."""
    chosen = rng.choice(rows, size=2, replace=False)
    return np.array(fit_rigid(pairs.p_a, pairs.p_b, chosen))


class ClosestPoints:
    """Pairs each landmark of map b with the nearest of map a (planar maps: in the plane)."""

    def __init__(self, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        upright = np.array([1.0, 1.0, 0.0 if map_a.planar or map_b.planar else 1.0])
        grid = Grid.of(map_a.position_m * upright)
        self._maps = map_a, map_b
        self._row = grid.row
        self._cells = (grid.p, grid.start, grid.corner_m, grid.cell_m, grid.shape)
        self._p_b = map_b.position_m * upright

    def cost_m2(self, T_a_b: Float) -> float:
        """Summed squared distance of map b's landmarks under T_a_b to their nearest in map a."""
        return summed_square_distance(T_a_b, self._p_b, *self._cells)

    def align(
        self, T_a_b: Float, correspondences: Correspondences, max_rounds: int, started_s: float
    ) -> Alignment:
        """Pair and solve from T_a_b on until the pairing repeats."""
        T_a_b, nearest, repeats = iterate(T_a_b, max_rounds, self._p_b, *self._cells)
        refusal = "" if repeats else f"pairs still changed after {max_rounds} rounds"
        index_a, index_b = self._row[nearest], np.arange(len(nearest))
        inlier = index_a[correspondences.index_b] == correspondences.index_a
        paired = gather(*self._maps, Correspondences(index_a, index_b, np.zeros(len(nearest))))
        gain = least_squares_gain(T_a_b, paired.p_b)
        return finish(paired, gain, T_a_b, inlier, started_s, refusal)


@njit(cache=True)
def summed_square_distance(
    T_a_b: Float,
    p_b: Float,
    p: Float,
    start: np.ndarray,
    corner_m: Float,
    cell_m: float,
    shape: np.ndarray,
) -> float:
    """Sum over p_b (N, 3) of the squared distance under T_a_b to the nearest point of a Grid."""
    cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    total = 0.0
    for i in range(len(p_b)):
        x = T_a_b[0] + cos * p_b[i, 0] - sin * p_b[i, 1]
        y = T_a_b[1] + sin * p_b[i, 0] + cos * p_b[i, 1]
        _, distance, _ = nearest_two(x, y, p_b[i, 2], p, start, corner_m, cell_m, shape)
        total += distance * distance
    return total


@njit(cache=True)
def iterate(
    T_start: Float,
    max_rounds: int,
    p_b: Float,
    p: Float,
    start: np.ndarray,
    corner_m: Float,
    cell_m: float,
    shape: np.ndarray,
) -> tuple[Float, np.ndarray, bool]:
    """Pair p_b (N, 3) with the nearest points of a Grid and solve, until no pair changes.

    A landmark that moved less than its neighbours' distances differ keeps its neighbour (triangle
    inequality), and is not looked up again.

    Returns:
        T_a_b (3,), index into the grid's points of each one's nearest (N,), whether it repeats.
    """
    n = len(p_b)
    T_a_b = T_start.copy()
    nearest = np.full(n, -1)
    clear = np.zeros(n)  # no other point of the grid is nearer than this
    moved, matched = np.zeros((n, 3)), np.empty((n, 3))
    everyone = np.arange(n)
    for rounds in range(max_rounds + 1):
        cos, sin = math.cos(T_a_b[2]), math.sin(T_a_b[2])
        changed = False
        for i in range(n):
            x = T_a_b[0] + cos * p_b[i, 0] - sin * p_b[i, 1]
            y = T_a_b[1] + sin * p_b[i, 0] + cos * p_b[i, 1]
            z = p_b[i, 2]
            clear[i] -= math.hypot(x - moved[i, 0], y - moved[i, 1])
            moved[i, 0], moved[i, 1] = x, y
            k = nearest[i]
            if k >= 0:
                dx, dy, dz = x - p[k, 0], y - p[k, 1], z - p[k, 2]
                if clear[i] > 0 and dx * dx + dy * dy + dz * dz < clear[i] * clear[i]:
                    continue
            found, _, clear[i] = nearest_two(x, y, z, p, start, corner_m, cell_m, shape)
            if found != k:
                changed = True
                nearest[i] = found
                matched[i] = p[found]
        if not changed:
            return T_a_b, nearest, True
        if rounds < max_rounds:
            T_a_b[0], T_a_b[1], T_a_b[2] = fit_rigid(matched, p_b, everyone)
    return T_a_b, nearest, False
