"""What a calibration says: two lenses, and how the right camera stands to the left one.

Optical axes: x to the right, y down, z ahead, as all calibrations have them. Pixels as in
`camera.py`: the centre of the top left pixel is (0, 0).
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from mapfusion.camera import MAX_IMAGE_SIDE_PX
from mapfusion.errors import InputError
from mapfusion.se2 import Float

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
