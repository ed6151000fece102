"""Harris corners (Harris and Stephens 1988), the strongest of each part of the image."""

import functools
import itertools
import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from mapfusion.arguments import Range, require_in_range
from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float

_SOBEL_APERTURE_PX = 3
_SOBEL_GAIN = 2.0  # OpenCV divides its Sobel sum, 8 times the slope per pixel, by 4
_SOBEL_SUM = 4.0  # what it divides by
_OUR_BLOCK_PX = 3
_PROBED_SIGMAS = 8  # more than OpenCV's window has to either side, and than its weights show
_LEAST_SIDE_PX = 2  # what an image needs to be mirrored at its border
_BITS, _ALL_BITS = np.uint64(32), np.uint32(0xFFFFFFFF)  # of a response
_ONE = np.uintp(1)  # indices without a sign, which a kernel need not wrap around


@dataclass(frozen=True)
class HarrisParameters:
    """Which corners to take.

    Attributes:
        max_corners: at most so many an image.
        smoothing_px: standard deviation of the Gaussian that the image is smoothed with first;
            noise and the staircase edges of unfiltered textures make corners of their own. Too much
            pulls corners inwards by a share of the window, which is another point of the wall as
            the robot draws near; too little loses corners.
        min_distance_px: no two corners nearer than this, before the sub-pixel step.
        cell_px: side of the squares of the grid that share `max_corners` evenly, so that one rich
            poster does not take all.
        block_px: side of the square over which the structure tensor is averaged.
        k: Harris' constant, 0.04 to 0.06 by custom.
        min_slope: grey levels per pixel; a corner whose brightness changes by this (RMS) in every
            direction is the weakest that counts. The Sobel slope of white noise of n grey levels is
            0.43 n, so the default stands clear of a noise of 2 levels.
        border_px: margin in which no corners are taken; the stereo windows must fit.
    """

    max_corners: Annotated[int, Range(1, 5000, "corners")] = 110
    smoothing_px: Annotated[float, Range(0.1, 50, "px")] = 1.5
    min_distance_px: Annotated[int, Range(1, 1000, "px")] = 10
    cell_px: Annotated[int, Range(8, 4096, "px")] = 160
    block_px: Annotated[int, Range(1, 99, "px")] = 3
    k: Annotated[float, Range(1e-4, 0.2499, "1")] = 0.04
    min_slope: Annotated[float, Range(1e-3, 1000, "grey levels/px")] = 2.5
    border_px: Annotated[int, Range(1, 2048, "px")] = 12

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def min_response(self) -> float:
        """OpenCV's response of a corner with `min_slope` in every direction.

        det M - k (trace M)^2 with both eigenvalues of M equal; OpenCV scales grey levels to 0..1.
        """
        eigenvalue = (_SOBEL_GAIN * self.min_slope / 255) ** 2
        return eigenvalue**2 * (1 - 4 * self.k)


def detect(image: np.ndarray, parameters: HarrisParameters) -> Float:
    """Corners (N, 2), u and v in pixels at sub-pixel precision, strongest first.

    Raises:
        ValueError: the image has another shape or type.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image: is {image.dtype} {image.shape}, expected uint8 (H, W)")
    if min(image.shape) <= 2 * parameters.border_px:
        return np.zeros((0, 2))
    side = _window_px(parameters.smoothing_px)
    smooth = cv2.GaussianBlur(image, (side, side), parameters.smoothing_px)
    response = harris_response(smooth, parameters)
    pixels = _strongest(response, parameters)
    if len(pixels) == 0:
        return np.zeros((0, 2))
    return _peak(response, pixels)


@functools.cache
def _window_px(sigma_px: float) -> int:
    """Side of the smallest window that smooths as OpenCV's own does.

    Its weights have eight bits, of which the outermost may have none: to add them up takes time.
    What becomes of one bright column shows all weights.
    """
    line = np.zeros((1, 2 * math.ceil(_PROBED_SIGMAS * sigma_px) + 1), np.uint8)
    line[0, line.shape[1] // 2] = 255
    smooth = cv2.GaussianBlur(line, (0, 0), sigma_px)
    sides = range(1, line.shape[1] + 1, 2)
    same = (np.array_equal(cv2.GaussianBlur(line, (n, n), sigma_px), smooth) for n in sides)
    return next(itertools.compress(sides, same))


def harris_response(image: np.ndarray, parameters: HarrisParameters) -> np.ndarray:
    """Response (H, W) float32: values of OpenCV's `cornerHarris`, sooner for the usual block."""
    block, aperture, k = parameters.block_px, _SOBEL_APERTURE_PX, parameters.k
    if block != _OUR_BLOCK_PX or min(image.shape) < _LEAST_SIDE_PX:
        return cv2.cornerHarris(image, block, aperture, k)
    scale = 1 / (_SOBEL_SUM * block * 255)
    slope_u = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=aperture, scale=scale)
    slope_v = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=aperture, scale=scale)
    response = np.empty(image.shape, dtype=np.float32)
    _respond(slope_u, slope_v, np.float32(k), response)
    return response


@kernel
def _respond(slope_u: np.ndarray, slope_v: np.ndarray, k: np.float32, response: np.ndarray) -> None:
    """Fill in det M - k (trace M)^2, M the sum over 3 x 3 pixels of products of slopes (H, W).

    Sums are in double precision, products and what follows in single, as OpenCV has them; beyond
    the border the image is mirrored.
    """
    height, width = slope_u.shape
    sums = np.empty((3, width + 2))
    for v in range(height):
        above, below = v - 1 if v > 0 else 1, v + 1 if v < height - 1 else height - 2
        _sum_products(slope_u, slope_v, above, v, below, sums)
        for c in range(3):
            sums[c, 0], sums[c, width + 1] = sums[c, 2], sums[c, width - 1]
        _combine(sums, k, response, v)


@kernel_part
def _sum_products(
    slope_u: np.ndarray, slope_v: np.ndarray, above: int, v: int, below: int, sums: Float
) -> None:
    """Fill in the sums (3, W + 2) of uu, uv and vv over three rows, but for the outermost."""
    for i in range(slope_u.shape[1]):
        a, b, c = slope_u[above, i], slope_u[v, i], slope_u[below, i]
        d, e, f = slope_v[above, i], slope_v[v, i], slope_v[below, i]
        k = np.uintp(i + 1)
        sums[0, k] = np.float64(a * a) + np.float64(b * b) + np.float64(c * c)
        sums[1, k] = np.float64(a * d) + np.float64(b * e) + np.float64(c * f)
        sums[2, k] = np.float64(d * d) + np.float64(e * e) + np.float64(f * f)


@kernel_part
def _combine(sums: Float, k: np.float32, response: np.ndarray, v: int) -> None:
    for i in range(response.shape[1]):
        before, here, after = np.uintp(i), np.uintp(i + 1), np.uintp(i + 2)
        a = np.float32(sums[0, before] + sums[0, here] + sums[0, after])
        b = np.float32(sums[1, before] + sums[1, here] + sums[1, after])
        c = np.float32(sums[2, before] + sums[2, here] + sums[2, after])
        trace = a + c
        response[v, i] = (a * c - b * b) - k * (trace * trace)


def _strongest(response: np.ndarray, parameters: HarrisParameters) -> np.ndarray:
    """Pixels (N, 2) int64 of the corners to keep, strongest first."""
    maxima = local_maxima(response, parameters.border_px, np.float32(parameters.min_response))
    u, v = maxima.T
    candidates = maxima[descending(response[v, u])]
    height, width = response.shape
    cells = -(-height // parameters.cell_px) * -(-width // parameters.cell_px)
    share = -(-parameters.max_corners // cells)
    return candidates[
        spread(
            candidates,
            response.shape,
            parameters.min_distance_px,
            parameters.cell_px,
            share,
            parameters.max_corners,
        )
    ]


def descending(values: np.ndarray) -> np.ndarray:
    """Rows of values (N,) float32 above zero from the highest on, equal ones in their own order.

    The bits of such numbers grow as they do. With the row behind them no two keys are the same, so
    that what sorts fastest, and leaves equals in any order, can sort them.
    """
    rows = np.arange(len(values), dtype=np.uint64)
    keys = (_ALL_BITS - values.view(np.uint32)).astype(np.uint64) << _BITS | rows
    return (np.sort(keys) & np.uint64(_ALL_BITS)).astype(np.int64)


def local_maxima(response: np.ndarray, border: int, least: np.float32) -> np.ndarray:
    """Pixels (N, 2) int64, row by row, above `least` that no neighbour's response exceeds."""
    height, width = response.shape
    found = np.empty(((height - 2 * border) * (width - 2 * border), 2), dtype=np.int64)
    # the mark of each column, and so many at once as a number has bytes
    highest, is_peak = np.empty(width, np.float32), np.zeros(-(-width // 8) * 8, np.uint8)
    marks = is_peak.view(np.uint64)
    return found[: _list_maxima(response, border, least, highest, is_peak, marks, found)]


@kernel
def _list_maxima(
    response: np.ndarray,
    border: int,
    least: np.float32,
    highest: np.ndarray,
    is_peak: np.ndarray,
    marks: np.ndarray,
    found: np.ndarray,
) -> int:
    """Fill in the first rows of `found`, and tell how many."""
    count = 0
    for v in range(border, response.shape[0] - border):
        _mark_peaks(response, v, border, least, highest, is_peak)
        for k in range(len(marks)):
            if marks[k] == 0:
                continue
            for u in range(8 * k, 8 * k + 8):
                if is_peak[u]:
                    found[count, 0], found[count, 1] = u, v
                    count += 1
    return count


@kernel_part
def _mark_peaks(
    response: np.ndarray,
    v: int,
    border: int,
    least: np.float32,
    highest: np.ndarray,
    is_peak: np.ndarray,
) -> None:
    """Mark the maxima of row v; `highest` is room for what is highest in three rows."""
    for u in range(response.shape[1]):
        a, b, c = response[v - 1, u], response[v, u], response[v + 1, u]
        most = a if a > b else b
        highest[u] = c if c > most else most
    begin = np.uintp(border)
    for i in range(response.shape[1] - 2 * border):
        u = begin + np.uintp(i)
        a, b, c = highest[u - _ONE], highest[u], highest[u + _ONE]
        most = a if a > b else b
        most = c if c > most else most
        here = response[v, u]
        is_peak[u] = np.uint8(here == most) & np.uint8(here > least)


def spread(
    candidates: np.ndarray,
    size: tuple[int, ...],
    min_distance: int,
    cell: int,
    per_cell: int,
    most: int,
) -> np.ndarray:
    """Which candidates (N, 2) of an image, sorted by strength, a greedy choice keeps (N,) bool.

    A first pass fills each cell up to its share, a second hands what poor cells left over to the
    strongest remaining. No two are nearer than `min_distance`.
    """
    taken, blocked = np.zeros(len(candidates), dtype=np.bool_), np.zeros(size, dtype=np.uint8)
    filled = np.zeros((size[0] // cell + 1, size[1] // cell + 1), dtype=np.int64)
    _choose(candidates, min_distance, cell, per_cell, most, blocked, filled, taken)
    return taken


# What kernels of this file need room for is made by their callers: that is not compiled.


@kernel
def _choose(
    candidates: np.ndarray,
    min_distance: int,
    cell: int,
    per_cell: int,
    most: int,
    blocked: np.ndarray,
    filled: np.ndarray,
    taken: np.ndarray,
) -> None:
    count, (height, width) = 0, blocked.shape
    for share in (per_cell, most):
        for n in range(len(candidates)):
            u, v = candidates[n, 0], candidates[n, 1]
            if count == most:
                return
            if taken[n] or blocked[v, u] or filled[v // cell, u // cell] >= share:
                continue
            taken[n] = True
            count += 1
            filled[v // cell, u // cell] += 1
            for y in range(max(v - min_distance + 1, 0), min(v + min_distance, height)):
                for x in range(max(u - min_distance + 1, 0), min(u + min_distance, width)):
                    if (x - u) * (x - u) + (y - v) * (y - v) < min_distance * min_distance:
                        blocked[y, x] = 1


def _peak(response: np.ndarray, pixels: np.ndarray) -> Float:
    """Sub-pixel maxima (N, 2) of the response, from the parabola through three pixels each way."""
    u, v = pixels.T
    top = response[v, u].astype(np.float64)
    offset = np.empty((len(pixels), 2))
    for axis, (du, dv) in enumerate(((1, 0), (0, 1))):
        before = response[v - dv, u - du].astype(np.float64)
        after = response[v + dv, u + du].astype(np.float64)
        curvature = before - 2 * top + after
        # a maximum lies within half a pixel; a plateau stays where it is
        offset[:, axis] = np.where(
            curvature < 0, (before - after) / np.where(curvature < 0, 2 * curvature, 1), 0
        )
    return pixels + offset
