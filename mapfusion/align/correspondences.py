"""Correspondences: pairs of landmarks of two maps that may be the same point of the world.

Distances come from products of matrices: of a block of landmarks of like heights in one map with
all those of the other map that can have such a height.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from mapfusion.geometry.numerics import (
    WORD,
    Float,
    chi_square_bound,
    kernel,
    packed,
    trailing_zeros,
)
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Probability, Range, require_finite, require_in_range, require_shape
from mapfusion.robot_log import FILTERED_STRAY_M
from mapfusion.tables import NO_LABEL

_BLOCK_ROWS = 256  # rows of the descriptor distance matrix held at once: 5 MB at 5000 columns
# What single precision may make of a squared distance or a height, as a share of it: a handful of
# roundings of 2^-24.
_ROUNDING = 2.0**-20
# (d + r)^2 is at most (1 + s) d^2 + (1 + 1 / s) r^2: a small share s of the pairs looked at more
# closely pays for a rounding r that is larger than it.
_SHARE = 1 / 16
_WIDE = 4.0  # times the median variance of heights: a block would take the widest gate of its rows
# stands for the NaN of a landmark without a descriptor, far from all others
_ABSENT = 1e9


def nearest_descriptors(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    height_bound: float,
    floor_m2: float,
    elsewhere_m: float = 0.0,
) -> tuple[np.ndarray, Float, np.ndarray]:
    """Nearest b of each a, its squared distance (infinite: none fits), and nearest a of each b.

    Two fit when the squared difference of their heights is at most `height_bound`, infinite for
    planar maps, times its variance, in which `floor_m2` is what landmarks' own variances leave out.
    Nor do they fit that lie nearer to each other than `elsewhere_m`, of a map beside itself.
    """
    a, b = _Side.of(map_a, _ABSENT, 0.0), _Side.of(map_b, -_ABSENT, floor_m2)
    for rows in a.blocks(height_bound):
        columns = b.of_heights(*a.interval(rows, height_bound), height_bound)
        product = a.descriptor[rows] @ b.descriptor[columns].T
        _take_nearer(product, rows, columns, a, b, height_bound, elsewhere_m)
    return a.nearest, a.distance2, b.nearest


class _Side(NamedTuple):
    """The N landmarks of one map, and the nearest of the other map so far, for the kernel."""

    descriptor: np.ndarray  # (N, D)
    square: np.ndarray  # (N,) squared norms of the descriptors
    place_m: Float  # (N, 2) in the plane
    z_m: Float  # (N,)
    variance_m2: Float  # (N,) of the heights
    nearest: np.ndarray  # (N,)
    distance2: Float  # (N,) to that

    @classmethod
    def of(cls, landmarks: LandmarkMap, absent: float, floor_m2: float) -> "_Side":
        assert landmarks.descriptor is not None
        n = len(landmarks)
        descriptor = np.nan_to_num(landmarks.descriptor.astype(np.float32), nan=absent)
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
        """All rows in blocks of alike heights; those of wide gates are in blocks of their own."""
        rows = np.arange(len(self.z_m))
        if np.isfinite(bound):
            wide = self.variance_m2 > _WIDE * np.median(self.variance_m2)
            rows = np.lexsort((self.z_m, wide))
        return [rows[k : k + _BLOCK_ROWS] for k in range(0, len(rows), _BLOCK_ROWS)]

    def interval(self, rows: np.ndarray, bound: float) -> tuple[float, float]:
        """From where to where the heights of some rows can be."""
        if not np.isfinite(bound):
            return -np.inf, np.inf
        reach = np.sqrt(bound * self.variance_m2[rows])
        return float(np.min(self.z_m[rows] - reach)), float(np.max(self.z_m[rows] + reach))

    def of_heights(self, low_m: float, high_m: float, bound: float) -> np.ndarray:
        """Rows whose heights can lie in an interval: all that one of it is compatible with."""
        if not np.isfinite(bound):
            return np.arange(len(self.z_m))
        reach = np.sqrt(bound * self.variance_m2)
        return np.flatnonzero((self.z_m + reach >= low_m) & (self.z_m - reach <= high_m))


class _Coarse(NamedTuple):
    """Landmarks (n,) in single precision."""

    square: np.ndarray  # squared norms of the descriptors
    best: np.ndarray  # squared distance to the nearest so far
    z: np.ndarray  # heights in m
    most: np.ndarray  # what each adds to the most that the squared difference of heights may be


@kernel
def _coarse(side: _Side, rows: np.ndarray, height_bound: float) -> _Coarse:
    """Some landmarks (n,) in single precision, with what its rounding needs."""
    n = len(rows)
    square, best = np.empty(n, np.float32), np.empty(n, np.float32)
    z, most = np.empty(n, np.float32), np.empty(n, np.float32)
    for k in range(n):
        i = rows[k]
        square[k] = (1 - _ROUNDING) * side.square[i]
        best[k] = side.distance2[i]
        z[k] = side.z_m[i]
        lost = _ROUNDING * side.z_m[i]
        most[k] = math.inf
        if height_bound < math.inf:
            most[k] = (1 + _SHARE) * height_bound * side.variance_m2[i]
            most[k] += (1 + 1 / _SHARE) * 2 * lost * lost
    return _Coarse(square, best, z, most)


@kernel
def _mark_nearer(
    product: np.ndarray,
    square: np.ndarray,
    best: np.ndarray,
    z: np.ndarray,
    most: np.ndarray,
    own: tuple[Any, Any, Any, Any],
    near: np.ndarray,
) -> None:
    """Mark the columns that may be nearer than the nearest so far of theirs or of their row's.

    Written so that the compiler compares several at once: no index but the loop's own, no branch.
    """
    square0, best0, z0, most0 = own
    for k in range(len(near)):
        distance2 = square[k] + square0 - (product[k] + product[k])
        dz = z[k] - z0
        near[k] = (distance2 <= max(best[k], best0)) & (dz * dz <= most[k] + most0)


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
    """Update the nearest both ways from scalar products of descriptors.

    `product` (n, m) is of some `rows` of map a with some `columns` of map b, `height_bound` the
    most for the squared difference of heights over its variance; pairs nearer than `elsewhere_m`
    are none. Of equally near ones the first row
    of its map counts. All are compared coarsely, by pieces that double, since few are nearer than
    the nearest of many; those that pass are compared as exactly as they were given.
    """
    m = len(columns)
    coarse_a = _coarse(a, rows, height_bound)
    square, best, z, most = _coarse(b, columns, height_bound)
    eights = np.zeros((m + WORD - 1) // WORD * 8, np.uint64)
    near = eights.view(np.uint8)
    for k in range(len(rows)):
        i = rows[k]
        first, end = 0, WORD
        while first < m:
            end = min(end, m)
            own = coarse_a.square[k], np.float32(a.distance2[i]), coarse_a.z[k], coarse_a.most[k]
            part = slice(first, end)
            _mark_nearer(
                product[k, part], square[part], best[part], z[part], most[part], own, near[part]
            )
            for w in range(first // WORD, (end + WORD - 1) // WORD):
                word = packed(eights, w)
                while word:
                    c = w * WORD + trailing_zeros(word)
                    word &= word - np.uint64(1)
                    j = columns[c]
                    if _apart_by_less(a.place_m, i, b.place_m, j, elsewhere_m):
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
def _apart_by_less(p: Float, i: int, q: Float, j: int, distance_m: float) -> bool:
    """Whether point i of (N, 2) and point j of others are less than a distance apart."""
    dx, dy = p[i, 0] - q[j, 0], p[i, 1] - q[j, 1]
    return dx * dx + dy * dy < distance_m * distance_m


@kernel
def _take(side: _Side, i: int, j: int, distance2: float) -> None:
    """Take j for the nearest of i if it is; of equally near ones the first."""
    known = side.distance2[i]
    if distance2 < known or (distance2 == known and j < side.nearest[i]):
        side.nearest[i], side.distance2[i] = j, distance2


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
    nearest_b, distance2, nearest_a = nearest_descriptors(map_a, map_b, height_bound, floor_m2)
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
