"""Camera calibration of a recording: lenses, calibration files, rectification.

Optical axes are x to the right, y down, z ahead. The centre of the top left pixel is (0, 0), as in
`camera.py`.

A pair that is rectified according to its calibration keeps its grey levels: its images are cropped
so that the principal point lies in the middle, to a quarter of a pixel. The remaining offset is
expressed as a rotation of the camera. Any other pair is resampled by OpenCV (bilinear) in the
largest rectangle that both images fill.
"""

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from mapfusion.camera import MAX_IMAGE_SIDE_PX, StereoCamera
from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float

Distortion = Literal["none", "radial-tangential", "equidistant"]
# Numbers of coefficients: k1 k2 p1 p2 and optionally k3 (Brown 1966) and k4 k5 k6, the denominator
# of the rational model (Claus, Fitzgibbon 2005, as in OpenCV); or four of the odd powers of the
# angle (Kannala, Brandt 2006).
_COEFFICIENTS: dict[Distortion, tuple[int, ...]] = {
    "none": (0,),
    "radial-tangential": (4, 5, 8),
    "equidistant": (4,),
}
_LONGEST_RATIONAL = 8  # OpenCV writes up to 14 coefficients; the others are usually zero
_LARGEST_FOCAL_PX = 1e5
_ROTATION_TOLERANCE = 1e-4  # calibrations are printed with at least six digits
# Optical axes in the robot frame: x ahead, y left, z up.
R_ROBOT_OPTICAL: Float = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
R_ROBOT_OPTICAL.setflags(write=False)


@dataclass(frozen=True)
class Lens:
    """Pinhole camera with lens distortion.

    Attributes:
        size_px: width and height of the images.
        focal_px: focal lengths along u and v.
        center_px: principal point, u and v.
        distortion: none, or the polynomial model of Brown or of Kannala and Brandt.
        coefficients: coefficients of the distortion in OpenCV's order.
    """

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (*self.focal_px, *self.center_px, *self.coefficients)
        if not np.isfinite(numbers).all():
            raise InputError("intrinsics: hold a number that is not finite")
        if not all(0 < side <= MAX_IMAGE_SIDE_PX for side in self.size_px):
            wide = f"is {self.size_px}, sides must be in [1, {MAX_IMAGE_SIDE_PX}] px"
            raise InputError(f"resolution: {wide}")
        if not all(1 <= f <= _LARGEST_FOCAL_PX for f in self.focal_px):
            raise InputError(f"intrinsics: focal length is {self.focal_px}, must be in [1, 1e5] px")
        inside = zip(self.center_px, self.size_px, strict=True)
        if not all(0 < center < side - 1 for center, side in inside):
            outside = f"principal point {self.center_px} lies outside the image {self.size_px}"
            raise InputError(f"intrinsics: {outside}")
        if len(self.coefficients) not in _COEFFICIENTS[self.distortion]:
            wanted = " or ".join(map(str, _COEFFICIENTS[self.distortion]))
            found = f"{len(self.coefficients)} numbers, {self.distortion} has {wanted}"
            raise InputError(f"distortion_coefficients: {found}")

    @property
    def matrix(self) -> Float:
        """Camera matrix K, shape (3, 3)."""
        (fu, fv), (cu, cv) = self.focal_px, self.center_px
        return np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Float:
        """Distortion coefficients for OpenCV."""
        return np.array(self.coefficients or (0.0,) * 4)

    def rays(self, uv_px: Float) -> Float:
        """Return the rays of pixels, shape (N, 3), with z = 1, for pixels of shape (N, 2).

        Rays of pixels that look sideways or back are NaN; they do not meet the plane z = 1.
        """
        points = np.ascontiguousarray(uv_px, dtype=np.float64).reshape(-1, 1, 2)
        if self.distortion == "equidistant":
            flat = cv2.fisheye.undistortPoints(points, self.matrix, self.parameters)
        else:
            flat = cv2.undistortPoints(points, self.matrix, self.parameters)
        flat = flat.reshape(-1, 2)
        # Beyond a right angle the inverse of the polynomial is undefined, usually mirrored.
        ahead = np.sum(flat * (uv_px - np.array(self.center_px)), axis=1) >= 0
        return np.column_stack([np.where(ahead[:, None], flat, np.nan), np.ones(len(flat))])


@dataclass(frozen=True)
class StereoCalibration:
    """Calibration of a stereo pair; `T_left_right` (4, 4) is in optical axes and metres."""

    left: Lens
    right: Lens
    T_left_right: Float

    def __post_init__(self) -> None:
        require_rigid("T_left_right", self.T_left_right)
        x, y, z = self.T_left_right[:3, 3]
        if not x > max(abs(y), abs(z)):
            found = f"({x:.3g}, {y:.3g}, {z:.3g}) m"
            wanted = "must lie to the right of the left one; are the cameras the other way round?"
            raise InputError(f"the right camera stands at {found} and {wanted}")


def require_rigid(name: str, T: Float) -> None:
    """Raise InputError unless T is a rigid motion in space, shape (4, 4)."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{name}: must be a 4x4 matrix of finite numbers")
    R, last = T[:3, :3], T[3]
    unit = np.abs(R @ R.T - np.eye(3)).max() <= _ROTATION_TOLERANCE and np.linalg.det(R) > 0
    if not unit or np.abs(last - [0, 0, 0, 1]).max() > _ROTATION_TOLERANCE:
        raise InputError(f"{name}: is no rotation with a translation")


_DISTORTIONS: dict[str, Distortion] = {
    "radial-tangential": "radial-tangential",
    "radtan": "radial-tangential",
    "plumb_bob": "radial-tangential",
    "equidistant": "equidistant",
    "none": "none",
}
_COEFFICIENT_KEYS = ("distortion_coefficients", "distortion_coeffs")


def parse_lens(where: str, camera: Mapping[str, Any]) -> Lens:
    """Parse a pinhole camera with its distortion.

    Args:
        where: file and position in the file, for messages.
        camera: mapping with `camera_model: pinhole`, `intrinsics: [fu, fv, cu, cv]`,
            `resolution: [width, height]`, `distortion_model` and `distortion_coefficients`.

    Raises:
        InputError: a value is missing or wrong; the message begins with `where`.
    """
    model = camera.get("camera_model", "pinhole")
    if model != "pinhole":
        raise InputError(f"{where}: camera_model: is {model!r}, only pinhole is read")
    named = str(camera.get("distortion_model", "none"))
    if named not in _DISTORTIONS:
        known_names = ", ".join(_DISTORTIONS)
        raise InputError(f"{where}: distortion_model: {named!r} is unknown; known: {known_names}")
    key = next((key for key in _COEFFICIENT_KEYS if key in camera), _COEFFICIENT_KEYS[0])
    coefficients = _numbers(where, camera, key, None, ()) if key in camera else []
    distortion = _DISTORTIONS[named]
    if distortion == "none" and not any(coefficients):
        coefficients = []
    fu, fv, cu, cv = _numbers(where, camera, "intrinsics", 4, ("fu", "fv", "cu", "cv"))
    width, height = _numbers(where, camera, "resolution", 2, ("width", "height"))
    if width % 1 or height % 1:
        raise InputError(f"{where}: resolution: must be whole numbers")
    try:
        size = (int(width), int(height))
        return Lens(size, (fu, fv), (cu, cv), distortion, tuple(coefficients))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def parse_transform(where: str, key: str, holder: Mapping[str, Any]) -> Float:
    """Parse a rigid motion (4, 4): rows of numbers, 16 numbers, or EuRoC's mapping with `data`.

    Args:
        where: file and position in the file, for messages.
        key: key of the motion.
        holder: mapping that holds the motion.

    Raises:
        InputError: the value is missing or no rigid motion; the message begins with `where`.
    """
    value, expected = holder.get(key), "4 rows of 4 numbers"
    if isinstance(value, Mapping):
        key, value = f"{key}.data", value.get("data")
    if value is None:
        raise InputError(f"{where}: {key}: is missing, expected {expected}")
    try:
        T = np.array(value, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {key}: is {_short(value)}, expected {expected}") from None
    try:
        require_rigid(key, T)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return T


def read_stereo_calibration(
    path: Path, document: Mapping[str, Any], size_px: tuple[int, int] | None = None
) -> tuple[StereoCalibration, Float | None]:
    """Read the calibration of a stereo pair in the layout of Kalibr or of OpenCV.

    Kalibr's layout has `cam0` (left) and `cam1`, with `T_cn_cnm1` of `cam1`, or `T_cam_imu` or its
    inverse `T_imu_cam` of both cameras. OpenCV's layout has the camera matrices `K1`, `K2` (or
    `M1`, `M2`), the distortions `D1`, `D2`, and `R`, `T` from the left camera into the right one.

    Args:
        path: file of the document, for messages.
        document: contents of the file.
        size_px: width and height of the pictures, for documents without them.

    Returns:
        Calibration, and the mount `T_BS` (4, 4) of the left camera; None if the file has none.

    Raises:
        InputError: a value is missing or wrong; the message names file and key.
    """
    if "cam0" not in document and any(key in document for key in ("K1", "M1")):
        return _opencv_calibration(path, document, size_px), None
    cameras = [parse_section(path, document, name) for name in ("cam0", "cam1")]
    named = [f"{path}: {name}" for name in ("cam0", "cam1")]
    bodies = [key for key in ("T_cam_imu", "T_imu_cam") if all(key in each for each in cameras)]
    if "T_cn_cnm1" in cameras[1] or not bodies:
        T_right_left = parse_transform(named[1], "T_cn_cnm1", cameras[1])
        T_left_right = se3.inverse(T_right_left)
    else:
        pairs = zip(named, cameras, strict=True)
        left, right = (parse_transform(where, bodies[0], each) for where, each in pairs)
        if bodies[0] == "T_cam_imu":
            left, right = se3.inverse(left), se3.inverse(right)
        T_left_right = se3.between(left, right)
    lenses = [parse_lens(where, each) for where, each in zip(named, cameras, strict=True)]
    try:
        calibration = StereoCalibration(lenses[0], lenses[1], T_left_right)
    except InputError as error:
        raise InputError(f"{named[1]}: {error}") from error
    mount = parse_transform(named[0], "T_BS", cameras[0]) if "T_BS" in cameras[0] else None
    return calibration, mount


_OPENCV_SIZES = (("image_width", "image_height"), ("width", "height"))


def _opencv_calibration(
    path: Path, document: Mapping[str, Any], size_px: tuple[int, int] | None
) -> StereoCalibration:
    """Return the calibration of a file in OpenCV's layout; see `read_stereo_calibration`."""
    sizes = [
        (int(document[wide]), int(document[high]))
        for wide, high in _OPENCV_SIZES
        if all(isinstance(document.get(each), int) for each in (wide, high))
    ]
    size_px = sizes[0] if sizes else size_px
    if size_px is None:
        raise InputError(f"{path}: image_width and image_height: are missing")
    lenses = []
    for n in (1, 2):
        name = next((key for key in (f"K{n}", f"M{n}") if key in document), f"K{n}")
        K = _opencv_matrix(path, document, name, 9).reshape(3, 3)
        D = _opencv_matrix(path, document, f"D{n}", None)
        while len(D) > _LONGEST_RATIONAL and not D[-1]:
            D = D[:-1]
        distortion: Distortion = "radial-tangential" if D.any() else "none"
        coefficients = tuple(D.tolist()) if D.any() else ()
        try:
            lenses.append(
                Lens(size_px, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), distortion, coefficients)
            )
        except InputError as error:
            raise InputError(f"{path}: {name} and D{n}: {error}") from error
    R = _opencv_matrix(path, document, "R", 9).reshape(3, 3)
    T_right_left = se3.pose(R, _opencv_matrix(path, document, "T", 3))
    try:
        require_rigid("R and T", T_right_left)
        return StereoCalibration(lenses[0], lenses[1], se3.inverse(T_right_left))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _opencv_matrix(path: Path, document: Mapping[str, Any], key: str, n: int | None) -> Float:
    """Return the n numbers of a matrix of OpenCV (any number for None), row by row."""
    value = document.get(key)
    value = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all() or n not in (None, len(numbers)):
        expected = "numbers" if n is None else f"{n} numbers"
        problem = "is missing" if value is None else f"is {_short(value)}"
        raise InputError(f"{path}: {key}: {problem}, expected a matrix of {expected}")
    return numbers


def _short(value: Any) -> str:
    """Return a short text of a value for messages."""
    flat = []
    if isinstance(value, list):
        flat = [each for row in value for each in (row if isinstance(row, list) else [row])]
    is_numbers = flat and all(isinstance(each, int | float) for each in flat)
    return f"{len(flat)} numbers" if is_numbers else reprlib.repr(value)


def parse_section(where: Path, document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a mapping within a document; raise InputError if it is missing."""
    section = document.get(key)
    if not isinstance(section, Mapping):
        problem = "is missing" if section is None else f"is {_short(section)}"
        raise InputError(f"{where}: {key}: {problem}, expected a mapping")
    return section


def _numbers(
    where: str, camera: Mapping[str, Any], key: str, n: int | None, names: tuple[str, ...]
) -> list[float]:
    """Parse a list of n numbers (any number for None); `names` describes them in messages."""
    value: Any = camera.get(key)
    is_list = isinstance(value, list) and all(
        isinstance(each, int | float) and not isinstance(each, bool) for each in value
    )
    if not is_list or (n is not None and len(value) != n):
        expected = f"a list [{', '.join(names)}]" if names else "a list of numbers"
        problem = "is missing" if value is None else f"is {reprlib.repr(value)}"
        raise InputError(f"{where}: {key}: {problem}, expected {expected}")
    return [float(each) for each in value]


_SAME_PX = 0.01  # tolerance of rows and focal lengths of a rectified pair: a tenth of the noise
_MAX_TANGENT = 1.2  # of half the angle of view; resolution is poor beyond 50 degrees
_MIN_COS_ROTATION = 0.7  # cosine of 45 degrees: cameras rotated further have no common view
_MIN_SIDE_PX = 48  # corners keep 12 px from each border
_BORDER_POINTS = 64  # on each edge of an image, to find the common rectangle


@dataclass(frozen=True)
class Rectification:
    """Transformation of raw images to rectified images.

    Attributes:
        camera: the rectified pair with the default mount.
        R_left_rectified: rotation of the rectified camera's axes into those of the left camera,
            shape (3, 3); both with x ahead, y left, z up.
        crops: first column and row of each image of a pair that is rectified already, or None.
        maps: OpenCV's pair of maps for each image of any other pair, or None.
        sizes_px: required width and height of raw images.
    """

    camera: StereoCamera
    R_left_rectified: Float
    crops: tuple[tuple[int, int], tuple[int, int]] | None
    maps: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None
    sizes_px: tuple[tuple[int, int], tuple[int, int]]

    @classmethod
    def of(cls, calibration: StereoCalibration) -> "Rectification":
        """Return the rectification of a pair; raise InputError if there is no common view."""
        left, right, T = calibration.left, calibration.right, calibration.T_left_right
        f = float(left.focal_px[0])
        tilt_px = f * np.abs(T[:3, :3] - np.eye(3)).max() + f * np.abs(T[1:3, 3]).max() / T[0, 3]
        shift = right.center_px[0] - left.center_px[0]
        differences = [each - f for each in (*left.focal_px, *right.focal_px)]
        differences += [right.center_px[1] - left.center_px[1], shift - round(shift), tilt_px]
        distorted = any(any(lens.coefficients) for lens in (left, right))
        if not distorted and np.abs(differences).max() <= _SAME_PX:
            (width, column, du), (height, row, dv) = (
                _centred_span(left, right, axis) for axis in (0, 1)
            )
            # The optical axis of the crop is (-du / f, -dv / f, 1): a rotation of the camera.
            turn, _ = cv2.Rodrigues(np.array([dv / f, -du / f, 0.0]))
            return Rectification(
                _camera(width, height, f, float(T[0, 3])),
                R_ROBOT_OPTICAL @ turn @ R_ROBOT_OPTICAL.T,
                ((column, row), (column + round(shift), row)),
                None,
                (left.size_px, right.size_px),
            )

        # Resample in the largest rectangle that both images fill.
        T_right_left = np.linalg.inv(calibration.T_left_right)
        # Only the rotations are used; they do not depend on the lenses.
        found = cv2.stereoRectify(
            np.eye(3), np.zeros(4), np.eye(3), np.zeros(4), (1, 1), T_right_left[:3, :3],
            np.ascontiguousarray(T_right_left[:3, 3]),
        )  # fmt: skip
        R_left, R_right = (np.asarray(R, dtype=np.float64) for R in found[:2])
        f = float(np.mean([*left.focal_px, *right.focal_px]))
        reach = np.min([_reach(left, R_left), _reach(right, R_right)], axis=0)
        width, height = (int(np.floor(2 * f * each)) + 1 for each in reach)
        width, height = min(width, MAX_IMAGE_SIDE_PX), min(height, MAX_IMAGE_SIDE_PX)
        camera = _camera(width, height, f, float(np.linalg.norm(T_right_left[:3, 3])))
        K = np.eye(3) * [f, f, 1.0]
        K[:2, 2] = camera.center_px
        maps = []
        for lens, R in ((left, R_left), (right, R_right)):
            fisheye = lens.distortion == "equidistant"
            make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
            size = (width, height)
            columns, rows = make(lens.matrix, lens.parameters, R, K, size, cv2.CV_32FC1)
            maps.append((columns, rows))
        return Rectification(
            camera,
            R_ROBOT_OPTICAL @ R_left.T @ R_ROBOT_OPTICAL.T,
            None,
            (maps[0], maps[1]),
            (left.size_px, right.size_px),
        )

    def apply(self, raw: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Rectify a pair of raw images (H, W) uint8, or float32 for depths.

        Depths are those of the nearest pixel, since a mean over an edge is on neither side.

        Raises:
            InputError: the size of an image differs from that of the calibration.
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
            cv2.remap(
                image, *maps, cv2.INTER_LINEAR if image.dtype == np.uint8 else cv2.INTER_NEAREST
            )
            for image, maps in zip(raw, self.maps, strict=True)
        )
        return left, right


def _centred_span(left: Lens, right: Lens, axis: int) -> tuple[int, int, float]:
    """Return the largest span of columns (rows) around the centre that both images cover.

    Returns:
        Length and first column (row) in the left image, and the remaining offset of the centre
        from the middle of the span in px.
    """
    center = left.center_px[axis]
    shift = round(right.center_px[axis] - center)
    first, last = max(0, -shift), min(left.size_px[axis], right.size_px[axis] - shift) - 1
    side = int(np.floor(2 * min(center - first, last - center) + 0.5)) + 1
    side = min(side, last - first + 1)
    start = round(center - (side - 1) / 2)
    start = min(max(start, first), last - side + 1)
    return side, start, center - start - (side - 1) / 2


def _reach(lens: Lens, R: Float) -> Float:
    """Return tangents (2,) of the half angles of view that an image rotated by R fills."""
    width, height = lens.size_px
    share = np.linspace(0, 1, _BORDER_POINTS)
    u, v = share * (width - 1), share * (height - 1)
    edges = [(0 * v, v), (0 * v + width - 1, v), (u, 0 * u), (u, 0 * u + height - 1)]
    if R[2, 2] < _MIN_COS_ROTATION:
        return np.zeros(2)
    min_tangent = np.full(2, _MAX_TANGENT)
    for k, edge in enumerate(edges):
        rays = lens.rays(np.column_stack(edge)) @ R.T
        axis, sign = divmod(k, 2)  # sign 0 for the low edge, 1 for the high edge
        met = (2 * sign - 1) * rays[:, axis] / rays[:, 2]
        met = met[np.isfinite(met) & (rays[:, 2] > 0)]
        min_tangent[axis] = min(min_tangent[axis], met.min(initial=_MAX_TANGENT))
    return np.maximum(min_tangent, 0.0)


def _camera(width: int, height: int, focal_px: float, baseline_m: float) -> StereoCamera:
    """Return the rectified camera; raise InputError if its images are too small."""
    if min(width, height) < _MIN_SIDE_PX:
        size_text = f"what both cameras see has {width}x{height} px once rectified"
        raise InputError(f"{size_text}, at least {_MIN_SIDE_PX} each way are needed")
    try:
        return StereoCamera(width, height, focal_px, baseline_m)
    except OutOfRangeError as error:
        raise InputError(f"calibration: {error}") from error
