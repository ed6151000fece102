"""Noise between the images of a stereo pair, and a check that the pair is rectified.

In a window on one surface the residuals of the fitted plane have the mean square
2 n^2 + m^2 g^2 + f^2 h^2. Here g^2 and h^2 are the mean squared slopes of the grey levels along u
and v, n is the noise of one image, m the deviation of disparities from a plane, and f the row error
of the rectification. Windows of different textures determine the three parameters. The limits of
stereo matching follow from the parameters: surfaces pass with a given probability.

The check of the rectification matches corners of both images by their descriptors alone, without
the constraint of equal rows. So a pair that is rotated, shifted or scaled is detected.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.vision.disparity_tests import window_statistics
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.stereo import MatchStatus, StereoParameters, search_rows
from mapfusion.vision.subpixel import fit_planes
from mapfusion.vision.surf import describe

_ROUNDS = 30  # iterations of reweighting, far beyond convergence
_HUBER = 1.5  # relative deviation from the model beyond which the weight falls
_HALVES = 4  # halves of a window; each must pass
_LEAST_WINDOWS = 30  # smallest number of windows for an estimate of three parameters
_LEAST_NOISE = 0.3  # grey levels; the quantisation noise is 1 / sqrt(12)
_SEARCH = (0.5, 0.9, 2)  # min_correlation, max_ambiguity and max_round_trip_px of the windows


@dataclass(frozen=True)
class NoiseModel:
    """Differences between the two images of a surface, as standard deviations.

    Attributes:
        noise_grey: n, noise of one image, grey levels.
        misfit_px: m, deviation of disparities from a plane.
        rows_px: f, row error.
        texture: variance of the grey levels and squared slopes along u and v of windows, shape
            (N, 3).
    """

    noise_grey: float
    misfit_px: float
    rows_px: float
    texture: Float

    def square(self, slopes: Float) -> Float:
        """Return the expected mean squares (N,) of residuals for squared slopes (N, 2)."""
        squares = np.array([self.misfit_px**2, self.rows_px**2])
        return 2 * self.noise_grey**2 + slopes @ squares


def estimate_noise(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    camera: StereoCamera,
    harris: HarrisParameters,
    stereo: StereoParameters,
) -> NoiseModel | None:
    """Estimate the noise model of rectified pairs.

    Least squares of the mean squares of window halves, relative to the model, with Huber weights:
    halves on a silhouette are far above the model.

    Args:
        pairs: left and right images, shape (H, W) uint8.
        camera: the rectified pair.
        harris: parameters of the corners at the windows' centres.
        stereo: search range and sizes of the windows.

    Returns:
        None if the images have too few matching windows.
    """
    # Find windows at corners in the other image, and fit planes to them.
    focal_baseline = camera.focal_px * camera.baseline_m
    nearest = int(np.ceil(focal_baseline / stereo.min_depth_m))
    farthest = int(np.floor(focal_baseline / stereo.max_depth_m))
    slope_sigma = camera.baseline_m / stereo.nearest_plane_m
    halves, textures = [], []
    for left, right in pairs:
        pixel = np.rint(detect(left, harris)).astype(np.int64)
        found, status = search_rows(left, right, pixel, farthest, nearest, stereo.half_px, *_SEARCH)
        kept = status == MatchStatus.MATCHED
        pixel, start = pixel[kept], found[kept].astype(np.float64)
        center = np.zeros(pixel.shape)
        fit = (stereo.half_px, slope_sigma, 1.0, 1.0, 0.0)
        plane, _ = fit_planes(left, right, pixel, center, start, *fit)
        converged = np.abs(plane[:, 0] - start) <= stereo.max_jump_px  # False for NaN
        pixel, plane = pixel[converged], plane[converged]
        sizes = (stereo.silhouette_half_px, stereo.plane_half_px)
        own, _ = window_statistics(left, right, pixel, plane, *sizes)
        whole = own[:, 2] + own[:, 3]
        slopes = whole[:, 2:] / np.maximum(whole[:, :1], 1.0)
        half = stereo.half_px
        windows = [
            left[v - half : v + half + 1, u - half : u + half + 1] for u, v in pixel.tolist()
        ]
        variance = np.array([window.var() for window in windows], dtype=np.float64)
        halves.append(own)
        textures.append(np.column_stack([variance, slopes]))
    squares = np.concatenate(halves).reshape(-1, 4)
    squares = squares[squares[:, 0] > 0]
    if len(squares) < _HALVES * _LEAST_WINDOWS:
        return None
    from scipy.optimize import nnls

    # Iteratively reweighted, non-negative least squares of 2 n^2 + m^2 g^2 + f^2 h^2.
    mean = squares[:, 1:] / squares[:, :1]
    terms = np.column_stack([np.full(len(mean), 2.0), mean[:, 1:]])
    weight, parts = 1 / np.maximum(np.median(mean[:, 0]), 1.0) * np.ones(len(mean)), np.zeros(3)
    for _ in range(_ROUNDS):
        parts, _ = nnls(terms * weight[:, None], mean[:, 0] * weight)
        parts[0] = max(parts[0], _LEAST_NOISE**2)
        expected = terms @ parts
        off = np.abs(mean[:, 0] / expected - 1)
        weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(off, 1e-9))) / expected
    noise, misfit, rows = np.sqrt(parts).tolist()
    return NoiseModel(noise, misfit, rows, np.concatenate(textures))


def parameters_for_noise(
    stereo: StereoParameters, noise: NoiseModel, probability: float
) -> StereoParameters:
    """Derive the limits of stereo matching that surfaces pass with a given probability.

    The squared residuals of a half are a sum of independent parts, one per square of the residuals'
    correlation length. The correlation of a window is 1 - r^2 / (2 s^2), s^2 the variance of its
    grey levels; the limit is a quantile over the textures of the windows. The plane test tolerates
    the same errors as the silhouette test. Its window is that of the fit, because real surfaces are
    planar over short distances at best.
    """
    length_px = max(stereo.residual_correlation_px, 1.0)
    side = 2 * stereo.silhouette_half_px + 1
    parts = max(side * stereo.silhouette_half_px / length_px**2, 1.0)
    each = 1 - (1 - probability) / _HALVES
    rms = float(np.sqrt(chi_square_bound(each, parts) / parts))
    variance, slopes = noise.texture[:, 0], noise.texture[:, 1:]
    expected = 1 - noise.square(slopes) / (2 * np.maximum(variance, 1e-9))
    correlation = float(np.quantile(expected, 1 - probability))
    return replace(
        stereo,
        noise_grey=noise.noise_grey,
        max_misfit_px=max(rms * noise.misfit_px, 1e-3),
        max_rows_px=rms * noise.rows_px,
        plane_half_px=stereo.half_px,
        plane_misfit_px=rms * noise.misfit_px,
        row_sigma_px=noise.rows_px,
        min_correlation=min(max(correlation, _SEARCH[0]), stereo.min_correlation),
    )


_SCALE_PX = 2.0  # scale of the descriptors: windows of 40 px are robust against small rotations
_LARGEST_ROW_ERROR = 0.06  # share of the image's height; unrectified stereo heads have less
_MAX_DISTANCE = 0.3  # between two descriptors of one point, as in `TrackParameters`
_MAX_RATIO = 0.8  # distance of the nearest descriptor over that of the second (Lowe 2004)


def rectification_offsets(
    left: np.ndarray, right: np.ndarray, parameters: HarrisParameters
) -> Float:
    """Return the offsets of matched corners from the left to the right image.

    Several of the matches may be false, so use the median.

    Args:
        left: shape (H, W) uint8.
        right: shape (H, W) uint8.
        parameters: parameters of the corner detector.

    Returns:
        Offsets along columns and rows, shape (N, 2). A rectified pair has a median row offset of
        zero.
    """
    corners = [detect(image, parameters) for image in (left, right)]
    if min(map(len, corners)) < 2:
        return np.empty((0, 2))
    descriptors = [
        describe(image, uv, np.full(len(uv), _SCALE_PX))
        for image, uv in zip((left, right), corners, strict=True)
    ]
    shift = corners[1][None, :, :2] - corners[0][:, None, :2]
    squared = 2.0 - 2.0 * (descriptors[0] @ descriptors[1].T).astype(np.float64)
    squared[np.abs(shift[:, :, 1]) > _LARGEST_ROW_ERROR * len(left)] = np.inf
    nearest, back = np.argmin(squared, axis=1), np.argmin(squared, axis=0)
    rows = np.arange(len(nearest))
    best = squared[rows, nearest]
    second = np.partition(squared, 1, axis=1)[:, 1]
    kept = (back[nearest] == rows) & (best <= _MAX_DISTANCE**2)
    kept &= best <= _MAX_RATIO**2 * second
    return shift[rows, nearest][kept]
