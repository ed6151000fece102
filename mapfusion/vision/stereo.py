"""Disparity of corners in a rectified pair: search along the row, then least squares for a plane.

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
from typing import Annotated

import numpy as np

from mapfusion.arguments import (
    Range,
    require_at_least,
    require_finite,
    require_in_range,
    require_shape,
)
from mapfusion.camera import StereoCamera
from mapfusion.chi_square import chi_square_bound
from mapfusion.se2 import Float
from mapfusion.vision.plane_fit import fit_planes
from mapfusion.vision.plane_test import FURTHER_TERMS
from mapfusion.vision.row_search import search_rows
from mapfusion.vision.silhouette_test import disagrees
from mapfusion.vision.verdict import Verdict
from mapfusion.vision.window import MOST_HALF_PX
from mapfusion.vision.window_sums import window_sums

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

    rows = np.nonzero(verdict == Verdict.MATCHED)[0]
    plane, disparity[rows], sigma[rows] = _refine(
        left, right, pixel[rows], uv[rows], found[rows], camera, parameters
    )
    jump = np.abs(plane[:, 0] - found[rows])
    lost = ~((jump <= parameters.max_jump_px) & (disparity[rows] > 0))
    verdict[rows[lost]] = Verdict.DIVERGED

    rows, plane = rows[~lost], plane[~lost]
    slope[rows] = plane[:, 1:]
    half = (parameters.silhouette_half_px, parameters.plane_half_px)
    squares, scores = window_sums(left, right, pixel[rows], plane, *half)
    tolerated = (parameters.noise_grey, parameters.max_misfit_px, parameters.max_rows_px)
    verdict[rows[_bent(scores, parameters)]] = Verdict.BENT
    verdict[rows[disagrees(squares, *tolerated)]] = Verdict.SILHOUETTE

    unmatched = verdict != Verdict.MATCHED
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
