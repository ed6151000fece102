"""Depth images in the place of right images: disparities of corners, and the noise of the sensor.

A structured-light sensor measures the disparity d = f B / Z between its projector and its infrared
camera. Its depths therefore are disparities of a virtual pair with this baseline B, and all that
follows the matching of stereo pairs serves them as well. Khoshelham and Elberink (2012, "Accuracy
and resolution of Kinect depth data for indoor mapping applications", Sensors 12, eq. 10) give the
standard deviation of a depth, sigma_Z = k Z^2. That of the disparity is the same at all depths:

    sigma_d = |dd / dZ| sigma_Z = f B / Z^2 * k Z^2 = f B k.

The depth at a corner is that of a plane in a small window. A corner at the edge of an object may
belong to the object or to what lies behind it, so windows that show more than one plane are
rejected. The sensor matches windows of 9 x 9 pixels itself, so the pixels of one window share their
error, and the mean over a window is no surer than one pixel.
"""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.geometry.numerics import Float, chi_square_bound, require_finite, require_shape
from mapfusion.parameters import Probability, Range, require_in_range
from mapfusion.vision.stereo import MatchStatus, StereoMatches

_WINDOW_PX = 9  # side of the windows that the sensor matches


@dataclass(frozen=True)
class DepthParameters:
    """Noise of a depth sensor and the tests of its depths. The defaults are those of the Kinect.

    Attributes:
        sigma_per_m: k, standard deviation of a depth over its square; 0.5 px of disparity, which is
            36 mm at 5 m.
        baseline_m: distance of projector and infrared camera, the baseline of the virtual pair.
        half_px: half side of the window of the plane.
        most_missing: largest share of the pixels of a window without depth.
        probability: share of the windows on one plane that pass the test of edges.
    """

    sigma_per_m: Annotated[float, Range(1e-6, 1, "1/m")] = 1.425e-3
    baseline_m: Annotated[float, Range(1e-3, 10, "m")] = 0.075
    half_px: Annotated[int, Range(1, 90, "px")] = _WINDOW_PX // 2
    most_missing: Annotated[float, Range(0, 0.9, "1")] = 0.1
    probability: Probability = 0.999

    def __post_init__(self) -> None:
        require_in_range(self)


def match_depth(
    depth_m: np.ndarray, uv_px: Float, camera: StereoCamera, parameters: DepthParameters
) -> StereoMatches:
    """Return the disparities of corners (N, 2) by the depths of their pixels.

    The status is OUTSIDE for windows that leave the image, MISSING for those with too few depths,
    and SILHOUETTE for those with a pixel that lies off the plane by more than noise.

    Args:
        depth_m: depths in metres, shape (H, W); NaN or 0 where unknown.
        uv_px: corners of the image that the depths are registered to, shape (N, 2).
        camera: virtual pair with the sensor's baseline.
        parameters: noise and tests.

    Raises:
        ValueError: wrong shape, type or value; names the argument.
    """
    require_shape("depth_m", depth_m, (camera.height_px, camera.width_px))
    uv = np.ascontiguousarray(uv_px, dtype=np.float64)
    require_shape("uv_px", uv, (None, 2))
    require_finite("uv_px", uv)
    half, pixel = parameters.half_px, np.rint(uv).astype(np.int64)
    status = np.full(len(uv), np.int8(MatchStatus.OUTSIDE))
    limits = np.array([camera.width_px, camera.height_px]) - half
    inside = np.flatnonzero(np.all((pixel >= half) & (pixel < limits), axis=1))

    # Disparities of the windows' pixels, and their places relative to the corners.
    around = np.arange(-half, half + 1)
    columns = np.broadcast_to(
        pixel[inside, 0, None, None] + around, (len(inside), len(around), len(around))
    )
    rows = np.broadcast_to(pixel[inside, 1, None, None] + around[:, None], columns.shape)
    n_pixels = len(around) ** 2
    depth = depth_m[rows, columns].astype(np.float64).reshape(-1, n_pixels)
    is_measured = np.isfinite(depth) & (depth > 0)
    focal_baseline = camera.focal_px * camera.baseline_m
    disparity = np.where(is_measured, focal_baseline / np.where(is_measured, depth, 1.0), 0.0)
    position = np.stack(
        [
            np.ones(columns.shape),
            columns - uv[inside, 0, None, None],
            rows - uv[inside, 1, None, None],
        ],
        -1,
    )
    position = position.reshape(-1, n_pixels, 3)
    enough = np.count_nonzero(is_measured, axis=1) >= (1 - parameters.most_missing) * n_pixels
    status[inside[~enough]] = MatchStatus.MISSING

    # Least squares of a plane, and the largest deviation from it.
    kept, is_measured = inside[enough], is_measured[enough]
    position, disparity = position[enough] * is_measured[:, :, None], disparity[enough]
    normal = np.swapaxes(position, 1, 2) @ position
    plane = np.linalg.solve(normal, np.swapaxes(position, 1, 2) @ disparity[:, :, None])[:, :, 0]
    off = np.abs(np.einsum("nkj,nj->nk", position, plane) - disparity).max(axis=1, initial=0.0)
    sigma_px = focal_baseline * parameters.sigma_per_m
    each = parameters.probability ** (1 / n_pixels)  # of the pixels, if independent
    one_plane = off <= np.sqrt(chi_square_bound(each, 1)) * sigma_px
    one_plane &= plane[:, 0] > 0
    status[kept] = np.where(one_plane, MatchStatus.MATCHED, MatchStatus.SILHOUETTE)

    found, sigma = np.full(len(uv), np.nan), np.full(len(uv), np.nan)
    slope = np.full((len(uv), 2), np.nan)
    matched = kept[one_plane]
    found[matched], slope[matched] = plane[one_plane, 0], plane[one_plane, 1:]
    sigma[matched] = sigma_px
    return StereoMatches(found, sigma, slope, status)


def add_noise(depth_m: np.ndarray, sigma_per_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return depths (H, W) with the noise of a structured-light sensor, common to 9 x 9 pixels.

    The errors of the disparities are normal, and so are those of 1 / Z, with standard deviation k.
    """
    white = rng.standard_normal(depth_m.shape)
    shared = _WINDOW_PX * cv2.blur(white, (_WINDOW_PX, _WINDOW_PX), borderType=cv2.BORDER_REFLECT)
    return (depth_m / (1 + sigma_per_m * depth_m * shared)).astype(np.float32)
