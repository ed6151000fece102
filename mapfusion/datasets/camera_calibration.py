"""Camera calibration of a recording: lenses, calibration files, rectification.

Optical axes: x to the right, y down, z ahead, as all calibrations have them. Pixels as in
`camera.py`: the centre of the top left pixel is (0, 0).

A pair whose calibration says that it is rectified already keeps its grey levels: its images are
cropped so that the principal point lies in the middle, to a quarter of a pixel, and the rest is a
turn of the camera. Any other pair is drawn anew by OpenCV (bilinear), in the largest rectangle that
both images fill.
"""

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.geometry.camera import MAX_IMAGE_SIDE_PX, StereoCamera
from mapfusion.geometry.numerics import Float

Distortion = Literal["none", "radial-tangential", "equidistant"]
# k1 k2 p1 p2 and then k3 (Brown 1966), or four of the angle's odd powers (Kannala, Brandt 2006).
_COEFFICIENTS: dict[Distortion, tuple[int, ...]] = {
    "none": (0,),
    "radial-tangential": (4, 5),
    "equidistant": (4,),
}
_LARGEST_FOCAL_PX = 1e5
_ROTATION_TOLERANCE = 1e-4  # calibrations are printed with six digits and more
# Optical axes in the robot's: x ahead, y left, z up.
R_ROBOT_OPTICAL: Float = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
R_ROBOT_OPTICAL.setflags(write=False)


@dataclass(frozen=True)
class Lens:
    """One camera.

    Attributes:
        size_px: width and height of its images.
        focal_px: along u and v.
        center_px: principal point, u and v.
        distortion: what bends its rays: nothing, Brown's polynomial, or Kannala and Brandt's.
        coefficients: of that, as OpenCV orders them.
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
        """K (3, 3)."""
        (fu, fv), (cu, cv) = self.focal_px, self.center_px
        return np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Float:
        """The coefficients as OpenCV takes them."""
        return np.array(self.coefficients or (0.0,) * 4)

    def rays(self, uv_px: Float) -> Float:
        """Where the rays (N, 3) of pixels (N, 2) meet the plane one metre ahead; z is 1.

        NaN for pixels that look sideways or back, whose rays never meet it.
        """
        points = np.ascontiguousarray(uv_px, dtype=np.float64).reshape(-1, 1, 2)
        if self.distortion == "equidistant":
            flat = cv2.fisheye.undistortPoints(points, self.matrix, self.parameters)
        else:
            flat = cv2.undistortPoints(points, self.matrix, self.parameters)
        flat = flat.reshape(-1, 2)
        # beyond a right angle the inverse of the polynomial ends anywhere, as a rule mirrored
        ahead = np.sum(flat * (uv_px - np.array(self.center_px)), axis=1) >= 0
        return np.column_stack([np.where(ahead[:, None], flat, np.nan), np.ones(len(flat))])


@dataclass(frozen=True)
class StereoCalibration:
    """A pair of cameras; `T_left_right` (4, 4) in optical axes, metres."""

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
    """Raise InputError unless a matrix is a rigid motion of space (4, 4)."""
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
    """A pinhole camera with its distortion.

    Args:
        where: file and place in it, for messages.
        camera: its mapping, with `camera_model: pinhole`, `intrinsics: [fu, fv, cu, cv]`,
            `resolution: [width, height]`, `distortion_model` and `distortion_coefficients`.

    Raises:
        InputError: one line that begins with `where`.
    """
    model = camera.get("camera_model", "pinhole")
    if model != "pinhole":
        raise InputError(f"{where}: camera_model: is {model!r}, only pinhole is read")
    named = str(camera.get("distortion_model", "none"))
    if named not in _DISTORTIONS:
        known = ", ".join(_DISTORTIONS)
        raise InputError(f"{where}: distortion_model: {named!r} is unknown; known: {known}")
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
    """A rigid motion (4, 4): rows of numbers, 16 numbers, or EuRoC's mapping with `data`.

    Args:
        where: file and place in it, for messages.
        key: of the motion.
        holder: the mapping that holds it.

    Raises:
        InputError: one line that begins with `where`.
    """
    value, wanted = holder.get(key), "4 rows of 4 numbers"
    if isinstance(value, Mapping):
        key, value = f"{key}.data", value.get("data")
    if value is None:
        raise InputError(f"{where}: {key}: is missing, expected {wanted}")
    try:
        T = np.array(value, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {key}: is {_short(value)}, expected {wanted}") from None
    try:
        require_rigid(key, T)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return T


def _short(value: Any) -> str:
    """A value as messages show it."""
    flat = (
        [each for row in value for each in (row if isinstance(row, list) else [row])]
        if (isinstance(value, list))
        else []
    )
    is_numbers = flat and all(isinstance(each, int | float) for each in flat)
    return f"{len(flat)} numbers" if is_numbers else reprlib.repr(value)


def parse_section(where: Path, document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A mapping within a document; raises InputError where there is none."""
    found = document.get(key)
    if not isinstance(found, Mapping):
        what = "is missing" if found is None else f"is {_short(found)}"
        raise InputError(f"{where}: {key}: {what}, expected a mapping")
    return found


def _numbers(
    where: str, camera: Mapping[str, Any], key: str, n: int | None, names: tuple[str, ...]
) -> list[float]:
    value: Any = camera.get(key)
    is_list = isinstance(value, list) and all(
        isinstance(each, int | float) and not isinstance(each, bool) for each in value
    )
    if not is_list or (n is not None and len(value) != n):
        wanted = f"a list [{', '.join(names)}]" if names else "a list of numbers"
        what = "is missing" if value is None else f"is {reprlib.repr(value)}"
        raise InputError(f"{where}: {key}: {what}, expected {wanted}")
    return [float(each) for each in value]


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
