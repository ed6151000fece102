"""Disparity of corners in a rectified pair: search along the row, then least squares for a plane.

1. Zero-mean normalised correlation of a square window over all disparities of the depth range,
   checked for uniqueness and by the search back from right to left.
2. Least squares after Lucas and Kanade (1981) on the grey levels, for a disparity that varies over
   the window like a plane's does, d + a x + b y. Without a and b the estimate would belong to
   wherever the window's texture lies and not to the corner. A prior keeps them to what a wall at
   some distance can show. Variance of d: inverse normal matrix times the residuals' variance.
3. Each half of a larger window (left, right, upper, lower) must agree with that plane, or the
   corner sits on a silhouette, where two surfaces meet in the image and nothing in the world.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from mapfusion.arguments import require_finite, require_shape
from mapfusion.camera import StereoCamera
from mapfusion.se2 import Float

MATCHED = 0
OUTSIDE = 1  # the window leaves an image, or no disparity of the range keeps it inside
FLAT = 2  # no texture along the row
WEAK = 3  # nothing in the row correlates
AMBIGUOUS = 4  # a second place in the row correlates nearly as well
ONE_SIDED = 5  # the search back from the right image ends elsewhere
DIVERGED = 6  # the refinement left the search's pixel
SILHOUETTE = 7  # half of the surroundings lie on another surface

_MAX_STEPS = 8
_CONVERGED_PX = 0.005  # a tenth of the best precision that noise allows
_PEAK_HALF_WIDTH_PX = 2  # rivals are looked for beyond the slopes of the best peak


@dataclass(frozen=True)
class StereoParameters:
    """How corners are matched.

    Attributes:
        min_depth_m, max_depth_m: range of the search.
        half_px: half side of the window of search and refinement.
        min_correlation: weakest correlation that counts as a match.
        max_ambiguity: a match needs 1 - correlation at most this share of its best rival's.
        max_round_trip_px: allowed difference between the search there and the search back.
        max_jump_px: how far the refinement may move from the search's whole pixel.
        nearest_plane_m: distance h of the optical centre from the nearest plane that is to be
            matched well. Disparity slopes by at most B / h on it: the standard deviation of the
            prior on a and b.
        noise_grey: noise of one image, grey levels; what residuals are held against.
        silhouette_half_px: half side of the window of the silhouette test.
        max_misfit_px: a half window may differ from the plane by noise and by what this error in
            disparity would explain.
        residual_correlation_px: residuals are alike over so many pixels each way (staircase edges,
            texture seen through a lens), so that many squared count as one.
        sigma_floor_px: error that stays however much texture there is.
    """

    min_depth_m: float = 0.5
    max_depth_m: float = 20.0
    half_px: int = 8
    min_correlation: float = 0.8
    max_ambiguity: float = 0.7
    max_round_trip_px: int = 1
    max_jump_px: float = 1.5
    nearest_plane_m: float = 1.0
    noise_grey: float = 2.0
    silhouette_half_px: int = 12
    max_misfit_px: float = 1.0
    residual_correlation_px: float = 3.0
    sigma_floor_px: float = 0.1

    def __post_init__(self) -> None:
        for name in ("min_depth_m", "nearest_plane_m", "max_jump_px", "max_misfit_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: must be positive")
        for name in (
            "noise_grey",
            "residual_correlation_px",
            "sigma_floor_px",
            "max_round_trip_px",
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: must not be negative")
        for name in ("min_correlation", "max_ambiguity"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name}: must lie in (0, 1]")
        if self.max_depth_m <= self.min_depth_m:
            raise ValueError("max_depth_m: must exceed min_depth_m")
        if self.half_px < 2:
            raise ValueError("half_px: must be at least 2")
        if self.silhouette_half_px < self.half_px:
            raise ValueError("silhouette_half_px: must be at least half_px")


@dataclass(frozen=True)
class StereoMatches:
    """What became of each corner.

    Attributes:
        disparity_px: (N,) NaN where the verdict is not MATCHED.
        sigma_px: (N,) standard deviation of the disparity, likewise.
        verdict: (N,) int8, MATCHED or the reason against it.
    """

    disparity_px: Float
    sigma_px: Float
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
    reach = camera.focal_px * camera.baseline_m
    disparity, sigma = np.empty(len(uv)), np.empty(len(uv))
    verdict = np.empty(len(uv), dtype=np.int8)
    _match(
        np.ascontiguousarray(left),
        np.ascontiguousarray(right),
        uv,
        int(np.floor(reach / parameters.max_depth_m)),
        int(np.ceil(reach / parameters.min_depth_m)),
        parameters.half_px,
        parameters.min_correlation,
        parameters.max_ambiguity,
        parameters.max_round_trip_px,
        parameters.max_jump_px,
        camera.baseline_m / parameters.nearest_plane_m,
        parameters.noise_grey,
        parameters.silhouette_half_px,
        parameters.max_misfit_px,
        parameters.residual_correlation_px,
        parameters.sigma_floor_px,
        disparity,
        sigma,
        verdict,
    )
    return StereoMatches(disparity, sigma, verdict)


@njit(cache=True)
def _match(
    left: np.ndarray,
    right: np.ndarray,
    uv: np.ndarray,
    min_disparity: int,
    max_disparity: int,
    half: int,
    min_correlation: float,
    max_ambiguity: float,
    max_round_trip: int,
    max_jump: float,
    slope_sigma: float,
    noise: float,
    silhouette_half: int,
    max_misfit: float,
    residual_correlation: float,
    sigma_floor: float,
    disparity: np.ndarray,
    sigma: np.ndarray,
    verdict: np.ndarray,
) -> None:
    height, width = left.shape
    scores = np.empty(width)
    plane = np.empty(3)
    for n in range(len(uv)):
        disparity[n] = np.nan
        sigma[n] = np.nan
        u, v = int(np.rint(uv[n, 0])), int(np.rint(uv[n, 1]))
        inside_left = half < u < width - half - 1 and half <= v < height - half
        first, last = max(u - max_disparity, half), u - min_disparity
        if not inside_left or first > last:
            verdict[n] = OUTSIDE
            continue
        found, verdict[n] = _search(
            left, right, u, v, first, last, half, min_correlation, max_ambiguity, scores
        )
        if verdict[n] != MATCHED:
            continue
        back_first, back_last = found + min_disparity, min(found + max_disparity, width - half - 1)
        back, _ = _search(right, left, found, v, back_first, back_last, half, 0.0, 1.0, scores)
        if abs(back - u) > max_round_trip:
            verdict[n] = ONE_SIDED
            continue
        plane[0], plane[1], plane[2] = u - found, 0.0, 0.0
        variance = _fit_plane(
            left, right, u, v, half, slope_sigma, noise, uv[n, 0] - u, uv[n, 1] - v, plane
        )
        if not abs(plane[0] - (u - found)) <= max_jump or plane[0] <= 0:
            verdict[n] = DIVERGED
            continue
        if _is_silhouette(left, right, u, v, silhouette_half, noise, max_misfit, plane):
            verdict[n] = SILHOUETTE
            continue
        disparity[n] = plane[0] + plane[1] * (uv[n, 0] - u) + plane[2] * (uv[n, 1] - v)
        sigma[n] = np.sqrt(variance * residual_correlation**2 + sigma_floor**2)


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
        return u, OUTSIDE
    if not _correlate(image, other, u, v, first, last, half, scores):
        return u, FLAT
    best = 0
    for k in range(1, last - first + 1):
        if scores[k] > scores[best]:
            best = k
    if scores[best] < min_correlation:
        return first + best, WEAK
    rival = -1.0
    for k in range(last - first + 1):
        if abs(k - best) > _PEAK_HALF_WIDTH_PX and scores[k] > rival:
            rival = scores[k]
    if 1 - scores[best] > max_ambiguity * (1 - rival):
        return first + best, AMBIGUOUS
    return first + best, MATCHED


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


@njit(cache=True)
def _grey(image: np.ndarray, x: float, y: int) -> float:
    """Grey level between columns by the cubic of Catmull and Rom, for 1 <= x < width - 2."""
    k = int(x)
    t = x - k
    p0, p1 = float(image[y, k - 1]), float(image[y, k])
    p2, p3 = float(image[y, k + 1]), float(image[y, k + 2])
    return p1 + 0.5 * t * (
        p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0))
    )


@njit(cache=True)
def _fit_plane(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    slope_sigma: float,
    noise: float,
    du: float,
    dv: float,
    plane: np.ndarray,
) -> float:
    """Move `plane` (disparity at (u, v), slope along u, slope along v) to the least squares.

    Unknowns: offset in brightness, disparity, two slopes. The derivatives are those of the left
    image, so the normal matrix is built once (Baker and Matthews 2004, inverse composition).
    Returns the variance of the disparity at the corner (u + du, v + dv); `plane` becomes NaN when
    the texture does not determine it or the fit leaves the image.
    """
    count = (2 * half + 1) ** 2
    normal = np.zeros((4, 4))
    row = np.empty(4)
    for y in range(v - half, v + half + 1):
        for x in range(-half, half + 1):
            slope = 0.5 * (float(left[y, u + x + 1]) - float(left[y, u + x - 1]))
            row[0], row[1], row[2], row[3] = 1.0, slope, slope * x, slope * (y - v)
            for i in range(4):
                for j in range(i + 1):
                    normal[i, j] += row[i] * row[j]
    factor = np.empty((4, 4))
    step = np.empty(4)
    variance_grey = 2 * noise**2
    for _ in range(_MAX_STEPS):
        first = u - half - plane[0] + plane[1] * half
        last = u + half - plane[0] - plane[1] * half
        lean = abs(plane[2]) * half
        if not (first - lean >= 1 and last + lean < right.shape[1] - 2 and first < last):
            plane[:] = np.nan
            return np.nan
        square = _residuals(left, right, u, v, half, plane, step)
        prior = variance_grey / slope_sigma**2
        factor[:] = normal
        factor[2, 2] += prior
        factor[3, 3] += prior
        step[2] -= prior * plane[1]
        step[3] -= prior * plane[2]
        if not _cholesky(factor):
            plane[:] = np.nan
            return np.nan
        _solve(factor, step)
        plane += step[1:]
        variance_grey = max(square - count * step[0] ** 2, 0.0) / (count - 4)
        if abs(step[1]) < _CONVERGED_PX:
            break
    row[0], row[1], row[2], row[3] = 0.0, 1.0, du, dv
    step[:] = row
    _solve(factor, step)
    return variance_grey * (step[1] + du * step[2] + dv * step[3])


@njit(cache=True)
def _residuals(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    plane: np.ndarray,
    moment: np.ndarray,
) -> float:
    """Sum of the squared differences right - left under `plane`; `moment` gets J^T r."""
    square = 0.0
    moment[:] = 0.0
    for y in range(-half, half + 1):
        start = u - plane[0] - plane[2] * y
        for x in range(-half, half + 1):
            residual = _grey(right, start + x - plane[1] * x, v + y) - float(left[v + y, u + x])
            slope = 0.5 * (float(left[v + y, u + x + 1]) - float(left[v + y, u + x - 1]))
            square += residual * residual
            moment[0] += residual
            moment[1] += slope * residual
            moment[2] += slope * x * residual
            moment[3] += slope * y * residual
    return square


@njit(cache=True)
def _cholesky(matrix: np.ndarray) -> bool:
    """Lower factor of a symmetric matrix in place; False when it is not positive definite."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total / matrix[j, j]
            elif total > 1e-9 * matrix[i, i]:
                matrix[i, i] = np.sqrt(total)
            else:
                return False
    return True


@njit(cache=True)
def _solve(factor: np.ndarray, x: np.ndarray) -> None:
    """Solve with the lower factor in place."""
    for i in range(len(x)):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(len(x) - 1, -1, -1):
        for k in range(i + 1, len(x)):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]


@njit(cache=True)
def _is_silhouette(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    noise: float,
    max_misfit: float,
    plane: np.ndarray,
) -> bool:
    """Whether one of the four half windows disagrees with the plane.

    A half agrees when sum r^2 <= n 2 noise^2 + max_misfit^2 sum g^2: an error e in disparity
    changes the grey level by g e.
    """
    height, width = left.shape
    # rows: left, right, upper, lower; columns: n, sum r, sum r^2, sum g^2
    sums = np.zeros((4, 4))
    for y in range(max(-half, -v), min(half, height - 1 - v) + 1):
        for x in range(max(-half, 1 - u), min(half, width - 2 - u) + 1):
            at = u + x - plane[0] - plane[1] * x - plane[2] * y
            if not 1 <= at < width - 2:
                continue
            residual = _grey(right, at, v + y) - float(left[v + y, u + x])
            slope = 0.5 * (float(left[v + y, u + x + 1]) - float(left[v + y, u + x - 1]))
            for k in range(4):
                if (x < 0, x > 0, y < 0, y > 0)[k]:
                    sums[k, 0] += 1
                    sums[k, 1] += residual
                    sums[k, 2] += residual * residual
                    sums[k, 3] += slope * slope
    total = sums[2] + sums[3]
    for k in range(4):
        n, square, slope_square = sums[k, 0], sums[k, 2], sums[k, 3]
        offset = total[1] / total[0] if total[0] > 0 else 0.0
        centred = square - 2 * offset * sums[k, 1] + n * offset * offset
        if centred > n * 2 * noise**2 + max_misfit**2 * slope_square:
            return True
    return False
