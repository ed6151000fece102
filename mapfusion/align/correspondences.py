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

FEW = 3  # correspondences: fewer can contradict no motion, and `match` tells why they are few
_NORM_FACTOR = 2.0  # by which a descriptor's norm may differ from 1, that of a unit vector
# Of `scale_note`. Lengths of two maps differ by a few percent (calibration, drift); a window that
# wide holds some 5 % of the ratios of false pairs, whose logarithms spread by 0.7, so that a
# quarter of the ratios in it are no chance.
_RATIO_WIDTH = 0.05
_RATIO_SHARE = 0.25
_FEWEST_RATIOS = 20
_SHIFTS = 8  # others that each pair is compared with
_SAME_SCALE = 1.2  # less may be calibration or drift
_OTHER_WORLD = 100.0  # ratio of extents that a room and a street do not have
_UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281}


@dataclass(frozen=True)
class Correspondences:
    """N pairs, one to one.

    Attributes:
        index_a: (N,) rows of map a.
        index_b: (N,) rows of map b.
        distance: (N,) Euclidean distance of the descriptors; 0 for pairs made by label.
        shortage: why `match` found fewer than three; empty if it found more, and of pairs that it
            did not make.
    """

    index_a: np.ndarray
    index_b: np.ndarray
    distance: Float
    shortage: str = ""

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
    empty = not len(map_a) or not len(map_b)
    if map_a.label is not None and map_b.label is not None and not empty:
        return _match_labels(map_a, map_b)
    if map_a.descriptor is None or map_b.descriptor is None or empty:
        none = np.zeros(0, np.int64)
        return Correspondences(none, none, np.zeros(0), _nothing_to_match_by(map_a, map_b))
    return _match_descriptors(map_a, map_b, parameters)


def _nothing_to_match_by(map_a: LandmarkMap, map_b: LandmarkMap) -> str:
    for landmarks in (map_a, map_b):
        if not len(landmarks):
            return f"map {landmarks.name} is empty"
        if landmarks.descriptor is None and landmarks.label is None:
            return f"map {landmarks.name} has neither descriptors nor labels to match by"
    described, labelled = (
        next(m.name for m in (map_a, map_b) if getattr(m, what) is None)
        for what in ("label", "descriptor")
    )
    return (
        f"map {described} has descriptors, map {labelled} only labels; give both maps descriptors, "
        "or both labels"
    )


def _match_labels(map_a: LandmarkMap, map_b: LandmarkMap) -> Correspondences:
    labels_a, rows_a = _row_of_label(map_a)
    labels_b, rows_b = _row_of_label(map_b)
    common, at_a, at_b = np.intersect1d(labels_a, labels_b, return_indices=True)
    shortage = ""
    if len(common) < FEW:
        both = "are labels of both maps" if len(common) != 1 else "is a label of both maps"
        a, b = (
            f"{len(labels)} from {labels[0]} to {labels[-1]}" if len(labels) else "none"
            for labels in (labels_a, labels_b)
        )
        shortage = (
            f"{len(common) or 'none'} {both} (map {map_a.name}: {a}; map {map_b.name}: {b}); where "
            "both maps have labels, landmarks are matched by them alone"
        )
    return Correspondences(rows_a[at_a], rows_b[at_b], np.zeros(len(common)), shortage)


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
    rows, nearest_b, distance = _mutually_nearest(
        map_a, map_b, height_bound, parameters.height.floor_m**2
    )
    kept = distance <= parameters.max_descriptor_distance
    shortage = why_few(map_a, map_b, parameters) if np.count_nonzero(kept) < FEW else ""
    return Correspondences(rows[kept], nearest_b[kept], distance[kept], shortage)


def _mutually_nearest(
    map_a: LandmarkMap, map_b: LandmarkMap, height_bound: float, floor_m2: float
) -> tuple[np.ndarray, np.ndarray, Float]:
    """Return rows (N,) of both maps, each the other's nearest, and their descriptors' distances."""
    nearest_b, distance2, nearest_a = nearest_both_ways(map_a, map_b, height_bound, floor_m2)
    rows = np.flatnonzero(nearest_a[nearest_b] == np.arange(len(map_a)))
    return rows, nearest_b[rows], np.sqrt(np.maximum(distance2[rows], 0.0))


def why_few(map_a: LandmarkMap, map_b: LandmarkMap, parameters: MatchParameters) -> str:
    """Return which test of `match` left few of the pairs that descriptors offer.

    Both maps have descriptors, and landmarks. Counts and medians are of the pairs that are mutually
    nearest among all landmarks, whatever their heights: of these, `match` keeps all whose heights
    agree.
    """
    rows, nearest, distance = _mutually_nearest(map_a, map_b, math.inf, 0.0)
    known_a, known_b = (_has_descriptor(each) for each in (map_a, map_b))
    described = known_a[rows] & known_b[nearest]
    rows, nearest, distance = rows[described], nearest[described], distance[described]
    said = f"{len(rows)} mutually nearest descriptors"
    if len(rows) < FEW:
        a, b = np.count_nonzero(known_a), np.count_nonzero(known_b)
        return f"{said} (map {map_a.name} has {a} descriptors, map {map_b.name} {b})"
    alike = distance <= parameters.max_descriptor_distance
    n_alike = np.count_nonzero(alike)
    if n_alike < FEW:
        said += (
            f", {n_alike} at most {parameters.max_descriptor_distance:g} apart "
            f"(median {_short(np.median(distance))})"
        )
        for landmarks, some in ((map_a, rows), (map_b, nearest)):
            assert landmarks.descriptor is not None
            norm = float(np.median(np.linalg.norm(landmarks.descriptor[some], axis=1)))
            if not 1 / _NORM_FACTOR < norm < _NORM_FACTOR:
                told = f"have the norm {_short(norm)} (median); divide each by its norm"
                return f"{said}: descriptors of map {landmarks.name} {told}"
        return f"{said}: the maps show other things, or their descriptors are of different kinds"
    if n_alike < len(rows):
        said += f", {n_alike} at most {parameters.max_descriptor_distance:g} apart"
    rows, nearest = rows[alike], nearest[alike]
    up_m = map_b.position_m[nearest, 2] - map_a.position_m[rows, 2]
    variances = map_a.covariance_m2[rows, 2, 2], map_b.covariance_m2[nearest, 2, 2]
    agree = parameters.height.agrees(up_m, variances[0], np.zeros(1), variances[1])
    reach = np.sqrt(parameters.height.bound * (sum(variances) + parameters.height.floor_m**2))
    higher = map_b if np.median(up_m) > 0 else map_a
    said += (
        f", {np.count_nonzero(agree)} within {np.median(reach):.2g} m of height "
        f"(median difference {np.median(np.abs(up_m)):.2f} m, map {higher.name} higher)"
    )
    scale = scale_note(map_a, map_b, rows, nearest)
    return f"{said}; {scale}" if scale else said


def _has_descriptor(landmarks: LandmarkMap) -> np.ndarray:
    """Return which landmarks (N,) of a map with descriptors have one, as bool."""
    assert landmarks.descriptor is not None
    return np.logical_not(np.any(np.isnan(landmarks.descriptor), axis=1))


def scale_note(
    map_a: LandmarkMap, map_b: LandmarkMap, index_a: np.ndarray, index_b: np.ndarray
) -> str:
    """Return in words by what factor one map is larger than the other; empty if none is seen.

    True pairs have one ratio of the distances between their landmarks, false pairs any. So the
    factor is the ratio that many pairs of pairs share. Without such a ratio the extents are
    compared.
    """
    scale = _common_ratio(map_a.position_m[index_a, :2], map_b.position_m[index_b, :2])
    if math.isnan(scale):
        extents = [_extent_m(landmarks) for landmarks in (map_a, map_b)]
        if not min(extents) > 0 or max(extents) < _OTHER_WORLD * min(extents):
            return ""
        return (
            f"map {map_a.name} spans {_short(extents[0])} m, map {map_b.name} "
            f"{_short(extents[1])} m: are both in metres?"
        )
    if 1 / _SAME_SCALE < scale < _SAME_SCALE:
        return ""
    large, small = (map_b, map_a) if scale > 1 else (map_a, map_b)
    factor = max(scale, 1 / scale)
    units = (name for name, size in _UNITS.items() if abs(factor / size - 1) < _RATIO_WIDTH)
    asked = f"is it in {unit}?" if (unit := next(units, "")) else "are both in metres?"
    return (
        f"distances between landmarks of map {large.name} are {_short(factor)} times those of map "
        f"{small.name}: {asked}"
    )


def _short(value: float) -> str:
    """Return two digits after the point of small numbers, and none of large ones."""
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def _common_ratio(p_a: Float, p_b: Float) -> float:
    """Return the ratio |p_b - q_b| / |p_a - q_a| that many of N pairs (N, 2) share, NaN if none.

    Each pair is compared with a few others. Ratios of false pairs spread over a factor of two and
    more, so that few fall by chance into the densest interval.
    """
    n = len(p_a)
    shifts = range(1, min(_SHIFTS, n - 1) + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = [
            np.log(np.linalg.norm(np.roll(p_b, k, 0) - p_b, axis=1))
            - np.log(np.linalg.norm(np.roll(p_a, k, 0) - p_a, axis=1))
            for k in shifts
        ]
    logs = np.sort(np.concatenate(ratios)) if ratios else np.zeros(0)
    logs = logs[np.isfinite(logs)]
    if len(logs) < _FEWEST_RATIOS:
        return math.nan
    inside = np.searchsorted(logs, logs + 2 * _RATIO_WIDTH, side="right") - np.arange(len(logs))
    first, size = int(np.argmax(inside)), int(np.max(inside))
    if size < _RATIO_SHARE * len(logs):
        return math.nan
    return math.exp(float(np.median(logs[first : first + size])))


def _extent_m(landmarks: LandmarkMap) -> float:
    """Return twice the median distance of the landmarks to their median, in plan."""
    plan = landmarks.position_m[:, :2]
    return 2 * float(np.median(np.linalg.norm(plan - np.median(plan, axis=0), axis=1)))
