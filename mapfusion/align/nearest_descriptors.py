"""Landmarks of two maps whose descriptors are each other's nearest, among those of like heights.

Distances come from products of matrices: of a block of landmarks of like heights in one map with
all those of the other map that can have such a height.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mapfusion.align.bits import WORD, packed, trailing_zeros
from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

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


def nearest_both_ways(
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


@kernel_part
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


@kernel_part
def _apart_by_less(p: Float, i: int, q: Float, j: int, distance_m: float) -> bool:
    """Whether point i of (N, 2) and point j of others are less than a distance apart."""
    dx, dy = p[i, 0] - q[j, 0], p[i, 1] - q[j, 1]
    return dx * dx + dy * dy < distance_m * distance_m


@inner_kernel
def _take(side: _Side, i: int, j: int, distance2: float) -> None:
    """Take j for the nearest of i if it is; of equally near ones the first."""
    known = side.distance2[i]
    if distance2 < known or (distance2 == known and j < side.nearest[i]):
        side.nearest[i], side.distance2[i] = j, distance2
