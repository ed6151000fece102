"""A calibrated pair as the library's camera: one focal length, rows alike, principal point central.

A pair whose calibration says that it is rectified already keeps its grey levels: its images are
cropped so that the principal point lies in the middle, to a quarter of a pixel, and the rest is a
turn of the camera. Any other pair is drawn anew by OpenCV (bilinear), in the largest rectangle that
both images fill.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from mapfusion.camera import MAX_IMAGE_SIDE_PX, StereoCamera
from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.recordings.lens import R_ROBOT_OPTICAL, Lens, StereoCalibration
from mapfusion.se2 import Float

_SAME_PX = 0.01  # by which rows and focal lengths of a rectified pair may differ: a tenth of noise
_WIDEST = 1.2  # tangent of half the angle of view; a pinhole's pixels beyond 50 degrees are smears
_COS_APART = 0.7  # cosine of 45 degrees: cameras that both turn away further share no view
_LEAST_SIDE_PX = 48  # corners keep 12 px from each border
_BORDER_POINTS = 64  # of each edge of an image, to find what is inside both


@dataclass(frozen=True)
class Rectification:
    """How raw images become rectified ones.

    Attributes:
        camera: the rectified pair, with the default mount.
        R_left_rectified: (3, 3) from the rectified camera's axes into the left camera's; both with
            x ahead, y left, z up.
        crops: of a pair that is rectified already: first column and row of each image.
        maps: of any other: OpenCV's pair of maps for each image.
        sizes_px: width and height that raw images must have.
    """

    camera: StereoCamera
    R_left_rectified: Float
    crops: tuple[tuple[int, int], tuple[int, int]] | None
    maps: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None
    sizes_px: tuple[tuple[int, int], tuple[int, int]]

    @classmethod
    def of(cls, calibration: StereoCalibration) -> "Rectification":
        """Raises InputError for a pair that cannot be rectified: there is no common view."""
        made = _cropped(calibration)
        return _drawn_anew(calibration) if made is None else made

    def apply(self, raw: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The rectified pair of raw images (H, W) uint8.

        Raises:
            InputError: an image has another size than the calibration.
        """
        for name, image, size in zip(("left", "right"), raw, self.sizes_px, strict=True):
            if image.shape[:2] != size[::-1]:
                found = f"is {image.shape[1]}x{image.shape[0]} px"
                raise InputError(f"{name} image: {found}, the calibration's {size[0]}x{size[1]}")
        if self.crops is not None:
            left, right = (
                image[row : row + self.camera.height_px, column : column + self.camera.width_px]
                for image, (column, row) in zip(raw, self.crops, strict=True)
            )
            return np.ascontiguousarray(left), np.ascontiguousarray(right)
        assert self.maps is not None
        left, right = (
            cv2.remap(image, *maps, cv2.INTER_LINEAR)
            for image, maps in zip(raw, self.maps, strict=True)
        )
        return left, right


def _cropped(calibration: StereoCalibration) -> Rectification | None:
    """For a pair that is rectified already; None where its pixels must be drawn anew."""
    left, right, T = calibration.left, calibration.right, calibration.T_left_right
    f = float(left.focal_px[0])
    off_px = f * np.abs(T[:3, :3] - np.eye(3)).max() + f * np.abs(T[1:3, 3]).max() / T[0, 3]
    shift = right.center_px[0] - left.center_px[0]
    differences = [each - f for each in (*left.focal_px, *right.focal_px)]
    differences += [right.center_px[1] - left.center_px[1], shift - round(shift), off_px]
    distorted = any(any(lens.coefficients) for lens in (left, right))
    if distorted or np.abs(differences).max() > _SAME_PX:
        return None
    (width, column, du), (height, row, dv) = (
        _central(_common(left, right, axis), left.center_px[axis]) for axis in (0, 1)
    )
    # The middle of the crop looks along (-du / f, -dv / f, 1), a turn of the camera.
    turn, _ = cv2.Rodrigues(np.array([dv / f, -du / f, 0.0]))
    return Rectification(
        _camera(width, height, f, float(T[0, 3])),
        R_ROBOT_OPTICAL @ turn @ R_ROBOT_OPTICAL.T,
        ((column, row), (column + round(shift), row)),
        None,
        (left.size_px, right.size_px),
    )


def _common(left: Lens, right: Lens, axis: int) -> tuple[int, int]:
    """First and last column (row) of the left image that has its like, by the centre, in both."""
    shift = round(right.center_px[axis] - left.center_px[axis])
    return max(0, -shift), min(left.size_px[axis], right.size_px[axis] - shift) - 1


def _central(span: tuple[int, int], center: float) -> tuple[int, int, float]:
    """Side and beginning of the largest crop around a centre, and by how much it is off (px)."""
    first, last = span
    side = int(np.floor(2 * min(center - first, last - center) + 0.5)) + 1
    side = min(side, last - first + 1)
    begin = round(center - (side - 1) / 2)
    begin = min(max(begin, first), last - side + 1)
    return side, begin, center - begin - (side - 1) / 2


def _drawn_anew(calibration: StereoCalibration) -> Rectification:
    left, right = calibration.left, calibration.right
    T_right_left = np.linalg.inv(calibration.T_left_right)
    # Only the rotations are taken; those do not depend on the lenses.
    found = cv2.stereoRectify(
        np.eye(3), np.zeros(4), np.eye(3), np.zeros(4), (1, 1), T_right_left[:3, :3],
        np.ascontiguousarray(T_right_left[:3, 3]),
    )  # fmt: skip
    R_left, R_right = (np.asarray(R, dtype=np.float64) for R in found[:2])
    f = float(np.mean([*left.focal_px, *right.focal_px]))
    reach = np.min([_reach(left, R_left), _reach(right, R_right)], axis=0)
    width, height = (int(np.floor(2 * f * each)) + 1 for each in reach)
    width, height = min(width, MAX_IMAGE_SIDE_PX), min(height, MAX_IMAGE_SIDE_PX)
    baseline = float(np.linalg.norm(T_right_left[:3, 3]))
    camera = _camera(width, height, f, baseline)
    (cu, cv), K = camera.center_px, np.eye(3) * [f, f, 1.0]
    K[:2, 2] = cu, cv
    maps = tuple(
        _maps(lens, R, K, (width, height)) for lens, R in ((left, R_left), (right, R_right))
    )
    return Rectification(
        camera,
        R_ROBOT_OPTICAL @ R_left.T @ R_ROBOT_OPTICAL.T,
        None,
        (maps[0], maps[1]),
        (left.size_px, right.size_px),
    )


def _reach(lens: Lens, R: Float) -> Float:
    """Tangents (2,) of the half angles, across and down, that an image turned by R fills."""
    width, height = lens.size_px
    share = np.linspace(0, 1, _BORDER_POINTS)
    u, v = share * (width - 1), share * (height - 1)
    edges = [(0 * v, v), (0 * v + width - 1, v), (u, 0 * u), (u, 0 * u + height - 1)]
    if R[2, 2] < _COS_APART:
        return np.zeros(2)
    least = np.full(2, _WIDEST)
    for k, edge in enumerate(edges):
        rays = lens.rays(np.column_stack(edge)) @ R.T
        axis, sign = divmod(k, 2)
        met = _sign_of(sign) * rays[:, axis] / rays[:, 2]
        met = met[np.isfinite(met) & (rays[:, 2] > 0)]
        least[axis] = min(least[axis], met.min(initial=_WIDEST))
    return np.maximum(least, 0.0)


def _sign_of(side: int) -> int:
    """-1 for the edge at the low end, 1 for that at the high one."""
    return 2 * side - 1


def _maps(lens: Lens, R: Float, K: Float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    fisheye = lens.distortion == "equidistant"
    make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    first, second = make(lens.matrix, lens.parameters, R, K, size, cv2.CV_32FC1)
    return first, second


def _camera(width: int, height: int, focal_px: float, baseline_m: float) -> StereoCamera:
    if min(width, height) < _LEAST_SIDE_PX:
        small = f"what both cameras see has {width}x{height} px once rectified"
        raise InputError(f"{small}, at least {_LEAST_SIDE_PX} each way are needed")
    try:
        return StereoCamera(width, height, focal_px, baseline_m)
    except OutOfRangeError as error:
        raise InputError(f"calibration: {error}") from error
