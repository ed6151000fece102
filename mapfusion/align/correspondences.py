"""Pairs of landmarks, one of each map, that may be the same point of the world."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.align.nearest_descriptors import nearest_both_ways
from mapfusion.arguments import Probability, Range, require_finite, require_in_range, require_shape
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.looks import NO_LABEL
from mapfusion.se2 import Float
from mapfusion.stray import FILTERED_STRAY_M


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
        floor_m: standard deviation of what the difference of two heights has beside: the stray of
            both landmarks' tracks, which no number of sightings averages out. How a body stood when
            it saw them is in the landmarks' own variances, with what is not known of it.
    """

    probability: Probability = 0.999
    floor_m: Annotated[float, Range(0, 10, "m")] = math.sqrt(2) * FILTERED_STRAY_M

    def __post_init__(self) -> None:
        require_in_range(self)

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

    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.6
    height: HeightGate = HeightGate()

    def __post_init__(self) -> None:
        require_in_range(self)


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
    planar = map_a.planar or map_b.planar
    height_bound = math.inf if planar else parameters.height.bound
    nearest_b, distance2, nearest_a = nearest_both_ways(
        map_a, map_b, height_bound, parameters.height.floor_m**2
    )
    rows = np.arange(len(map_a))
    distance = np.sqrt(np.maximum(distance2, 0.0))
    kept = (nearest_a[nearest_b] == rows) & (distance <= parameters.max_descriptor_distance)
    return Correspondences(rows[kept], nearest_b[kept], distance[kept])
