"""Pairs of landmarks, one of each map, that may be the same point of the world."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from mapfusion.arguments import (
    require_above,
    require_at_least,
    require_between,
    require_finite,
    require_shape,
)
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import NO_LABEL
from mapfusion.se2 import Float

_BLOCK_ROWS = 1024  # rows of the descriptor distance matrix held at once: 20 MB at 5000 columns
# stands for the NaN of a landmark without a descriptor, far from all others
_ABSENT = 1e9


@dataclass(frozen=True)
class Correspondences:
    """N pairs, one to one.

    Attributes:
        index_a: (N,) rows of map a.
        index_b: (N,) rows of map b.
        distance: (N,) Euclidean distance of the descriptors; 0 for pairs made by label.
    """

    index_a: np.ndarray
    index_b: np.ndarray
    distance: Float

    def __post_init__(self) -> None:
        n = len(self.index_a)
        for name in ("index_a", "index_b"):
            values = getattr(self, name)
            require_shape(name, values, (n,))
            if not np.issubdtype(values.dtype, np.integer):
                raise ValueError(f"{name}: dtype is {values.dtype}, expected integers")
        require_shape("distance", self.distance, (n,))
        require_finite("distance", self.distance)

    def __len__(self) -> int:
        return len(self.index_a)

    def __getitem__(self, rows: np.ndarray | slice) -> "Correspondences":
        return Correspondences(self.index_a[rows], self.index_b[rows], self.distance[rows])


@dataclass(frozen=True)
class HeightGate:
    """Whether two landmarks can have the same height.

    The maps share the height axis: robots drive on one floor, and a landmark's height does not
    drift with the path. So the landmarks' own height variances decide, plus a floor for what these
    leave out.

    Attributes:
        probability: of keeping a pair that is one point (chi-square, 1 degree of freedom).
        floor_m: standard deviation of errors that repeat from sighting to sighting and so do not
            average out: half a pixel at 8 m (the farthest landmarks) is 0.007 m, and a body that
            pitches by a quarter of a degree lifts such a point by 0.035 m.
    """

    probability: float = 0.999
    floor_m: float = 0.035

    def __post_init__(self) -> None:
        require_between(0, 1, self, "probability")
        require_at_least(0, self, "floor_m")

    @property
    def bound(self) -> float:
        """Most for the squared difference of two heights over its variance."""
        return chi_square_bound(self.probability, 1)

    def agrees(
        self, z_a_m: Float, variance_a_m2: Float, z_b_m: Float, variance_b_m2: Float
    ) -> np.ndarray:
        """Bool array: heights that agree; arguments broadcast."""
        variance = variance_a_m2 + variance_b_m2 + self.floor_m**2
        return (z_a_m - z_b_m) ** 2 <= self.bound * variance


@dataclass(frozen=True)
class MatchParameters:
    """How landmarks are paired.

    Attributes:
        max_descriptor_distance: between unit vectors, so 0 is equal and sqrt(2) unrelated. The
            default offers almost every mutual nearest neighbour, as the paper does: sorting out
            the false ones is the aligner's part.
        height: which heights can be the same.
    """

    max_descriptor_distance: float = 0.6
    height: HeightGate = HeightGate()

    def __post_init__(self) -> None:
        require_above(0, self, "max_descriptor_distance")


def match(
    map_a: LandmarkMap, map_b: LandmarkMap, parameters: MatchParameters = MatchParameters()
) -> Correspondences:
    """Pair the landmarks of two maps: by label where both carry labels, else by descriptor.

    By descriptor a pair is kept when each is the other's nearest among the landmarks of compatible
    height (planar maps: among all), and near enough. Maps with neither give no pairs.
    """
    if map_a.label is not None and map_b.label is not None:
        return _match_labels(map_a, map_b)
    if map_a.descriptor is None or map_b.descriptor is None or not len(map_a) or not len(map_b):
        return Correspondences(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    return _match_descriptors(map_a, map_b, parameters)


def _match_labels(map_a: LandmarkMap, map_b: LandmarkMap) -> Correspondences:
    labels_a, rows_a = _row_of_label(map_a)
    labels_b, rows_b = _row_of_label(map_b)
    common, at_a, at_b = np.intersect1d(labels_a, labels_b, return_indices=True)
    return Correspondences(rows_a[at_a], rows_b[at_b], np.zeros(len(common)))


def _row_of_label(landmarks: LandmarkMap) -> tuple[np.ndarray, np.ndarray]:
    """Labels in use and for each the row that was observed most often (the first, on a tie)."""
    assert landmarks.label is not None
    rows = np.flatnonzero(landmarks.label != NO_LABEL)
    rows = rows[np.argsort(-landmarks.count[rows].astype(np.int64), kind="stable")]
    labels, first = np.unique(landmarks.label[rows], return_index=True)
    return labels, rows[first]


def _match_descriptors(
    map_a: LandmarkMap, map_b: LandmarkMap, parameters: MatchParameters
) -> Correspondences:
    nearest_b, distance2, nearest_a = _nearest_both_ways(map_a, map_b, parameters)
    rows = np.arange(len(map_a))
    distance = np.sqrt(np.maximum(distance2, 0.0))
    kept = (nearest_a[nearest_b] == rows) & (distance <= parameters.max_descriptor_distance)
    return Correspondences(rows[kept], nearest_b[kept], distance[kept])


def _nearest_both_ways(
    map_a: LandmarkMap, map_b: LandmarkMap, parameters: MatchParameters
) -> tuple[np.ndarray, Float, np.ndarray]:
    """Nearest b of each a, its squared distance (infinite: none fits), and nearest a of each b."""
    assert map_a.descriptor is not None
    assert map_b.descriptor is not None
    descriptor_a = np.nan_to_num(map_a.descriptor.astype(np.float32), nan=_ABSENT)
    descriptor_b = np.nan_to_num(map_b.descriptor.astype(np.float32), nan=-_ABSENT)
    square_a = np.einsum("ij,ij->i", descriptor_a, descriptor_a)
    square_b = np.einsum("ij,ij->i", descriptor_b, descriptor_b)
    planar = map_a.planar or map_b.planar
    height_bound = np.inf if planar else parameters.height.bound
    nearest_b, best_of_a = np.zeros(len(map_a), np.int64), np.full(len(map_a), np.inf)
    nearest_a, best_of_b = np.zeros(len(map_b), np.int64), np.full(len(map_b), np.inf)
    for start in range(0, len(map_a), _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        take_nearer(
            descriptor_a[rows] @ descriptor_b.T,
            start,
            square_a,
            square_b,
            map_a.position_m[:, 2],
            map_b.position_m[:, 2],
            map_a.covariance_m2[:, 2, 2],
            map_b.covariance_m2[:, 2, 2] + parameters.height.floor_m**2,
            height_bound,
            nearest_b,
            best_of_a,
            nearest_a,
            best_of_b,
        )
    return nearest_b, best_of_a, nearest_a


@njit(cache=True)
def take_nearer(
    product: np.ndarray,
    start: int,
    square_a: np.ndarray,
    square_b: np.ndarray,
    z_a: Float,
    z_b: Float,
    variance_a: Float,
    variance_b: Float,
    height_bound: float,
    nearest_b: np.ndarray,
    best_of_a: Float,
    nearest_a: np.ndarray,
    best_of_b: Float,
) -> None:
    """Update the nearest both ways, with squared distances, from scalar products of descriptors.

    Args:
        product: (n, N_b) of rows start to start + n of map a with all of map b.
        start: first of these rows.
        square_a: (N_a,) squared norms of the descriptors.
        square_b: (N_b,) squared norms of the descriptors.
        z_a: (N_a,) heights.
        z_b: (N_b,) heights.
        variance_a: (N_a,) of the heights.
        variance_b: (N_b,) of the heights.
        height_bound: most for the squared difference of heights over its variance.
        nearest_b: (N_a,) updated.
        best_of_a: (N_a,) updated.
        nearest_a: (N_b,) updated.
        best_of_b: (N_b,) updated.
    """
    for k in range(product.shape[0]):
        i = start + k
        for j in range(product.shape[1]):
            distance2 = square_a[i] + square_b[j] - 2 * product[k, j]
            if distance2 >= best_of_a[i] and distance2 >= best_of_b[j]:
                continue
            dz = z_a[i] - z_b[j]
            if dz * dz > height_bound * (variance_a[i] + variance_b[j]):
                continue
            if distance2 < best_of_a[i]:
                nearest_b[i], best_of_a[i] = j, distance2
            if distance2 < best_of_b[j]:
                nearest_a[j], best_of_b[j] = i, distance2
