"""Which correspondences can be true together: their landmarks lie equally far apart in both maps.

A rigid motion keeps distances, so two true correspondences agree in them but for the landmarks'
noise, whatever the motion (Mangelson et al. 2018, PCM; Lusk et al. 2021, CLIPPER).
"""

import math

import numpy as np
from numba import njit

from mapfusion.align.bits import trailing_zeros
from mapfusion.align.mahalanobis_gate import PlanarPairs
from mapfusion.se2 import Float

WORD = 64
_BYTES = 8  # answers looked at together: nearly all are no
_ROUNDING = 1e-14  # share of the fourth power of distances that cancellation may leave


@njit(cache=True)
def largest_variances(S: Float) -> Float:
    """Larger eigenvalue (N,) of covariances (N, 2, 2): the variance in the worst direction."""
    largest = np.empty(len(S))
    for i in range(len(S)):
        xx, xy, yy = S[i, 0, 0], S[i, 0, 1], S[i, 1, 1]
        largest[i] = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
    return largest


@njit(cache=True)
def _mark_near(
    ax: Float,
    ay: Float,
    bx: Float,
    by: Float,
    most: Float,
    at: tuple[float, float, float, float, float],
    near: np.ndarray,
) -> None:
    """Mark in `near` (n,) those with |d_a - d_b|^2 <= the sum of two `most`, without a root.

    Written so that the compiler compares several at once: no index but the loop's own, no branch.
    """
    ax0, ay0, bx0, by0, most0 = at
    for j in range(len(near)):
        dx, dy, ex, ey = ax[j] - ax0, ay[j] - ay0, bx[j] - bx0, by[j] - by0
        p, q = dx * dx + dy * dy, ex * ex + ey * ey
        t = p + q - (most[j] + most0)
        near[j] = (t <= 0) | (t * t <= 4 * p * q + _ROUNDING * (p + q) * (p + q))


@njit(cache=True)
def variance_along(dx: float, dy: float, S: Float, i: int, j: int) -> float:
    """Variance of landmarks i and j together along the line (dx, dy) between them."""
    square = dx * dx + dy * dy
    if square == 0:
        return 0.0
    xx, xy, yy = S[i, 0, 0] + S[j, 0, 0], S[i, 0, 1] + S[j, 0, 1], S[i, 1, 1] + S[j, 1, 1]
    return (dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy) / square


@njit(cache=True)
def drift_needed(pairs: PlanarPairs, i: int, j: int, bound: float) -> float:
    """s_drift^2 from which on correspondences i and j agree; negative: even without drift.

    To first order the difference of the two distances has the variance v that the four landmarks
    have along the lines between them, and s_drift^2 for each correspondence.
    """
    p_a, p_b, S_a, S_b = pairs
    ax, ay = p_a[j, 0] - p_a[i, 0], p_a[j, 1] - p_a[i, 1]
    bx, by = p_b[j, 0] - p_b[i, 0], p_b[j, 1] - p_b[i, 1]
    difference = math.sqrt(ax * ax + ay * ay) - math.sqrt(bx * bx + by * by)
    v = variance_along(ax, ay, S_a, i, j) + variance_along(bx, by, S_b, i, j)
    return (difference * difference / bound - v) / 2


@njit(cache=True)
def consistency(pairs: PlanarPairs, variances_m2: Float, bound: float) -> np.ndarray:
    """Graphs of consistent correspondences, one for each s_drift.

    Every two are first compared under the landmarks' worst variances; only the few that pass are
    looked at along their own lines.

    Args:
        pairs: N correspondences.
        variances_m2: (L,) s_drift^2, ascending.
        bound: most for the squared difference of distances over its variance.

    Returns:
        (L, N, ceil(N / 64)) uint64: bit j of row i tells whether i and j agree; symmetric, without
        the diagonal.
    """
    p_a, p_b, S_a, S_b = pairs
    n, levels = len(p_a), len(variances_m2)
    ax, ay, bx, by = p_a[:, 0].copy(), p_a[:, 1].copy(), p_b[:, 0].copy(), p_b[:, 1].copy()
    most = bound * (largest_variances(S_a) + largest_variances(S_b) + variances_m2[levels - 1])
    graphs = np.zeros((levels, n, (n + WORD - 1) // WORD), np.uint64)
    eight = np.zeros((n + _BYTES - 1) // _BYTES, np.uint64)
    near = eight.view(np.uint8)
    for i in range(n - 1):
        at = ax[i], ay[i], bx[i], by[i], most[i]
        _mark_near(ax[i:], ay[i:], bx[i:], by[i:], most[i:], at, near[i:n])
        near[i] = 0
        own_bit = np.uint64(1) << np.uint64(i & 63)
        for group in range(i // _BYTES, len(eight)):
            word = eight[group]
            while word:
                j = (group << 3) + (trailing_zeros(word) >> 3)
                word &= word - np.uint64(1)
                needed = drift_needed(pairs, i, j, bound)
                bit = np.uint64(1) << np.uint64(j & 63)
                for level in range(levels - 1, -1, -1):
                    if needed > variances_m2[level]:
                        break
                    graphs[level, i, j >> 6] |= bit
                    graphs[level, j, i >> 6] |= own_bit
    return graphs
