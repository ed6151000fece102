"""Pairs of maps made up for measuring aligners: any number of pairs, any share of false ones."""

import math
from dataclasses import dataclass

import numpy as np

from mapfusion import se2
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.rigid import fit_rigid
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

# Fixed, so that the tables of different versions can be compared.
SIZE_M = 20.0  # side of the square that holds the landmarks
SIGMA_M = 0.05  # of a true pair's residual, per axis
_OBSERVATIONS = 5  # that each landmark claims to be made of; no aligner asks


@dataclass(frozen=True)
class SyntheticPair:
    """Two planar maps of N landmarks each and N correspondences between them, in no order.

    Attributes:
        T_a_b: (3,) the truth.
        is_true: (N,) bool, which correspondences are one point of the world.
    """

    map_a: LandmarkMap
    map_b: LandmarkMap
    correspondences: Correspondences
    T_a_b: Float
    is_true: np.ndarray

    def least_squares(self) -> Float:
        """T_a_b (3,) that fits the true pairs best: all noise is equal, so weights are, too."""
        c = self.correspondences
        p_a, p_b = self.map_a.position_m[c.index_a], self.map_b.position_m[c.index_b]
        return np.array(fit_rigid(p_a, p_b, np.flatnonzero(self.is_true)))


def true_pairs_of(n_pairs: int, outlier_share: float) -> int:
    """Number of true ones among n pairs."""
    return round((1 - outlier_share) * n_pairs)


def synthetic_pair(n_pairs: int, outlier_share: float, rng: np.random.Generator) -> SyntheticPair:
    """Draw a world, two maps of it, the motion between them and the correspondences.

    Landmarks are uniform in a square about the origin of frame b, so the translation's error is the
    displacement of the world's middle. Both landmarks of a false pair are uniform, independently.
    The residual's variance is shared equally between the maps, whose covariances say so.
    """
    half_m = SIZE_M / 2
    T_a_b = np.array([*rng.uniform(-half_m, half_m, 2), rng.uniform(-math.pi, math.pi)])
    p_b = rng.uniform(-half_m, half_m, (n_pairs, 2))
    p_a = p_b.copy()
    is_true = np.arange(n_pairs) < true_pairs_of(n_pairs, outlier_share)
    p_a[~is_true] = rng.uniform(-half_m, half_m, (np.count_nonzero(~is_true), 2))
    own_m = SIGMA_M / math.sqrt(2)
    p_a = se2.transform_points(T_a_b, p_a) + rng.normal(0, own_m, p_a.shape)
    p_b = p_b + rng.normal(0, own_m, p_b.shape)
    index_a, index_b, order = (rng.permutation(n_pairs) for _ in range(3))
    distance = rng.uniform(0, 0.3, n_pairs)  # as what matching lets through: they tell nothing
    map_a, map_b = _map(p_a, index_a, own_m, "a"), _map(p_b, index_b, own_m, "b")
    pairs = Correspondences(index_a[order], index_b[order], distance)
    return SyntheticPair(map_a, map_b, pairs, T_a_b, is_true[order])


def _map(points_m: Float, rows: np.ndarray, sigma_m: float, name: str) -> LandmarkMap:
    """The map whose landmark `rows[i]` is point i (N, 2)."""
    n = len(points_m)
    position = np.zeros((n, 3))
    position[rows, :2] = points_m
    return LandmarkMap(
        position,
        np.tile(np.diag([sigma_m**2, sigma_m**2, 0.0]), (n, 1, 1)),
        np.full(n, _OBSERVATIONS, np.int32),
        np.arange(n, dtype=np.int64),
        planar=True,
        name=name,
    )
