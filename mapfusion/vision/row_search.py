"""Where in its row of the right image a window of the left one is found, in whole pixels."""

import numpy as np
from numba import njit

from mapfusion.vision.verdict import Verdict

_PEAK_HALF_WIDTH_PX = 2  # rivals are looked for beyond the slopes of the best peak


@njit(cache=True)
def search_rows(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    min_disparity: int,
    max_disparity: int,
    half: int,
    min_correlation: float,
    max_ambiguity: float,
    max_round_trip: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Search there and back for each window.

    Centres (u, v) (N, 2) with less than one column to spare are OUTSIDE. 1 - correlation must stay
    below `max_ambiguity` of the best rival's, start and end differ by `max_round_trip` at most.
    Returns disparities (N,), meaningful where the verdict is MATCHED, and verdicts (N,) int8.
    """
    height, width = left.shape
    scores = np.empty(width)
    disparity = np.zeros(len(pixel), dtype=np.int64)
    verdict = np.empty(len(pixel), dtype=np.int8)
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        first, last = max(u - max_disparity, half), u - min_disparity
        inside = half < u < width - half - 1 and half <= v < height - half
        if not inside or first > last:
            verdict[n] = Verdict.OUTSIDE
            continue
        found, verdict[n] = _search(
            left, right, u, v, first, last, half, min_correlation, max_ambiguity, scores
        )
        if verdict[n] != Verdict.MATCHED:
            continue
        back_first, back_last = found + min_disparity, min(found + max_disparity, width - half - 1)
        back, _ = _search(right, left, found, v, back_first, back_last, half, -1.0, 1.0, scores)
        if abs(back - u) > max_round_trip:
            verdict[n] = Verdict.ONE_SIDED
            continue
        disparity[n] = u - found
    return disparity, verdict


@njit(cache=True)
def _search(
    image: np.ndarray,
    other: np.ndarray,
    u: int,
    v: int,
    first: int,
    last: int,
    half: int,
    min_correlation: float,
    max_ambiguity: float,
    scores: np.ndarray,
) -> tuple[int, int]:
    """Column of `other` in first..last that looks most like (u, v) of `image`, and a verdict."""
    if last < first:
        return u, Verdict.OUTSIDE
    if not _correlate(image, other, u, v, first, last, half, scores):
        return u, Verdict.FLAT
    best = 0
    for k in range(1, last - first + 1):
        if scores[k] > scores[best]:
            best = k
    if scores[best] < min_correlation:
        return first + best, Verdict.WEAK
    rival = -1.0
    for k in range(last - first + 1):
        if abs(k - best) > _PEAK_HALF_WIDTH_PX and scores[k] > rival:
            rival = scores[k]
    if 1 - scores[best] >= max_ambiguity * (1 - rival):
        return first + best, Verdict.AMBIGUOUS
    return first + best, Verdict.MATCHED


@njit(cache=True)
def _correlate(
    image: np.ndarray,
    other: np.ndarray,
    u: int,
    v: int,
    first: int,
    last: int,
    half: int,
    scores: np.ndarray,
) -> bool:
    """Fill `scores` with the correlation at columns first..last; False when the window is flat.

    Whole numbers throughout, and the candidates in the inner loop: that is what vectorises.
    """
    side = 2 * half + 1
    area = side * side
    candidates = last - first + 1
    cross = np.zeros(candidates, dtype=np.int32)
    column_sum = np.zeros(candidates + 2 * half, dtype=np.int32)
    column_square = np.zeros(candidates + 2 * half, dtype=np.int32)
    total, total_square = np.int64(0), np.int64(0)
    for y in range(v - half, v + half + 1):
        strip = other[y, first - half : last + half + 1]
        for k in range(candidates + 2 * half):
            grey = np.int32(strip[k])
            column_sum[k] += grey
            column_square[k] += grey * grey
        for j in range(side):
            grey = np.int32(image[y, u - half + j])
            total += grey
            total_square += grey * grey
            for k in range(candidates):
                cross[k] += grey * np.int32(strip[k + j])
    spread = area * total_square - total * total
    if spread == 0:
        return False
    strip_total, strip_square = np.int64(0), np.int64(0)
    for k in range(side - 1):
        strip_total += column_sum[k]
        strip_square += column_square[k]
    for k in range(candidates):
        strip_total += column_sum[k + side - 1]
        strip_square += column_square[k + side - 1]
        strip_spread = area * strip_square - strip_total * strip_total
        covariance = area * np.int64(cross[k]) - total * strip_total
        scores[k] = (
            covariance / np.sqrt(float(spread) * float(strip_spread)) if strip_spread > 0 else -1.0
        )
        strip_total -= column_sum[k]
        strip_square -= column_square[k]
    return True
