"""Stereo matching of corners in a rectified pair: row search, then a least-squares plane fit.

1. Zero-mean normalised correlation of a square window over all disparities of the depth range,
   checked for uniqueness and by the search back from right to left.
2. Least squares after Lucas and Kanade (1981) on the grey levels, for a disparity that varies over
   the window like a plane's does, d + a x + b y. Without a and b the estimate would belong to
   wherever the window's texture lies and not to the corner. A prior keeps them to what a wall at
   some distance can show. Variance of d: inverse normal matrix times the residuals' variance, of
   which more counts as what exceeds the sensor's noise.
3. Each half of a larger window (left, right, upper, lower) must agree with that plane, or the
   corner sits on a silhouette, where two surfaces meet in the image and nothing in the world.
4. Nor must a larger window show that the disparity steps, breaks or bends (`plane_test.py`): where
   wall and floor meet or another surface begins beside, the plane lies off in every picture alike.
   Of a surface beside, the window of the fit may hold a strip that biases the plane and is too
   narrow to be told from noise.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np

from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float, chi_square_bound, kernel
from mapfusion.parameters import (
    Range,
    require_at_least,
    require_finite,
    require_in_range,
    require_shape,
)
from mapfusion.vision.disparity_tests import FURTHER_TERMS, fails_silhouette_test, window_statistics
from mapfusion.vision.subpixel import MOST_HALF_PX, fit_planes


class MatchStatus(IntEnum):
    """MATCHED, or why not."""

    MATCHED = 0
    OUTSIDE = 1  # a window leaves an image, or no disparity of the range keeps it inside
    FLAT = 2  # no texture
    WEAK = 3  # nothing in the row correlates
    AMBIGUOUS = 4  # a second place in the row correlates nearly as well
    ONE_SIDED = 5  # the search back from the right image ends elsewhere
    DIVERGED = 6  # the refinement left the pixel that the search had found
    SILHOUETTE = 7  # half of the surroundings lie on another surface
    BENT = 8  # the surroundings show more than one plane, or a surface that is none


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
            verdict[n] = MatchStatus.OUTSIDE
            continue
        found, verdict[n] = _search_row(
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
        if verdict[n] != MatchStatus.MATCHED:
            continue
        back_first, back_last = found + min_disparity, min(found + max_disparity, width - half - 1)
        back, _ = _search_row(
            right, left, found, v, back_first, back_last, half, -1.0, 1.0, scores, strip, room
        )
        if abs(back - u) > max_round_trip:
            verdict[n] = MatchStatus.ONE_SIDED
            continue
        disparity[n] = u - found


@kernel
def _search_row(
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
        return u, MatchStatus.OUTSIDE
    if not _correlate(image, other, u, v, first, last, half, scores, strip, room):
        return u, MatchStatus.FLAT
    best = 0
    for k in range(1, last - first + 1):
        if scores[k] > scores[best]:
            best = k
    if scores[best] < min_correlation:
        return first + best, MatchStatus.WEAK
    rival = -1.0
    for k in range(last - first + 1):
        if abs(k - best) > _PEAK_HALF_WIDTH_PX and scores[k] > rival:
            rival = scores[k]
    if 1 - scores[best] >= max_ambiguity * (1 - rival):
        return first + best, MatchStatus.AMBIGUOUS
    return first + best, MatchStatus.MATCHED


@kernel
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
    count = padded + 2 * half
    for i in range(len(room)):
        for k in range(count):
            room[i, k] = 0
    total, total_square = np.int64(0), np.int64(0)
    for y in range(v - half, v + half + 1):
        # Copy part of a row, and add it to the columns' sums and sums of squares.
        begin = first - half
        wide = candidates + 2 * half
        at = np.uintp(begin)
        for k in range(wide):
            grey = other[y, at + np.uintp(k)]
            strip[k] = grey
            room[_SUM, k] += np.int32(grey)
            room[_SQUARE, k] += np.int32(grey) * np.int32(grey)
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


@kernel
def _add_up(image: np.ndarray, y: int, begin: int, count: int) -> tuple[np.int32, np.int32]:
    """Sum and sum of squares of part of a row."""
    total, total_square, at = np.int32(0), np.int32(0), np.uintp(begin)
    for k in range(count):
        grey = np.int32(image[y, at + np.uintp(k)])
        total = np.int32(total + grey)
        total_square = np.int32(total_square + grey * grey)
    return total, total_square


@kernel
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


_MAX_HALF_PX = 90  # (2 * 90 + 1)^2 squared grey levels still fit a 32-bit sum


@dataclass(frozen=True)
class StereoParameters:
    """How corners are matched.

    Attributes:
        min_depth_m, max_depth_m: range of the search.
        half_px: half side of the window of search and refinement.
        min_correlation: weakest correlation that counts as a match.
        max_ambiguity: a match needs 1 - correlation below this share of its best rival's.
        max_round_trip_px: allowed difference between the search there and the search back.
        max_jump_px: how far the refinement may move from the search's whole pixel.
        nearest_plane_m: distance h of the optical centre from the nearest plane that is to be
            matched well: the floor's, below the camera. Disparity slopes by at most B / h on it:
            the standard deviation of the prior on a and b.
        noise_grey: noise of one image, grey levels; what residuals are held against.
        silhouette_half_px: half side of the window of the silhouette test.
        max_misfit_px: a half window may differ from the plane by noise and by what this error in
            disparity would explain,
        max_rows_px: and by what rows that are so far off would.
        plane_half_px: half side of the window of the test for one plane: where walls are planes, as
            simulated ones are, a larger one than the fit's.
        plane_probability: of windows of one plane, the share that is to pass the test for further
            terms of the disparity,
        plane_misfit_px: where noise, rows as above and this deviation of disparities from a plane
            are taken for white.
        row_sigma_px: standard deviation of the rows by which the two images are off; 0 of a pair
            that is rectified exactly, as simulated ones are. It adds to that of disparities.
        residual_correlation_px: what residuals hold beyond noise (staircase edges, a surface that
            is no plane) is alike over so many pixels each way: that many squared count as one.
        sigma_floor_px: error that stays however much texture there is. With this and the one before
            errors against rendered depth are as stated where a filter has drawn.
    """

    min_depth_m: Annotated[float, Range(0.01, 100, "m")] = 0.5
    max_depth_m: Annotated[float, Range(0.02, 1000, "m")] = 20.0
    half_px: Annotated[int, Range(2, _MAX_HALF_PX, "px")] = 8
    min_correlation: Annotated[float, Range(1e-3, 1, "1")] = 0.8
    max_ambiguity: Annotated[float, Range(1e-3, 1, "1")] = 0.7
    max_round_trip_px: Annotated[int, Range(0, 100, "px")] = 1
    max_jump_px: Annotated[float, Range(0.01, 100, "px")] = 1.5
    nearest_plane_m: Annotated[float, Range(0.01, 1000, "m")] = 0.45
    noise_grey: Annotated[float, Range(0, 255, "grey levels")] = 2.0
    silhouette_half_px: Annotated[int, Range(2, MOST_HALF_PX, "px")] = 12
    max_misfit_px: Annotated[float, Range(1e-3, 100, "px")] = 1.0
    max_rows_px: Annotated[float, Range(0, 100, "px")] = 0.0
    plane_half_px: Annotated[int, Range(2, MOST_HALF_PX, "px")] = 12
    plane_probability: Annotated[float, Range(0, 1, "1")] = 0.999
    plane_misfit_px: Annotated[float, Range(0, 100, "px")] = 0.2
    row_sigma_px: Annotated[float, Range(0, 100, "px")] = 0.0
    residual_correlation_px: Annotated[float, Range(0, 100, "px")] = 6.0
    sigma_floor_px: Annotated[float, Range(0, 100, "px")] = 0.01

    def __post_init__(self) -> None:
        require_in_range(self)
        require_at_least(self.min_depth_m, self, "max_depth_m")
        require_at_least(self.half_px, self, "silhouette_half_px")
        require_at_least(self.half_px, self, "plane_half_px")


@dataclass(frozen=True)
class StereoMatches:
    """What became of each corner.

    Attributes:
        disparity_px: (N,) NaN where the verdict is not MATCHED.
        sigma_px: (N,) standard deviation of the disparity, likewise.
        slope: (N, 2) change of the disparity along u and v, likewise.
        verdict: (N,) int8, MATCHED or the reason against it.
    """

    disparity_px: Float
    sigma_px: Float
    slope: Float
    verdict: np.ndarray


def match(
    left: np.ndarray,
    right: np.ndarray,
    uv_px: Float,
    camera: StereoCamera,
    parameters: StereoParameters,
) -> StereoMatches:
    """Match corners (N, 2) of the left image along their rows in the right one.

    Args:
        left: (H, W) uint8, rectified: a point has the same row in both images.
        right: likewise.
        uv_px: (N, 2) corners of the left image.
        camera: focal length and baseline turn depths into disparities.
        parameters: see there.

    Raises:
        ValueError: wrong shape, type or value; names the argument.
    """
    for name, image in (("left", left), ("right", right)):
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"{name}: is {image.dtype} {image.shape}, expected uint8 (H, W)")
    if left.shape != right.shape:
        raise ValueError(f"right: shape is {right.shape}, expected that of left, {left.shape}")
    uv = np.ascontiguousarray(uv_px, dtype=np.float64)
    require_shape("uv_px", uv, (None, 2))
    require_finite("uv_px", uv)
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    pixel = np.rint(uv).astype(np.int64)
    found, verdict = _search(left, right, pixel, camera, parameters)
    disparity, sigma = np.full(len(uv), np.nan), np.full(len(uv), np.nan)
    slope = np.full((len(uv), 2), np.nan)

    rows = np.nonzero(verdict == MatchStatus.MATCHED)[0]
    plane, disparity[rows], sigma[rows] = _refine(
        left, right, pixel[rows], uv[rows], found[rows], camera, parameters
    )
    jump = np.abs(plane[:, 0] - found[rows])
    lost = ~((jump <= parameters.max_jump_px) & (disparity[rows] > 0))
    verdict[rows[lost]] = MatchStatus.DIVERGED

    rows, plane = rows[~lost], plane[~lost]
    slope[rows] = plane[:, 1:]
    half = (parameters.silhouette_half_px, parameters.plane_half_px)
    squares, scores = window_statistics(left, right, pixel[rows], plane, *half)
    tolerated = (parameters.noise_grey, parameters.max_misfit_px, parameters.max_rows_px)
    verdict[rows[_bent(scores, parameters)]] = MatchStatus.BENT
    verdict[rows[fails_silhouette_test(squares, *tolerated)]] = MatchStatus.SILHOUETTE

    unmatched = verdict != MatchStatus.MATCHED
    disparity[unmatched] = sigma[unmatched] = slope[unmatched] = np.nan
    return StereoMatches(disparity, sigma, slope, verdict)


def _search(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    camera: StereoCamera,
    parameters: StereoParameters,
) -> tuple[np.ndarray, np.ndarray]:
    reach = camera.focal_px * camera.baseline_m
    return search_rows(
        left,
        right,
        pixel,
        int(np.floor(reach / parameters.max_depth_m)),
        int(np.ceil(reach / parameters.min_depth_m)),
        parameters.half_px,
        parameters.min_correlation,
        parameters.max_ambiguity,
        parameters.max_round_trip_px,
    )


def _refine(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    uv: Float,
    found: np.ndarray,
    camera: StereoCamera,
    parameters: StereoParameters,
) -> tuple[Float, Float, Float]:
    """Planes (N, 3), and disparities and standard deviations (N,) at the corners themselves."""
    offset = uv - pixel
    plane, variance = fit_planes(
        left,
        right,
        pixel,
        offset,
        found.astype(np.float64),
        parameters.half_px,
        camera.baseline_m / parameters.nearest_plane_m,
        parameters.noise_grey,
        parameters.residual_correlation_px,
        parameters.row_sigma_px,
    )
    disparity = plane[:, 0] + np.sum(plane[:, 1:] * offset, -1)
    return plane, disparity, np.sqrt(variance + parameters.sigma_floor_px**2)


def _bent(scores: Float, parameters: StereoParameters) -> np.ndarray:
    """Whether windows with scores (N, 3) show more than one plane or a bent surface (N,) bool.

    The score of noise is chi-square times its variance: 2 n^2, and what a deviation from the plane
    and rows that are off add to it, by the slopes of the grey levels.
    """
    beyond = scores[:, 1:] @ [parameters.plane_misfit_px**2, parameters.max_rows_px**2]
    bound = chi_square_bound(parameters.plane_probability, FURTHER_TERMS)
    return scores[:, 0] > bound * (2 * parameters.noise_grey**2 + beyond)
