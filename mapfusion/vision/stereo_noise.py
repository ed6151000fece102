"""Noise between the images of a stereo pair, and a check that the pair is rectified.

Over a window that shows a surface the residuals of the plane that fits best have the mean square
2 n^2 + m^2 g^2 + f^2 h^2, with g^2 and h^2 the mean squared slopes of the grey levels along u and
v: n is the noise of one picture, m by how much disparities of true surfaces differ from a plane, f
by how many rows the pictures are off. Many windows, of all textures, tell the three apart. Limits
of the matching then follow: what is tolerated is what true surfaces keep with a given probability.

Corners of either image are found and described alone, without any use of rows, and matched by their
descriptors: so a pair that is turned, shifted or scaled shows it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.vision.disparity_tests import window_statistics
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.stereo import MatchStatus, StereoParameters, search_rows
from mapfusion.vision.subpixel import fit_planes
from mapfusion.vision.surf import describe

_ROUNDS = 30  # of reweighting, far beyond where it stands still
_LOUD = 1.5  # halves whose square is off by more than this share of the model count less
_HALVES = 4  # of a window: each must pass
_LEAST_WINDOWS = 30  # that are to tell three numbers
_LEAST_NOISE = 0.3  # grey levels: whole levels alone have that (1 / sqrt(12))
_SEARCH = (0.5, 0.9, 2)  # correlation, ambiguity and round trip of windows that may be looked at


@dataclass(frozen=True)
class NoiseModel:
    """What true surfaces differ by in the two pictures.

    Attributes:
        noise_grey: n, of one picture, grey levels.
        misfit_px: m, of disparities from a plane.
        rows_px: f, of rows.
        texture: (N, 3) of windows: variance of the grey levels, and squared slopes along u and v.
    """

    noise_grey: float
    misfit_px: float
    rows_px: float
    texture: Float

    def square(self, slopes: Float) -> Float:
        """Expected mean squares (N,) of residuals, for squared slopes (N, 2)."""
        own = np.array([self.misfit_px**2, self.rows_px**2])
        return 2 * self.noise_grey**2 + slopes @ own


def estimate_noise(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    camera: StereoCamera,
    harris: HarrisParameters,
    stereo: StereoParameters,
) -> NoiseModel | None:
    """The model of some rectified pairs (H, W) uint8; None where they show too little.

    Least squares of the halves' mean squares, relative to the model, with bounded influence: halves
    on a silhouette are far above it and count little.
    """
    found = [_windows(*pair, camera, harris, stereo) for pair in pairs]
    squares = np.concatenate([halves for halves, _ in found]).reshape(-1, 4)
    texture = np.concatenate([own for _, own in found])
    squares = squares[squares[:, 0] > 0]
    if len(squares) < _HALVES * _LEAST_WINDOWS:
        return None
    from scipy.optimize import nnls

    mean = squares[:, 1:] / squares[:, :1]
    terms = np.column_stack([np.full(len(mean), 2.0), mean[:, 1:]])
    weight, parts = 1 / np.maximum(np.median(mean[:, 0]), 1.0) * np.ones(len(mean)), np.zeros(3)
    for _ in range(_ROUNDS):
        parts, _ = nnls(terms * weight[:, None], mean[:, 0] * weight)
        parts[0] = max(parts[0], _LEAST_NOISE**2)
        expected = terms @ parts
        off = np.abs(mean[:, 0] / expected - 1)
        weight = np.sqrt(np.minimum(1.0, _LOUD / np.maximum(off, 1e-9))) / expected
    noise, misfit, rows = np.sqrt(parts).tolist()
    return NoiseModel(noise, misfit, rows, texture)


def parameters_for_noise(
    stereo: StereoParameters, noise: NoiseModel, probability: float
) -> StereoParameters:
    """Limits that true surfaces keep with this probability.

    A half's square is a sum over so many independent parts as squares of the length over which
    residuals are alike fit into it; the correlation of a window is 1 - r^2 / (2 s^2), with s^2 the
    variance of its grey levels: the limit is what this share of the windows' textures allow. The
    test for bent surfaces tolerates what a half does, and refuses few that the halves let pass; its
    window is the fit's, as real surfaces are planes over short distances at best.
    """
    alike = max(stereo.residual_correlation_px, 1.0)
    side = 2 * stereo.silhouette_half_px + 1
    parts = max(side * stereo.silhouette_half_px / alike**2, 1.0)
    each = 1 - (1 - probability) / _HALVES
    wide = float(np.sqrt(chi_square_bound(each, parts) / parts))
    variance, slopes = noise.texture[:, 0], noise.texture[:, 1:]
    expected = 1 - noise.square(slopes) / (2 * np.maximum(variance, 1e-9))
    correlation = float(np.quantile(expected, 1 - probability))
    return replace(
        stereo,
        noise_grey=noise.noise_grey,
        max_misfit_px=max(wide * noise.misfit_px, 1e-3),
        max_rows_px=wide * noise.rows_px,
        plane_half_px=stereo.half_px,
        plane_misfit_px=wide * noise.misfit_px,
        row_sigma_px=noise.rows_px,
        min_correlation=min(max(correlation, _SEARCH[0]), stereo.min_correlation),
    )


def _windows(
    left: np.ndarray,
    right: np.ndarray,
    camera: StereoCamera,
    harris: HarrisParameters,
    stereo: StereoParameters,
) -> tuple[Float, Float]:
    """Of windows that are found in the other picture: halves (N, 4, 4), texture (N, 3)."""
    uv = detect(left, harris)
    pixel, reach = np.rint(uv).astype(np.int64), camera.focal_px * camera.baseline_m
    nearest, farthest = reach / stereo.min_depth_m, reach / stereo.max_depth_m
    span = int(np.floor(farthest)), int(np.ceil(nearest))
    found, verdict = search_rows(left, right, pixel, *span, stereo.half_px, *_SEARCH)
    kept = verdict == MatchStatus.MATCHED
    pixel, start = pixel[kept], found[kept].astype(np.float64)
    slope_sigma = camera.baseline_m / stereo.nearest_plane_m
    plane, _ = fit_planes(
        left, right, pixel, np.zeros(pixel.shape), start, stereo.half_px, slope_sigma, 1.0, 1.0, 0.0
    )
    fine = np.abs(plane[:, 0] - start) <= stereo.max_jump_px  # NaN is not
    pixel, plane = pixel[fine], plane[fine]
    half = (stereo.silhouette_half_px, stereo.plane_half_px)
    squares, _ = window_statistics(left, right, pixel, plane, *half)
    whole = squares[:, 2] + squares[:, 3]
    slopes = whole[:, 2:] / np.maximum(whole[:, :1], 1.0)
    return squares, np.column_stack([_variance(left, pixel, stereo.half_px), slopes])


def _variance(image: np.ndarray, pixel: np.ndarray, half: int) -> Float:
    """Variances (N,) of the grey levels of windows that lie inside."""
    inside = [image[v - half : v + half + 1, u - half : u + half + 1] for u, v in pixel.tolist()]
    return np.array([window.var() for window in inside], dtype=np.float64)


_SCALE_PX = 2.0  # of the descriptors: windows of 40 px, which small turns do not change much
_LARGEST_SHARE = 0.06  # of the height, up and down: a head that is not rectified is off by less
_MAX_DISTANCE = 0.3  # of two descriptors of one point, as tracks have it
_MAX_RATIO = 0.8  # of the nearest descriptor's distance over the second's (Lowe 2004)


def rectification_offsets(
    left: np.ndarray, right: np.ndarray, parameters: HarrisParameters
) -> Float:
    """Columns and rows (N, 2) by which matched corners lie farther right and lower on the right.

    Images are (H, W) uint8. One false match in several is to be expected: use the median.
    """
    corners = [detect(image, parameters) for image in (left, right)]
    if min(map(len, corners)) < 2:
        return np.empty((0, 2))
    looks = [
        describe(image, uv, np.full(len(uv), _SCALE_PX))
        for image, uv in zip((left, right), corners, strict=True)
    ]
    shift = corners[1][None, :, :2] - corners[0][:, None, :2]
    squared = 2.0 - 2.0 * (looks[0] @ looks[1].T).astype(np.float64)
    squared[np.abs(shift[:, :, 1]) > _LARGEST_SHARE * len(left)] = np.inf
    nearest, back = np.argmin(squared, axis=1), np.argmin(squared, axis=0)
    rows = np.arange(len(nearest))
    best = squared[rows, nearest]
    second = np.partition(squared, 1, axis=1)[:, 1]
    kept = (back[nearest] == rows) & (best <= _MAX_DISTANCE**2)
    kept &= best <= _MAX_RATIO**2 * second
    return shift[rows, nearest][kept]
