"""Consensus of pairs: pairwise consistency, and the support that robust methods share.

A rigid motion preserves distances. The distance between the landmarks of two true correspondences
is therefore equal in both maps up to noise (Mangelson et al. 2018, PCM; Lusk et al. 2021, CLIPPER).
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.align.alignment import Fit, Pairs, Undetermined, why_angle_is_open
from mapfusion.align.correspondences import HeightGate
from mapfusion.align.mahalanobis_gate import (
    DRIFT_FLOOR_M,
    PairSpread,
    PlanarPairs,
    mean_variances,
    refit_at_best_drift,
)
from mapfusion.geometry.numerics import (
    WORD,
    Float,
    chi_square_bound,
    kernel,
    mirror,
    packed,
    trailing_zeros,
)
from mapfusion.parameters import Probability, Range, require_in_range

# Bound of the single-precision error of the difference of two distances: coordinates of at most 1,
# read to 2^-25, subtracted, squared and added in two maps make 15 roundings of 2^-24.
_ROUNDING = 16 * 2.0**-24
# s in (d + r)^2 <= (1 + s) d^2 + (1 + 1 / s) r^2, which bounds a distance d with rounding error r.
_SHARE = 1 / 16
_LEAST_EXTENT_M = 1e-6  # smallest extent of a map, which avoids a division by zero


@kernel
def _worst(xx: float, xy: float, yy: float) -> float:
    """Return the larger eigenvalue of a covariance."""
    return (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)


@kernel
def _coarse(
    rows: Float, variance_m2: float, bound: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs in single precision, with bounds that include rounding errors.

    Returns:
        Positions ax, ay, bx, by relative to the first pair, in units of the larger map's extent,
        and the contribution of each pair to the largest squared difference of two distances, each
        of shape (N,).
    """
    n, extent = len(rows), _LEAST_EXTENT_M
    for i in range(n):
        for k in range(4):
            extent = max(extent, abs(rows[i, k] - rows[0, k]))
    ax, ay = np.empty(n, np.float32), np.empty(n, np.float32)
    bx, by, max_error = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        ax[i], ay[i] = (rows[i, 0] - rows[0, 0]) / extent, (rows[i, 1] - rows[0, 1]) / extent
        bx[i], by[i] = (rows[i, 2] - rows[0, 2]) / extent, (rows[i, 3] - rows[0, 3]) / extent
        worst = _worst(rows[i, 4], rows[i, 5], rows[i, 6])
        worst += _worst(rows[i, 7], rows[i, 8], rows[i, 9])
        coarse_bound = bound * (worst + variance_m2) / (extent * extent)
        max_error[i] = (1 + _SHARE) * coarse_bound + (1 + 1 / _SHARE) * _ROUNDING * _ROUNDING / 2
    return ax, ay, bx, by, max_error


@kernel
def _mark_near(
    ax: np.ndarray,
    ay: np.ndarray,
    bx: np.ndarray,
    by: np.ndarray,
    max_error: np.ndarray,
    at: tuple[float, float, float, float, float],
    is_near: np.ndarray,
) -> None:
    """Mark in `is_near` (n,) the pairs with (d_a - d_b)^2 <= m, with the sum m of two `max_error`.

    With p = d_a^2 and q = d_b^2 this is (p - q)^2 <= m (2 (p + q) - m) if m <= p + q, and true
    otherwise. The loop has no branch and no other index, so that it is vectorised.
    """
    ax0, ay0, bx0, by0, most0 = at
    for j in range(len(is_near)):
        dx, dy, ex, ey = ax[j] - ax0, ay[j] - ay0, bx[j] - bx0, by[j] - by0
        p, q = dx * dx + dy * dy, ex * ex + ey * ey
        m = min(max_error[j] + most0, p + q)
        is_near[j] = (p - q) * (p - q) <= m * (p + q + (p + q) - m)


@kernel(error_model="numpy")
def _variance_along(dx: float, dy: float, square: float, xx: float, xy: float, yy: float) -> float:
    """Return the variance along the direction (dx, dy) with this squared length; 0 for length 0."""
    along = dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy
    return along / square if square > 0 else 0.0


@kernel(error_model="numpy")
def _needed(first: tuple[float, ...], second: tuple[float, ...], bound: float) -> float:
    """Return `drift_needed` for two rows of `packed_rows`."""
    ax = second[0] - first[0]
    ay = second[1] - first[1]
    bx = second[2] - first[2]
    by = second[3] - first[3]
    p, q = ax * ax + ay * ay, bx * bx + by * by
    difference = math.sqrt(p) - math.sqrt(q)
    v = _variance_along(ax, ay, p, first[4] + second[4], first[5] + second[5], first[6] + second[6])
    v += _variance_along(
        bx, by, q, first[7] + second[7], first[8] + second[8], first[9] + second[9]
    )
    return (difference * difference / bound - v) / 2


def packed_rows(pairs: PlanarPairs) -> Float:
    """Return the pairs as rows: p_a, p_b, and xx, xy, yy of S_a and of S_b, shape (N, 10)."""
    rows = np.empty((len(pairs.p_a), 10))
    rows[:, :2], rows[:, 2:4] = pairs.p_a, pairs.p_b
    for k, S in ((4, pairs.S_a), (7, pairs.S_b)):
        rows[:, k], rows[:, k + 1], rows[:, k + 2] = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    return rows


@kernel
def _numbers(rows: Float, i: int) -> tuple[float, ...]:
    r = rows[i]
    return r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9]


@kernel
def drift_needed(rows: Float, i: int, j: int, bound: float) -> float:
    """Return the smallest s_drift^2 with which pairs i and j are consistent; it may be negative.

    To first order the variance of the difference of the two distances is the sum of the four
    landmarks' variances along the connecting lines, and s_drift^2 for each pair.
    """
    return _needed(_numbers(rows, i), _numbers(rows, j), bound)


@kernel
def consistency_graphs(rows: Float, scales_m2: tuple[float, float], bound: float) -> np.ndarray:
    """Return the graphs of consistent correspondences for a small and a large s_drift.

    All pairs of correspondences are first compared in single precision with the landmarks' largest
    variances. The few that pass are compared with the variances along their connecting lines.

    Args:
        rows: N correspondences as `packed_rows`.
        scales_m2: two values of s_drift^2, the smaller first.
        bound: largest squared difference of distances over its variance.

    Returns:
        Adjacency as bits, uint64, shape (2, N, ceil(N / 64)): bit j of row i is set if i and j are
        consistent; symmetric, without the diagonal.
    """
    n = len(rows)
    words = (n + WORD - 1) // WORD
    graphs = np.zeros((2, n, words), np.uint64)
    eights = np.zeros(words * WORD // 8, np.uint64)
    is_near = eights.view(np.uint8)
    ax, ay, bx, by, max_error = _coarse(rows, scales_m2[1], bound)
    for i in range(n - 1):
        at = ax[i], ay[i], bx[i], by[i], max_error[i]
        _mark_near(ax[i:], ay[i:], bx[i:], by[i:], max_error[i:], at, is_near[i:n])
        is_near[i] = 0
        pair_numbers = _numbers(rows, i)
        for w in range(i // WORD, words):
            word = packed(eights, w)
            low = high = np.uint64(0)
            while word:
                needed = _needed(
                    pair_numbers, _numbers(rows, w * WORD + trailing_zeros(word)), bound
                )
                remaining_bits = word & (word - np.uint64(1))
                low |= word ^ remaining_bits if needed <= scales_m2[0] else np.uint64(0)
                high |= word ^ remaining_bits if needed <= scales_m2[1] else np.uint64(0)
                word = remaining_bits
            graphs[0, i, w], graphs[1, i, w] = low, high
    mirror(graphs[0])
    mirror(graphs[1])
    return graphs


# Values of s_drift relative to the largest: maps without drift allow the narrow gate of their
# covariances, and finer steps gain little.
_SCALES = np.array([0.0, 0.5, 1.0])


@dataclass(frozen=True)
class Consensus:
    """Support of a motion by a gate from the landmarks' covariances and s_drift.

    Attributes:
        drift_sigma_m: largest expected s_drift per axis of both maps together; 0.1 m is usual
            between two maps of one loop. Half of this value and 0 are tried as well.
        probability: probability that a true pair lies inside the gate.
        height: test of compatible heights (not for planar maps).
    """

    drift_sigma_m: Annotated[float, Range(0, 100, "m")] = 0.1
    probability: Probability = 0.99
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def bound(self) -> float:
        """Largest e^T C^-1 e of a true pair (chi-square, 2 degrees of freedom)."""
        return chi_square_bound(self.probability, 2)

    @property
    def variances_m2(self) -> Float:
        """Values of s_drift^2 that are tried, ascending, shape (L,)."""
        return np.unique(np.maximum(self.drift_sigma_m * _SCALES, DRIFT_FLOOR_M) ** 2)

    def refitted(self, T_a_b: Float, pairs: Pairs, planar: PlanarPairs) -> Fit | Undetermined:
        """Refit T_a_b (3,) to its support with the most likely s_drift.

        The result is undetermined for T_a_b of NaN. Results are kept with the pairs, because
        repetitions of a method find the same motions.
        """
        fits: dict[tuple, Fit | Undetermined] = pairs.cache.setdefault(Consensus, {})
        key = self, T_a_b.tobytes()
        if key not in fits:
            inlier, level = np.zeros(len(pairs), dtype=bool), -1
            if np.all(np.isfinite(T_a_b)):
                arguments = planar, pair_spread(pairs), self.variances_m2, self.bound
                _, level = refit_at_best_drift(T_a_b, *arguments, inlier)
            fits[key] = self.fit_of(T_a_b, inlier, level, pairs, planar)
        return fits[key]

    def fit_of(
        self, T_a_b: Float, inlier: np.ndarray, level: int, pairs: Pairs, planar: PlanarPairs
    ) -> Fit | Undetermined:
        """Return the fit of a refitted motion with its support (N,).

        `level` is the index of s_drift in `variances_m2`, -1 without support.
        """
        if not np.all(np.isfinite(T_a_b)):
            return Undetermined(f"no motion has the support of two of {len(pairs)} correspondences")
        if level < 0:
            return Undetermined("fewer than 2 correspondences support the motion found")
        variance_m2, support = self.variances_m2[level], pairs[inlier]
        reason = why_angle_is_open(support, variance_m2)
        if reason:
            return Undetermined(reason)
        weight = 1 / mean_variances(planar, variance_m2)[inlier]
        return Fit(T_a_b, inlier, weight=weight, fitted=support)


def pair_spread(pairs: Pairs) -> PairSpread:
    """Return the `PairSpread` of the pairs, which is kept with them."""
    if PairSpread not in pairs.cache:
        pairs.cache[PairSpread] = PairSpread.of(pairs.in_plan())
    return pairs.cache[PairSpread]
