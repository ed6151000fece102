"""Correspondences: pairs of landmarks of two maps that may be the same point of the world.

Descriptor distances are computed by matrix products of a block of landmarks of similar height in
one map with all landmarks of compatible height in the other map.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from mapfusion.align.frames import height_offset_m, in_local_frame, origin_of
from mapfusion.align.geometric_matching import (
    Site,
    attributes_of_pairs_agree,
    match_by_geometry,
)
from mapfusion.descriptors import USURF, relative_distance, require_one_kind
from mapfusion.geometry.numerics import (
    WORD,
    Float,
    chi_square_bound,
    kernel,
    packed,
    require_finite,
    require_shape,
    trailing_zeros,
)
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Probability, Range, require_in_range
from mapfusion.robot_log import FILTERED_STRAY_M
from mapfusion.tables import NO_LABEL

_BLOCK_ROWS = 256  # rows of the descriptor distance matrix in memory: 5 MB at 5000 columns
# Bound of the relative single-precision error of a squared distance or a height: a few roundings of
# 2^-24.
_ROUNDING = 2.0**-20
# s in (d + r)^2 <= (1 + s) d^2 + (1 + 1 / s) r^2, which bounds a distance d with rounding error r.
_SHARE = 1 / 16
# Ratio to the median variance of heights above which landmarks get blocks of their own, since the
# gate of a block is the widest of its rows.
_WIDE = 4.0
# replaces the NaN of a landmark without a descriptor, far from all descriptors
_ABSENT = 1e9


def nearest_descriptors(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    height_bound: float,
    floor_m2: float,
    elsewhere_m: float = 0.0,
) -> tuple[np.ndarray, Float, np.ndarray]:
    """Find the nearest descriptor in the other map for all landmarks of two maps.

    Args:
        map_a: map with descriptors.
        map_b: map with descriptors.
        height_bound: largest squared difference of two heights over its variance; infinite for
            planar maps.
        floor_m2: variance of a height difference beyond the landmarks' own variances.
        elsewhere_m: smallest distance in the plane of two landmarks, if both maps are the same.

    Returns:
        Nearest b of each a, its squared distance (infinite without a compatible landmark), and
        nearest a of each b. Distances are those of the descriptors' vectors.

    Raises:
        InputError: the descriptors are of different kinds.
    """
    require_one_kind([(each.called, each.descriptor_kind) for each in (map_a, map_b)])
    centre = None
    if not map_a.descriptor_kind == map_b.descriptor_kind == USURF:
        # distances of vectors far from the origin would lose digits: subtract their mean
        assert map_a.descriptor is not None
        descriptors_a = map_a.descriptor[~np.isnan(map_a.descriptor).any(axis=1)]
        mean = (
            descriptors_a.mean(axis=0, dtype=np.float64)
            if len(descriptors_a)
            else np.zeros(descriptors_a.shape[1])
        )
        centre = mean.astype(np.float32)
    a, b = _Side.of(map_a, _ABSENT, 0.0, centre), _Side.of(map_b, -_ABSENT, floor_m2, centre)
    for rows in a.blocks(height_bound):
        columns = b.of_heights(*a.interval(rows, height_bound), height_bound)
        product = a.descriptor[rows] @ b.descriptor[columns].T
        _take_nearer(product, rows, columns, a, b, height_bound, elsewhere_m)
    return a.nearest, a.distance2, b.nearest


class _Side(NamedTuple):
    """N landmarks of one map with the nearest of the other map so far, as arrays for kernels."""

    descriptor: np.ndarray  # (N, D)
    square: np.ndarray  # (N,) squared norms of the descriptors
    place_m: Float  # (N, 2) in the plane
    z_m: Float  # (N,)
    variance_m2: Float  # (N,) of the heights
    nearest: np.ndarray  # (N,) row of the other map
    distance2: Float  # (N,) squared distance to the nearest

    @classmethod
    def of(
        cls,
        landmarks: LandmarkMap,
        absent: float,
        floor_m2: float,
        centre: np.ndarray | None,
    ) -> "_Side":
        assert landmarks.descriptor is not None
        n = len(landmarks)
        descriptor = landmarks.descriptor.astype(np.float32)
        if centre is not None:
            descriptor = descriptor - centre
        descriptor = np.nan_to_num(descriptor, nan=absent)
        return cls(
            descriptor,
            np.einsum("ij,ij->i", descriptor, descriptor),
            landmarks.position_m[:, :2].copy(),
            landmarks.position_m[:, 2].copy(),
            landmarks.covariance_m2[:, 2, 2] + floor_m2,
            np.full(n, -1),
            np.full(n, np.inf),
        )

    def blocks(self, bound: float) -> list[np.ndarray]:
        """Return all rows in blocks of similar height; wide gates are in blocks of their own."""
        rows = np.arange(len(self.z_m))
        if np.isfinite(bound):
            is_uncertain = self.variance_m2 > _WIDE * np.median(self.variance_m2)
            rows = np.lexsort((self.z_m, is_uncertain))
        return [rows[k : k + _BLOCK_ROWS] for k in range(0, len(rows), _BLOCK_ROWS)]

    def interval(self, rows: np.ndarray, bound: float) -> tuple[float, float]:
        """Return the interval of the possible heights of some rows."""
        if not np.isfinite(bound):
            return -np.inf, np.inf
        reach = np.sqrt(bound * self.variance_m2[rows])
        return float(np.min(self.z_m[rows] - reach)), float(np.max(self.z_m[rows] + reach))

    def of_heights(self, low_m: float, high_m: float, bound: float) -> np.ndarray:
        """Return the rows whose heights can lie in an interval."""
        if not np.isfinite(bound):
            return np.arange(len(self.z_m))
        reach = np.sqrt(bound * self.variance_m2)
        return np.flatnonzero((self.z_m + reach >= low_m) & (self.z_m - reach <= high_m))


@kernel
def _coarse(
    side: _Side, rows: np.ndarray, height_bound: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return some landmarks (n,) in single precision, with bounds that include rounding.

    Returns:
        Squared norms of the descriptors, squared distances to the nearest so far, heights in m,
        and contributions to the largest squared difference of heights.
    """
    n = len(rows)
    square, best = np.empty(n, np.float32), np.empty(n, np.float32)
    z, max_dz = np.empty(n, np.float32), np.empty(n, np.float32)
    for k in range(n):
        i = rows[k]
        square[k] = (1 - _ROUNDING) * side.square[i]
        best[k] = side.distance2[i]
        z[k] = side.z_m[i]
        rounding_error = _ROUNDING * side.z_m[i]
        max_dz[k] = math.inf
        if height_bound < math.inf:
            max_dz[k] = (1 + _SHARE) * height_bound * side.variance_m2[i]
            max_dz[k] += (1 + 1 / _SHARE) * 2 * rounding_error * rounding_error
    return square, best, z, max_dz


@kernel
def _mark_nearer(
    product: np.ndarray,
    square: np.ndarray,
    best: np.ndarray,
    z: np.ndarray,
    max_dz: np.ndarray,
    query: tuple[Any, Any, Any, Any],
    is_nearer: np.ndarray,
) -> None:
    """Mark the columns that may be nearer than the nearest so far of the column or of the row.

    The loop has no branch and no other index, so that it is vectorised.
    """
    square0, best0, z0, most0 = query
    for k in range(len(is_nearer)):
        distance2 = square[k] + square0 - (product[k] + product[k])
        dz = z[k] - z0
        is_nearer[k] = (distance2 <= max(best[k], best0)) & (dz * dz <= max_dz[k] + most0)


@kernel
def _take_nearer(
    product: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    a: _Side,
    b: _Side,
    height_bound: float,
    elsewhere_m: float,
) -> None:
    """Update the nearest landmarks of both maps from scalar products of descriptors.

    `product` (n, m) is of some `rows` of map a with some `columns` of map b. Of equal distances the
    first row counts. All columns are compared in single precision, in ranges of doubling length,
    since few are nearer than the nearest of many; the others are compared in full precision.
    """
    m = len(columns)
    square_a, _, z_a, most_a = _coarse(a, rows, height_bound)
    square, best, z, max_dz = _coarse(b, columns, height_bound)
    eights = np.zeros((m + WORD - 1) // WORD * 8, np.uint64)
    is_nearer = eights.view(np.uint8)
    for k in range(len(rows)):
        i = rows[k]
        first, end = 0, WORD
        while first < m:
            end = min(end, m)
            query = square_a[k], np.float32(a.distance2[i]), z_a[k], most_a[k]
            part = slice(first, end)
            _mark_nearer(
                product[k, part],
                square[part],
                best[part],
                z[part],
                max_dz[part],
                query,
                is_nearer[part],
            )
            for w in range(first // WORD, (end + WORD - 1) // WORD):
                word = packed(eights, w)
                while word:
                    c = w * WORD + trailing_zeros(word)
                    word &= word - np.uint64(1)
                    j = columns[c]
                    dx, dy = a.place_m[i, 0] - b.place_m[j, 0], a.place_m[i, 1] - b.place_m[j, 1]
                    if dx * dx + dy * dy < elsewhere_m * elsewhere_m:
                        continue
                    dz = a.z_m[i] - b.z_m[j]
                    if dz * dz > height_bound * (a.variance_m2[i] + b.variance_m2[j]):
                        continue
                    distance2 = a.square[i] + b.square[j] - 2 * product[k, c]
                    _take(a, i, j, distance2)
                    _take(b, j, i, distance2)
                    best[c] = b.distance2[j]
            first, end = end, 2 * end


@kernel
def _take(side: _Side, i: int, j: int, distance2: float) -> None:
    """Replace the nearest of i by j if j is nearer, or equally near and earlier."""
    nearest_distance2 = side.distance2[i]
    if distance2 < nearest_distance2 or (distance2 == nearest_distance2 and j < side.nearest[i]):
        side.nearest[i], side.distance2[i] = j, distance2


FEW = 3  # correspondences; fewer cannot contradict a motion, and `match` explains the shortage
# Constants of `scale_note`. Lengths of two maps differ by a few percent (calibration, drift). An
# interval of this width contains about 5 % of the ratios of false pairs, whose logarithms have a
# spread of 0.7; a quarter of the ratios in it cannot be chance.
_RATIO_WIDTH = 0.05
_RATIO_SHARE = 0.25
_FEWEST_RATIOS = 20
_SHIFTS = 8  # number of other pairs that each pair is compared with
_SAME_SCALE = 1.2  # smaller factors may be calibration or drift
_OTHER_WORLD = 100.0  # ratio of extents that differs in units rather than in the world
_OTHER_SIZES = 10.0  # the same of median sizes of landmarks
UNITS_PER_M = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281}


@dataclass(frozen=True)
class Correspondences:
    """N correspondences, one to one.

    Attributes:
        index_a: rows of map a, shape (N,).
        index_b: rows of map b, shape (N,).
        distance: distances of the descriptors, shape (N,); 0 for pairs of labels. Two different
            landmarks have a median distance of 0.8.
        shortage: why `match` found fewer than three pairs; empty otherwise.
        size_tolerance: largest relative difference of two sizes, if landmarks were matched by
            geometry alone; None otherwise.
        height_offset_m: height of map b above map a, which was subtracted before the test of
            heights.
        at_any_height: pairs without the test of heights; None if these are the same.
        set_aside: landmarks that were not matched, in words; empty if all were.
    """

    index_a: np.ndarray
    index_b: np.ndarray
    distance: Float
    shortage: str = ""
    size_tolerance: float | None = None
    height_offset_m: float = 0.0
    at_any_height: "Correspondences | None" = None
    set_aside: str = ""

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
        columns = self.index_a[rows], self.index_b[rows], self.distance[rows]
        tolerance, offset_m = self.size_tolerance, self.height_offset_m
        return Correspondences(*columns, size_tolerance=tolerance, height_offset_m=offset_m)

    @property
    def by_geometry(self) -> bool:
        """True if landmarks were matched by geometry alone."""
        return self.size_tolerance is not None


@dataclass(frozen=True)
class HeightGate:
    """Test of compatible heights.

    The maps share the height axis: robots drive on one floor, and heights do not drift with the
    path. The test uses the landmarks' height variances and an additional variance.

    Attributes:
        probability: probability of keeping a true pair (chi-square, 1 degree of freedom).
        floor_m: additional standard deviation of a height difference: the constant offsets of both
            landmarks' tracks, which do not average out. The attitude of the robot is part of the
            landmarks' variances.
    """

    probability: Probability = 0.999
    floor_m: Annotated[float, Range(0, 10, "m")] = math.sqrt(2) * FILTERED_STRAY_M

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def bound(self) -> float:
        """Largest squared difference of two heights over its variance."""
        return chi_square_bound(self.probability, 1)

    def agrees(
        self, z_a_m: Float, variance_a_m2: Float, z_b_m: Float, variance_b_m2: Float
    ) -> np.ndarray:
        """Return True for compatible heights; arguments broadcast."""
        variance = variance_a_m2 + variance_b_m2 + self.floor_m**2
        return (z_a_m - z_b_m) ** 2 <= self.bound * variance


@dataclass(frozen=True)
class MatchParameters:
    """Parameters of the matching of landmarks.

    Attributes:
        max_descriptor_distance: largest distance of two descriptors of any kind: 0 is equal, 0.8
            the median of different landmarks. The default keeps almost every mutual nearest
            neighbour, as in the paper; the aligner rejects the false ones.
        height: test of compatible heights.
        size_tolerance: largest difference of two sizes, as a share of the larger one. Landmarks
            without a size match any size.
        tolerance_m: distance in the plane within which common landmarks agree, for maps that are
            matched by geometry alone; the stated covariances may enlarge it.
    """

    max_descriptor_distance: Annotated[float, Range(1e-3, 2, "1")] = 0.6
    height: HeightGate = HeightGate()
    size_tolerance: Annotated[float, Range(0, 1, "1")] = 0.25
    tolerance_m: Annotated[float, Range(1e-3, 100, "m")] = 0.1

    def __post_init__(self) -> None:
        require_in_range(self)


def match(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    parameters: MatchParameters = MatchParameters(),
    one_floor: bool = False,
) -> Correspondences:
    """Pair the landmarks of two maps by label, by descriptor, or by geometry alone.

    Maps that both have labels are matched by label, and maps that both have descriptors by
    descriptor. A pair of descriptors is kept if each is the other's nearest among the landmarks of
    compatible height (among all landmarks of planar maps), near enough, and if sizes and categories
    agree. If a map has neither, landmarks are matched by geometry: the pairs are those that the
    best motions between the maps lay on each other, so that several motions may share a landmark.

    A constant difference of the heights of both maps is subtracted before heights are compared,
    unless the maps are known to be of `one_floor`. Landmarks whose standard deviation exceeds the
    size of their map are not matched, because they have no known place.
    """
    if map_a.label is not None and map_b.label is not None and len(map_a) and len(map_b):
        labels_a, rows_a = _row_of_label(map_a)
        labels_b, rows_b = _row_of_label(map_b)
        shared_labels, at_a, at_b = np.intersect1d(labels_a, labels_b, return_indices=True)
        shortage = ""
        if len(shared_labels) < FEW:
            label_text = (
                "are labels of both maps" if len(shared_labels) != 1 else "is a label of both maps"
            )
            a, b = (
                f"{len(labels)} from {labels[0]} to {labels[-1]}" if len(labels) else "none"
                for labels in (labels_a, labels_b)
            )
            shortage = (
                f"{len(shared_labels) or 'none'} {label_text} ({map_a.called}: {a}; "
                f"{map_b.called}: {b}); "
                "where both maps have labels, landmarks are matched by them alone"
            )
        by_label = Correspondences(
            rows_a[at_a], rows_b[at_b], np.zeros(len(shared_labels)), shortage
        )
        if one_floor:
            return by_label
        offset_m = _height_offset(map_a, map_b, by_label, parameters.height)
        return _placed(map_a, map_b, replace(by_label, height_offset_m=offset_m))
    for landmarks in (map_a, map_b):
        if not len(landmarks):
            return _no_pairs(f"{landmarks.called} is empty")
    height_bound = math.inf if map_a.planar or map_b.planar else parameters.height.bound
    floor_m2 = parameters.height.floor_m**2
    if matched_by_geometry(map_a, map_b):
        gates = height_bound, floor_m2, parameters.tolerance_m, parameters.size_tolerance
        a, b = (in_local_frame(each, origin_of(each)) for each in (map_a, map_b))
        index_a, index_b = match_by_geometry(a, b, *gates)
        shortage = ""
        if len(index_a) < FEW:
            shortage = "no motion lays landmarks of the maps on each other; matched by geometry"
            shortage += _size_note(map_a, map_b)
        zeros = np.zeros(len(index_a))
        laid = Correspondences(index_a, index_b, zeros, shortage, parameters.size_tolerance)
        if one_floor:
            return laid
        offset_m = _height_offset(map_a, map_b, laid, parameters.height)
        return replace(laid, height_offset_m=offset_m)
    if map_a.descriptor is None or map_b.descriptor is None:
        described, labelled = (map_b, map_a) if map_a.descriptor is None else (map_a, map_b)
        return _no_pairs(
            f"{described.called} has descriptors, {labelled.called} only labels: give both "
            "maps descriptors, or both labels; without either in one map they are matched by "
            "geometry"
        )
    offset_m, free = 0.0, None
    if math.isfinite(height_bound) and not one_floor:
        rows, nearest_b, distance = _mutually_nearest(map_a, map_b, math.inf, 0.0)
        is_kept = distance <= parameters.max_descriptor_distance
        free = Correspondences(rows[is_kept], nearest_b[is_kept], distance[is_kept])
        offset_m = _height_offset(map_a, map_b, free, parameters.height)
    lowered = in_local_frame(map_b, np.zeros(2), offset_m)
    rows, nearest_b, distance = _mutually_nearest(map_a, lowered, height_bound, floor_m2)
    is_kept = distance <= parameters.max_descriptor_distance
    a, b = (Site.of(each, height_bound, floor_m2) for each in (map_a, map_b))
    is_kept &= attributes_of_pairs_agree(a, b, rows, nearest_b, parameters.size_tolerance)
    shortage = why_few(map_a, map_b, parameters) if np.count_nonzero(is_kept) < FEW else ""
    parts = (rows[is_kept], nearest_b[is_kept], distance[is_kept])
    heights = {"height_offset_m": offset_m, "at_any_height": free}
    by_descriptor = Correspondences(*parts, shortage, **heights)
    return by_descriptor if one_floor else _placed(map_a, map_b, by_descriptor)


def _height_offset(
    map_a: LandmarkMap, map_b: LandmarkMap, pairs: Correspondences, gate: HeightGate
) -> float:
    """Return the height of map b above map a, 0 if none is significant or a map is planar."""
    if map_a.planar or map_b.planar:
        return 0.0
    a, b = pairs.index_a, pairs.index_b
    variance = map_a.covariance_m2[a, 2, 2] + map_b.covariance_m2[b, 2, 2] + gate.floor_m**2
    return height_offset_m(map_b.position_m[b, 2] - map_a.position_m[a, 2], variance, gate.bound)


# Diameter of a uniform disc over the median distance from its centre.
_DIAMETER_OVER_MEDIAN = 2 * math.sqrt(2)


def _placed(map_a: LandmarkMap, map_b: LandmarkMap, pairs: Correspondences) -> Correspondences:
    """Drop the pairs of landmarks whose standard deviation exceeds the size of their map."""
    is_kept, notes = np.ones(len(pairs), dtype=bool), []
    for landmarks, index in ((map_a, pairs.index_a), (map_b, pairs.index_b)):
        p_planar = landmarks.position_m[:, :2]
        off_m = np.linalg.norm(p_planar - np.median(p_planar, axis=0), axis=1)
        size_m = _DIAMETER_OVER_MEDIAN * float(np.median(off_m))
        sigma_m = np.sqrt(np.trace(landmarks.covariance_m2[:, :2, :2], axis1=1, axis2=2) / 2)
        uncertain = np.flatnonzero(sigma_m > size_m)
        # where most landmarks are that uncertain, the covariances or their units are wrong
        if size_m > 0 and 0 < len(uncertain) < len(p_planar) / 2:
            is_kept &= ~np.isin(index, uncertain)
            number = "landmark" if len(uncertain) == 1 else "landmarks"
            notes.append(
                f"{len(uncertain)} {number} of {landmarks.name} left aside: sigma up to "
                f"{_short(float(sigma_m[uncertain].max()))} m in a map of {_short(size_m)} m"
            )
    if not notes:
        return pairs
    return replace(
        pairs,
        index_a=pairs.index_a[is_kept],
        index_b=pairs.index_b[is_kept],
        distance=pairs.distance[is_kept],
        set_aside="; ".join(notes),
    )


def _size_note(map_a: LandmarkMap, map_b: LandmarkMap) -> str:
    """Say that the sizes of two maps are in different units; empty if they may be in one."""
    sizes_m = [
        math.nan
        if each.size_m is None or np.isnan(each.size_m).all()
        else np.nanmedian(each.size_m)
        for each in (map_a, map_b)
    ]
    if not max(sizes_m) >= _OTHER_SIZES * min(sizes_m):  # NaN fails
        return ""
    size_texts = (
        f"{each.called} {_short(m)} m" for each, m in zip((map_a, map_b), sizes_m, strict=True)
    )
    return f"; median sizes: {', '.join(size_texts)}: are both in metres?"


def matched_by_geometry(map_a: LandmarkMap, map_b: LandmarkMap) -> bool:
    """Return True if one of two maps has neither descriptors nor labels."""
    return any(each.descriptor is None and each.label is None for each in (map_a, map_b))


def _no_pairs(shortage: str) -> Correspondences:
    no_rows = np.zeros(0, np.int64)
    return Correspondences(no_rows, no_rows, np.zeros(0), shortage)


def _row_of_label(landmarks: LandmarkMap) -> tuple[np.ndarray, np.ndarray]:
    """Return all labels and for each the row observed most often (the first, on a tie)."""
    assert landmarks.label is not None
    rows = np.flatnonzero(landmarks.label != NO_LABEL)
    rows = rows[np.argsort(-landmarks.count[rows].astype(np.int64), kind="stable")]
    labels, first = np.unique(landmarks.label[rows], return_index=True)
    return labels, rows[first]


def _mutually_nearest(
    map_a: LandmarkMap, map_b: LandmarkMap, height_bound: float, floor_m2: float
) -> tuple[np.ndarray, np.ndarray, Float]:
    """Return rows (N,) of both maps, each the other's nearest, and their descriptors' distances."""
    nearest_b, distance2, nearest_a = nearest_descriptors(map_a, map_b, height_bound, floor_m2)
    rows = np.flatnonzero(nearest_a[nearest_b] == np.arange(len(map_a)))
    apart = np.sqrt(np.maximum(distance2[rows], 0.0))
    return (
        rows,
        nearest_b[rows],
        relative_distance(apart, map_a.descriptor_kind, map_b.descriptor_kind),
    )


def why_few(map_a: LandmarkMap, map_b: LandmarkMap, parameters: MatchParameters) -> str:
    """Return which test of `match` removed most pairs of two maps with descriptors.

    Counts and medians are of the pairs that are mutually nearest among all landmarks, without the
    test of heights; `match` keeps those with compatible heights.
    """
    rows, nearest, distance = _mutually_nearest(map_a, map_b, math.inf, 0.0)
    known_a, known_b = (
        np.logical_not(np.any(np.isnan(each.descriptor), axis=1))  # type: ignore[arg-type]
        for each in (map_a, map_b)
    )
    described = known_a[rows] & known_b[nearest]
    rows, nearest, distance = rows[described], nearest[described], distance[described]
    reason = f"{len(rows)} mutually nearest descriptors"
    if len(rows) < FEW:
        a, b = np.count_nonzero(known_a), np.count_nonzero(known_b)
        return f"{reason} ({map_a.called} has {a} descriptors, {map_b.called} {b})"
    alike = distance <= parameters.max_descriptor_distance
    n_alike = np.count_nonzero(alike)
    if n_alike < FEW:
        reason += (
            f", {n_alike} at most {parameters.max_descriptor_distance:g} apart "
            f"(median {_short(np.median(distance))})"
        )
        return f"{reason}: the maps show other things, or their descriptors are of different kinds"
    if n_alike < len(rows):
        reason += f", {n_alike} at most {parameters.max_descriptor_distance:g} apart"
    rows, nearest = rows[alike], nearest[alike]
    up_m = map_b.position_m[nearest, 2] - map_a.position_m[rows, 2]
    variances = map_a.covariance_m2[rows, 2, 2], map_b.covariance_m2[nearest, 2, 2]
    agree = parameters.height.agrees(up_m, variances[0], np.zeros(1), variances[1])
    reach = np.sqrt(parameters.height.bound * (sum(variances) + parameters.height.floor_m**2))
    higher = map_b if np.median(up_m) > 0 else map_a
    reason += (
        f", {np.count_nonzero(agree)} within {np.median(reach):.2g} m of height "
        f"(median difference {np.median(np.abs(up_m)):.2f} m, {higher.called} higher)"
    )
    scale = scale_note(map_a, map_b, rows, nearest)
    return f"{reason}; {scale}" if scale else reason


def scale_note(
    map_a: LandmarkMap, map_b: LandmarkMap, index_a: np.ndarray, index_b: np.ndarray
) -> str:
    """Return the factor by which one map is larger than the other, in words; empty without one.

    The ratio of the distances between landmarks is equal for all true pairs and differs for false
    pairs. The factor is the ratio that many pairs of pairs share. Without such a ratio the extents
    of the maps are compared.
    """
    scale = _common_ratio(map_a.position_m[index_a, :2], map_b.position_m[index_b, :2])
    if math.isnan(scale):
        extents = []  # twice the median distance of the landmarks to their median, in plan
        for landmarks in (map_a, map_b):
            p_planar = landmarks.position_m[:, :2]
            distance_m = np.linalg.norm(p_planar - np.median(p_planar, axis=0), axis=1)
            extents.append(2 * float(np.median(distance_m)))
        if not min(extents) > 0 or max(extents) < _OTHER_WORLD * min(extents):
            return ""
        return (
            f"{map_a.called} spans {_short(extents[0])} m, {map_b.called} "
            f"{_short(extents[1])} m: are both in metres?"
        )
    if 1 / _SAME_SCALE < scale < _SAME_SCALE:
        return ""
    large_map, small_map = (map_b, map_a) if scale > 1 else (map_a, map_b)
    factor = max(scale, 1 / scale)
    units = (name for name, size in UNITS_PER_M.items() if abs(factor / size - 1) < _RATIO_WIDTH)
    question = f"is it in {unit}?" if (unit := next(units, "")) else "are both in metres?"
    return (
        f"distances between landmarks of {large_map.called} are {_short(factor)} times those of "
        f"{small_map.called}: {question}"
    )


def _short(value: float) -> str:
    """Return a number with two digits if it is small, and without decimals if it is large."""
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def _common_ratio(p_a: Float, p_b: Float) -> float:
    """Return the ratio |p_b - q_b| / |p_a - q_a| that many of N pairs (N, 2) share, NaN if none.

    Each pair is compared with a few others. Ratios of false pairs spread over a factor of two or
    more, so that few are in the densest interval by chance.
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
