"""ICP from a random minimal set of correspondences (section 5)."""

import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.pairs import (
    MIN_PAIRS,
    Pairs,
    finish,
    gather,
    lacks_extent,
    undetermined,
    why_too_few,
)
from mapfusion.align.result import Alignment
from mapfusion.align.rigid import fit_rigid
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float, transform_points

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
        return closest.iterate(start, pairs, correspondences, self.max_rounds, started_s)


def why_no_start(map_a: LandmarkMap, map_b: LandmarkMap, pairs: Pairs) -> str:
    """Why no minimal set gives a motion to start from; empty when one does."""
    reason = why_too_few(map_a, map_b, len(pairs), needed=2)
    if not reason and any(
        lacks_extent(p[:, :2], covariance[:, :2, :2], 1)
        for p, covariance in ((pairs.p_a, pairs.covariance_a), (pairs.p_b, pairs.covariance_b))
    ):
        reason = "in plan the landmarks lie on one point, as far as their noise can tell"
    return reason


def draw_motion(pairs: Pairs, rows: np.ndarray, rng: np.random.Generator) -> Float:
    """T_a_b (3,) of two of the pairs `rows` drawn at random."""
    chosen = rng.choice(rows, size=2, replace=False)
    return np.array(fit_rigid(pairs.p_a, pairs.p_b, chosen))


class ClosestPoints:
    """Pairs each landmark of map b with the nearest of map a (planar maps: in the plane)."""

    def __init__(self, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        self._dimensions = 2 if map_a.planar or map_b.planar else 3
        self._p_a = map_a.position_m
        self._p_b = map_b.position_m
        self._tree = KDTree(map_a.position_m[:, : self._dimensions])

    def pair(self, T_a_b: Float) -> tuple[np.ndarray, Float]:
        """Row of map a (N_b,) nearest to each landmark of map b, and its distance."""
        moved = transform_points(T_a_b, self._p_b)[:, : self._dimensions]
        distance, nearest = self._tree.query(moved)
        return np.asarray(nearest), np.asarray(distance)

    def iterate(
        self,
        T_a_b: Float,
        pairs: Pairs,
        correspondences: Correspondences,
        max_rounds: int,
        started_s: float,
    ) -> Alignment:
        """Pair and solve until the pairing repeats."""
        everyone = np.arange(len(self._p_b))
        nearest, _ = self.pair(T_a_b)
        refusal = f"still changed after {max_rounds} rounds"
        for _ in range(max_rounds):
            T_a_b = np.array(fit_rigid(self._p_a[nearest], self._p_b, everyone))
            before = nearest
            nearest, _ = self.pair(T_a_b)
            if np.array_equal(nearest, before):
                refusal = ""
                break
        inlier = nearest[correspondences.index_b] == correspondences.index_a
        if np.count_nonzero(inlier) < MIN_PAIRS and not refusal:
            refusal = f"confirms {np.count_nonzero(inlier)} of {len(inlier)} correspondences"
        return finish(pairs, T_a_b, inlier, started_s, refusal)
