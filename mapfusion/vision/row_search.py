"""Where in its row of the right image a window of the left one is found, in whole pixels."""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.vision.verdict import Verdict

_PEAK_HALF_WIDTH_PX = 2  # rivals are looked for beyond the slopes of the best peak
_CROSS, _SUM, _SQUARE = range(3)  # of candidates: sums of products; of columns: of greys, squares
_AT_ONCE = 8  # candidates that a vector takes: up to a multiple all cost the same


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
    width = left.shape[1]
    disparity, verdict = np.zeros(len(pixel), dtype=np.int64), np.empty(len(pixel), dtype=np.int8)
    room = np.zeros((3, width + _AT_ONCE), dtype=np.int32)
    strip = np.zeros(width + _AT_ONCE, dtype=np.uint8)
    limits = (min_disparity, max_disparity, half, min_correlation, max_ambiguity, max_round_trip)
    _search_all(left, right, pixel, *limits, np.empty(width), strip, room, disparity, verdict)
    return disparity, verdict


@kernel
def _search_all(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    min_disparity: int,
    max_disparity: int,
    half: int,
    min_correlation: float,
    max_ambiguity: float,
    max_round_trip: int,
    scores: np.ndarray,
    strip: np.ndarray,
    room: np.ndarray,
    disparity: np.ndarray,
    verdict: np.ndarray,
) -> None:
    """Fill in disparities and verdicts; the three before are room for what is on the way."""
    height, width = left.shape
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        first, last = max(u - max_disparity, half), u - min_disparity
        inside = half < u < width - half - 1 and half <= v < height - half
        if not inside or first > last:
            verdict[n] = Verdict.OUTSIDE
            continue
        found, verdict[n] = _search(
            left,
            right,
            u,
            v,
            first,
            last,
            half,
            min_correlation,
            max_ambiguity,
            scores,
            strip,
            room,
        )
        if verdict[n] != Verdict.MATCHED:
            continue
        back_first, back_last = found + min_disparity, min(found + max_disparity, width - half - 1)
        back, _ = _search(
            right, left, found, v, back_first, back_last, half, -1.0, 1.0, scores, strip, room
        )
        if abs(back - u) > max_round_trip:
            verdict[n] = Verdict.ONE_SIDED
            continue
        disparity[n] = u - found


@kernel
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
    strip: np.ndarray,
    room: np.ndarray,
) -> tuple[int, int]:
    """Column of `other` in first..last that looks most like (u, v) of `image`, and a verdict."""
    if last < first:
        return u, Verdict.OUTSIDE
    if not _correlate(image, other, u, v, first, last, half, scores, strip, room):
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


@kernel_part
def _correlate(
    image: np.ndarray,
    other: np.ndarray,
    u: int,
    v: int,
    first: int,
    last: int,
    half: int,
    scores: np.ndarray,
    strip: np.ndarray,
    room: np.ndarray,
) -> bool:
    """Fill `scores` with the correlation at columns first..last; False when the window is flat.

    Whole numbers throughout, and the candidates in the inner loop: that is what vectorises.
    """
    side = 2 * half + 1
    area, candidates = side * side, last - first + 1
    padded = -(-candidates // _AT_ONCE) * _AT_ONCE
    _clear(room, padded + 2 * half)
    total, total_square = np.int64(0), np.int64(0)
    for y in range(v - half, v + half + 1):
        _take_strip(other, y, first - half, candidates + 2 * half, strip, room)
        _add_products(image, y, u - half, half, strip, padded, room)
        row_total, row_square = _add_up(image, y, u - half, side)
        total += row_total
        total_square += row_square
    spread = area * total_square - total * total
    if spread == 0:
        return False
    strip_total, strip_square = np.int64(0), np.int64(0)
    for k in range(side - 1):
        strip_total += room[_SUM, k]
        strip_square += room[_SQUARE, k]
    for k in range(candidates):
        strip_total += room[_SUM, k + side - 1]
        strip_square += room[_SQUARE, k + side - 1]
        strip_spread = area * strip_square - strip_total * strip_total
        covariance = area * np.int64(room[_CROSS, k]) - total * strip_total
        scores[k] = (
            covariance / np.sqrt(float(spread) * float(strip_spread)) if strip_spread > 0 else -1.0
        )
        strip_total -= room[_SUM, k]
        strip_square -= room[_SQUARE, k]
    return True


@kernel_part
def _add_up(image: np.ndarray, y: int, begin: int, count: int) -> tuple[np.int32, np.int32]:
    """Sum and sum of squares of part of a row."""
    total, total_square, at = np.int32(0), np.int32(0), np.uintp(begin)
    for k in range(count):
        grey = np.int32(image[y, at + np.uintp(k)])
        total = np.int32(total + grey)
        total_square = np.int32(total_square + grey * grey)
    return total, total_square


@kernel_part
def _clear(room: np.ndarray, count: int) -> None:
    for i in range(len(room)):
        for k in range(count):
            room[i, k] = 0


@kernel_part
def _take_strip(
    other: np.ndarray, y: int, begin: int, count: int, strip: np.ndarray, room: np.ndarray
) -> None:
    """Copy part of a row, and add it to the columns' sums and sums of squares."""
    at = np.uintp(begin)
    for k in range(count):
        grey = other[y, at + np.uintp(k)]
        strip[k] = grey
        room[_SUM, k] += np.int32(grey)
        room[_SQUARE, k] += np.int32(grey) * np.int32(grey)


@kernel_part
def _add_products(
    image: np.ndarray,
    y: int,
    begin: int,
    half: int,
    strip: np.ndarray,
    count: int,
    room: np.ndarray,
) -> None:
    """Add a row of the window times the strip, from each of `count` candidates on.

    The window's row is odd: its first column, then two at once, which halves the way to memory.
    """
    here = np.int32(image[y, begin])
    for k in range(count):
        room[_CROSS, k] += here * np.int32(strip[k])
    for j in range(1, 2 * half, 2):
        here, after = np.int32(image[y, begin + j]), np.int32(image[y, begin + j + 1])
        first, second = np.uintp(j), np.uintp(j + 1)
        for k in range(count):
            products = here * np.int32(strip[first + np.uintp(k)])
            room[_CROSS, k] += products + after * np.int32(strip[second + np.uintp(k)])
