"""Stereo matching of corners in a rectified pair: row search, then a least-squares plane fit.

1. Zero-mean normalised correlation of a square window over all disparities of the depth range,
   checked for uniqueness and by the search back from right to left.
2. Least-squares fit of grey levels (Lucas and Kanade 1981) for the disparity of a plane,
   d + a x + b y. Without a and b the estimate would be the mean over the window's texture and not
   the disparity at the corner. A prior limits a and b to the slopes of a wall at some distance.
   The variance of d is the inverse normal matrix times the variance of the residuals. The part of
   the residuals above the sensor noise is correlated and has a larger weight.
3. Silhouette test: each half of a larger window (left, right, upper, lower) must agree with the
   plane. At a silhouette two surfaces meet in the image but not in the world.
4. Plane test: a larger window must show no step, crease or curvature of the disparity
   (`disparity_tests.py`). Where wall and floor meet, or beside another surface, the fitted plane
   has the same bias in every image. A narrow strip of another surface in the fit's window biases
   the plane, but looks like noise there.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.geometry.numerics import (
    Float,
    chi_square_bound,
    kernel,
    require_finite,
    require_shape,
)
from mapfusion.parameters import Range, require_at_least, require_in_range
from mapfusion.vision.disparity_tests import FURTHER_TERMS, fails_silhouette_test, window_statistics
from mapfusion.vision.subpixel import MOST_HALF_PX, fit_planes


class MatchStatus(IntEnum):
    """MATCHED, or the reason of the rejection."""

    MATCHED = 0
    OUTSIDE = 1  # the window leaves an image at all disparities of the range
    FLAT = 2  # no texture
    WEAK = 3  # low correlation along the whole row
    AMBIGUOUS = 4  # a second column correlates nearly as well
    ONE_SIDED = 5  # the search back from the right image ends at another column
    DIVERGED = 6  # the refinement left the pixel of the search
    SILHOUETTE = 7  # half of the window lies on another surface
    BENT = 8  # the window shows more than one plane, or a curved surface
    MISSING = 9  # a depth image has too few depths in the window


_PEAK_HALF_WIDTH_PX = 2  # the search for a second peak leaves out the slopes of the best one
# Rows of the work array: sums of products per candidate, sums of grey levels and of their squares
# per column.
_CROSS, _SUM, _SQUARE = range(3)
_VECTOR_LENGTH = 8  # candidates are padded to whole vectors of the processor


@kernel
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
    """Search each window of the left image along its row in the right image, and back.

    Args:
        left: shape (H, W) uint8.
        right: shape (H, W) uint8.
        pixel: centres (u, v) of the windows, shape (N, 2) int64. Windows with less than one column
            to spare are OUTSIDE.
        min_disparity: lower end of the search range, pixels.
        max_disparity: upper end of the search range, pixels.
        half: half side of the window, pixels.
        min_correlation: smallest correlation of a match.
        max_ambiguity: largest ratio of 1 - correlation of the best and of the second peak.
        max_round_trip: largest distance between the start and the end of the search back, pixels.

    Returns:
        Disparities, shape (N,), valid for MATCHED windows, and `MatchStatus` values, shape (N,)
        int8.
    """
    height, width = left.shape
    disparity, status = np.zeros(len(pixel), np.int64), np.empty(len(pixel), np.int8)
    # Work arrays.
    scores, strip = np.empty(width), np.zeros(width + _VECTOR_LENGTH, np.uint8)
    sums = np.zeros((3, width + _VECTOR_LENGTH), np.int32)
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        first, last = max(u - max_disparity, half), u - min_disparity
        inside = half < u < width - half - 1 and half <= v < height - half
        if not inside or first > last:
            status[n] = MatchStatus.OUTSIDE
            continue
        limits = min_correlation, max_ambiguity
        found, status[n] = _search_row(
            left, right, u, v, first, last, half, limits, scores, strip, sums
        )
        if status[n] != MatchStatus.MATCHED:
            continue
        back_first, back_last = found + min_disparity, min(found + max_disparity, width - half - 1)
        back, _ = _search_row(
            right, left, found, v, back_first, back_last, half, (-1.0, 1.0), scores, strip, sums
        )
        if abs(back - u) > max_round_trip:
            status[n] = MatchStatus.ONE_SIDED
            continue
        disparity[n] = u - found
    return disparity, status


@kernel
def _search_row(
    image: np.ndarray,
    other: np.ndarray,
    u: int,
    v: int,
    first: int,
    last: int,
    half: int,
    limits: tuple[float, float],
    scores: np.ndarray,
    strip: np.ndarray,
    sums: np.ndarray,
) -> tuple[int, int]:
    """Return the column first..last of `other` that is most like (u, v) of `image`, and a status.

    Integer arithmetic and an inner loop over the candidates let the compiler vectorise. `limits`
    are the smallest correlation and the largest ambiguity of a match. The last three arguments are
    work arrays.
    """
    min_correlation, max_ambiguity = limits
    if last < first:
        return u, MatchStatus.OUTSIDE
    side = 2 * half + 1
    area, candidates = side * side, last - first + 1
    padded = -(-candidates // _VECTOR_LENGTH) * _VECTOR_LENGTH
    count = padded + 2 * half
    for i in range(len(sums)):
        for k in range(count):
            sums[i, k] = 0
    begin, other_begin = u - half, first - half
    total, total_square = np.int64(0), np.int64(0)
    for y in range(v - half, v + half + 1):
        # Copy part of the other row; add it to the sums and sums of squares of the columns.
        at = np.uintp(other_begin)
        for k in range(candidates + 2 * half):
            grey = other[y, at + np.uintp(k)]
            strip[k] = grey
            sums[_SUM, k] += np.int32(grey)
            sums[_SQUARE, k] += np.int32(grey) * np.int32(grey)
        # Add the products of the window's row and the strip, for each candidate. The row has an
        # odd length: its first column, then two columns at once, which halves memory access.
        here = np.int32(image[y, begin])
        for k in range(padded):
            sums[_CROSS, k] += here * np.int32(strip[k])
        for j in range(1, 2 * half, 2):
            here, after = np.int32(image[y, begin + j]), np.int32(image[y, begin + j + 1])
            left_column, right_column = np.uintp(j), np.uintp(j + 1)
            for k in range(padded):
                products = here * np.int32(strip[left_column + np.uintp(k)])
                sums[_CROSS, k] += products + after * np.int32(strip[right_column + np.uintp(k)])
        # Add the window's row to its sum and sum of squares.
        row_total, row_square, at = np.int32(0), np.int32(0), np.uintp(begin)
        for k in range(side):
            level = np.int32(image[y, at + np.uintp(k)])
            row_total = np.int32(row_total + level)
            row_square = np.int32(row_square + level * level)
        total += row_total
        total_square += row_square
    spread = area * total_square - total * total
    if spread == 0:
        return u, MatchStatus.FLAT

    # Correlation of each candidate by running sums over the columns.
    strip_total, strip_square = np.int64(0), np.int64(0)
    for k in range(side - 1):
        strip_total += sums[_SUM, k]
        strip_square += sums[_SQUARE, k]
    for k in range(candidates):
        strip_total += sums[_SUM, k + side - 1]
        strip_square += sums[_SQUARE, k + side - 1]
        strip_spread = area * strip_square - strip_total * strip_total
        covariance = area * np.int64(sums[_CROSS, k]) - total * strip_total
        scores[k] = (
            covariance / np.sqrt(float(spread) * float(strip_spread)) if strip_spread > 0 else -1.0
        )
        strip_total -= sums[_SUM, k]
        strip_square -= sums[_SQUARE, k]

    # Best candidate and second peak.
    best = 0
    for k in range(1, candidates):
        if scores[k] > scores[best]:
            best = k
    if scores[best] < min_correlation:
        return first + best, MatchStatus.WEAK
    rival = -1.0
    for k in range(candidates):
        if abs(k - best) > _PEAK_HALF_WIDTH_PX and scores[k] > rival:
            rival = scores[k]
    if 1 - scores[best] >= max_ambiguity * (1 - rival):
        return first + best, MatchStatus.AMBIGUOUS
    return first + best, MatchStatus.MATCHED


_MAX_HALF_PX = 90  # (2 * 90 + 1)^2 squared grey levels still fit a 32-bit sum


@dataclass(frozen=True)
class StereoParameters:
    """Parameters of stereo matching.

    Attributes:
        min_depth_m, max_depth_m: range of the search.
        half_px: half side of the window of search and refinement.
        min_correlation: smallest correlation of a match.
        max_ambiguity: largest ratio of 1 - correlation of a match and of its second peak.
        max_round_trip_px: largest distance between the search and the search back.
        max_jump_px: largest distance between the refined disparity and the result of the search.
        nearest_plane_m: distance h of the optical centre from the nearest plane: the floor below
            the camera. The slope of the disparity on the plane is at most B / h, which is the
            standard deviation of the prior on a and b.
        noise_grey: standard deviation of the noise of one image, grey levels.
        silhouette_half_px: half side of the window of the silhouette test.
        max_misfit_px: error of the disparity that the silhouette test tolerates besides noise.
        max_rows_px: error of the rows that the silhouette test tolerates besides noise.
        plane_half_px: half side of the window of the plane test. A larger window than the fit's
            suits worlds of large planes, such as simulated ones.
        plane_probability: share of the windows on one plane that pass the plane test.
        plane_misfit_px: deviation of the disparities from a plane that the plane test treats as
            white noise, as it treats noise and `max_rows_px`.
        row_sigma_px: standard deviation of the row error of the rectification, 0 if exact. It adds
            to the standard deviation of the disparity.
        residual_correlation_px: correlation length c of the residuals beyond noise (aliased edges,
            curved surfaces); c x c pixels count as one.
        sigma_floor_px: standard deviation of the disparity error for unlimited texture.
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
    """Result of stereo matching for N corners.

    Attributes:
        disparity_px: shape (N,), NaN where the status is not MATCHED.
        sigma_px: standard deviation of the disparity, shape (N,), NaN likewise.
        slope: change of the disparity along u and v, shape (N, 2), NaN likewise.
        status: `MatchStatus` values, shape (N,) int8.
    """

    disparity_px: Float
    sigma_px: Float
    slope: Float
    status: np.ndarray


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
        camera: focal length and baseline convert depths to disparities.
        parameters: parameters of search, fit and tests.

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

    # Search to whole pixels.
    focal_baseline = camera.focal_px * camera.baseline_m
    found, status = search_rows(
        left,
        right,
        pixel,
        int(np.floor(focal_baseline / parameters.max_depth_m)),
        int(np.ceil(focal_baseline / parameters.min_depth_m)),
        parameters.half_px,
        parameters.min_correlation,
        parameters.max_ambiguity,
        parameters.max_round_trip_px,
    )
    disparity, sigma = np.full(len(uv), np.nan), np.full(len(uv), np.nan)
    slope = np.full((len(uv), 2), np.nan)

    # Fit a plane to each match; its disparity and variance at the corner are the result.
    rows = np.nonzero(status == MatchStatus.MATCHED)[0]
    offset = uv[rows] - pixel[rows]
    plane, variance = fit_planes(
        left,
        right,
        pixel[rows],
        offset,
        found[rows].astype(np.float64),
        parameters.half_px,
        camera.baseline_m / parameters.nearest_plane_m,
        parameters.noise_grey,
        parameters.residual_correlation_px,
        parameters.row_sigma_px,
    )
    disparity[rows] = plane[:, 0] + np.sum(plane[:, 1:] * offset, -1)
    sigma[rows] = np.sqrt(variance + parameters.sigma_floor_px**2)
    jump = np.abs(plane[:, 0] - found[rows])
    diverged = ~((jump <= parameters.max_jump_px) & (disparity[rows] > 0))
    status[rows[diverged]] = MatchStatus.DIVERGED

    # Plane test: the score of one plane is chi-square times the variance of the residuals: 2 n^2
    # by noise, plus the tolerated errors of disparities and rows times the slopes of grey levels.
    rows, plane = rows[~diverged], plane[~diverged]
    slope[rows] = plane[:, 1:]
    half = (parameters.silhouette_half_px, parameters.plane_half_px)
    squares, scores = window_statistics(left, right, pixel[rows], plane, *half)
    tolerated = scores[:, 1:] @ [parameters.plane_misfit_px**2, parameters.max_rows_px**2]
    bound = chi_square_bound(parameters.plane_probability, FURTHER_TERMS)
    is_bent = scores[:, 0] > bound * (2 * parameters.noise_grey**2 + tolerated)
    status[rows[is_bent]] = MatchStatus.BENT
    limits = (parameters.noise_grey, parameters.max_misfit_px, parameters.max_rows_px)
    status[rows[fails_silhouette_test(squares, *limits)]] = MatchStatus.SILHOUETTE

    unmatched = status != MatchStatus.MATCHED
    disparity[unmatched] = sigma[unmatched] = slope[unmatched] = np.nan
    return StereoMatches(disparity, sigma, slope, status)
