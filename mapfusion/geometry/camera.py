"""Rectified stereo pair of pinhole cameras, and errors of its calibration.

The cameras look along the robot's x axis, unless their mount tilts them. Pixels: u to the right, v
down, the centre of the top left pixel is (0, 0). A point at depth Z has disparity
d = u_left - u_right = f B / Z.

Whoever calibrates a pair of cameras and measures its mount errs once, and every observation is off
by the same. No residual within one map shows it: a map turned about its beginning, or larger by a
share, fits itself as well. Between the maps of two robots it does: T_a_b and what is fused by it
are no surer than the cameras are. Robots whose cameras were calibrated alike err alike, and no
number of them averages it out. Simulated cameras are known exactly.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se3 import tilt
from mapfusion.parameters import Range, require_in_range

MAX_IMAGE_SIDE_PX = 4096  # the software renderer takes seconds and 100 MB a frame at this size


@dataclass(frozen=True)
class StereoCamera:
    """Intrinsics and mount; the defaults are the STH-MDCS2 head (640x480, 1/2" sensor, 6 mm lens).

    Attributes:
        width_px: of either image.
        height_px: of either image.
        focal_px: focal length.
        baseline_m: between the two optical centres; the left one is half of it to the left.
        mount_x_m: of the middle between the optical centres, ahead of the middle of the axles.
        mount_z_m: of the same, above the floor.
        mount_roll_rad: about the axis ahead, the right camera down.
        mount_pitch_rad: about the axis to the left, looking down.
    """

    width_px: Annotated[int, Range(1, MAX_IMAGE_SIDE_PX, "px")] = 640
    height_px: Annotated[int, Range(1, MAX_IMAGE_SIDE_PX, "px")] = 480
    focal_px: Annotated[float, Range(1, 100_000, "px")] = 577.0
    baseline_m: Annotated[float, Range(1e-3, 10, "m")] = 0.09
    mount_x_m: Annotated[float, Range(-10, 10, "m")] = 0.15
    mount_z_m: Annotated[float, Range(0.01, 10, "m")] = 0.45
    mount_roll_rad: Annotated[float, Range(-1, 1, "rad")] = 0.0
    mount_pitch_rad: Annotated[float, Range(-1, 1, "rad")] = 0.0

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def center_px(self) -> tuple[float, float]:
        """Principal point: the middle of the image."""
        return (self.width_px - 1) / 2, (self.height_px - 1) / 2

    @cached_property  # asked for several times a frame
    def camera_axes(self) -> Float:
        """The cameras' axes ahead, left and up, as columns (3, 3) in the robot frame."""
        axes = tilt(self.mount_roll_rad, self.mount_pitch_rad)
        axes.flags.writeable = False
        return axes

    @property
    def p_robot_left(self) -> Float:
        """Optical centre of the left camera in the robot frame (3,)."""
        return self.p_robot_eye(self.baseline_m / 2)

    def p_robot_eye(self, y_m: float) -> Float:
        """Optical centre (3,) of a camera so far to the left of the middle of the pair."""
        middle = np.array([self.mount_x_m, 0.0, self.mount_z_m])
        return middle + y_m * self.camera_axes[:, 1]

    def project(self, p_robot: ArrayLike) -> Float:
        """Points (N, 3) of the robot frame to (N, 3) u, v (left image) and disparity, in pixels."""
        p_camera = (np.asarray(p_robot, dtype=np.float64) - self.p_robot_left) @ self.camera_axes
        depth = p_camera[:, 0]
        center_u, center_v = self.center_px
        return np.stack(
            [
                center_u - self.focal_px * p_camera[:, 1] / depth,
                center_v - self.focal_px * p_camera[:, 2] / depth,
                self.focal_px * self.baseline_m / depth,
            ],
            -1,
        )

    def back_project(self, uv_px: ArrayLike, depth_m: ArrayLike) -> Float:
        """Left pixels (N, 2) at depths (N,) along the optical axis to robot-frame points (N, 3)."""
        uv = np.asarray(uv_px, dtype=np.float64)
        depth = np.asarray(depth_m, dtype=np.float64)
        center_u, center_v = self.center_px
        p_camera = np.stack(
            [
                depth,
                -(uv[:, 0] - center_u) * depth / self.focal_px,
                -(uv[:, 1] - center_v) * depth / self.focal_px,
            ],
            -1,
        )
        return p_camera @ self.camera_axes.T + self.p_robot_left

    def turned(self, uv_px: ArrayLike, R_robot_before: Float) -> Float:
        """Pixels (N, 2) to where far points are seen after the robot has turned about itself.

        `R_robot_before` (3, 3) is how it stood before in the axes that it has now.
        """
        ray = self.back_project(uv_px, np.ones(len(np.asarray(uv_px)))) - self.p_robot_left
        return self.project(ray @ R_robot_before.T + self.p_robot_left)[:, :2]

    def triangulate(
        self,
        uv_px: ArrayLike,
        disparity_px: ArrayLike,
        sigma_uv_px: float,
        sigma_disparity_px: ArrayLike,
    ) -> tuple[Float, Float]:
        """Points (N, 3) of the robot frame and their covariances (N, 3, 3) from matched pixels.

        First-order propagation of independent noise in u, v and disparity through the triangulation
        (this is the R_t of eq. 6): the error along the ray grows with the square of the depth.
        `sigma_disparity_px` is one number or (N,).
        """
        uv = np.asarray(uv_px, dtype=np.float64)
        disparity = np.asarray(disparity_px, dtype=np.float64)
        depth = self.focal_px * self.baseline_m / disparity
        position = self.back_project(uv, depth)
        center_u, center_v = self.center_px
        jacobian = np.zeros((len(uv), 3, 3))  # d(x, y, z) / d(u, v, d)
        jacobian[:, 0, 2] = -depth / disparity
        jacobian[:, 1, 0] = -depth / self.focal_px
        jacobian[:, 1, 2] = (uv[:, 0] - center_u) * depth / (self.focal_px * disparity)
        jacobian[:, 2, 1] = -depth / self.focal_px
        jacobian[:, 2, 2] = (uv[:, 1] - center_v) * depth / (self.focal_px * disparity)
        jacobian = self.camera_axes @ jacobian
        variance = np.empty((len(uv), 3))
        variance[:, :2] = sigma_uv_px**2
        variance[:, 2] = np.asarray(sigma_disparity_px, dtype=np.float64) ** 2
        return position, np.einsum("nij,nj,nkj->nik", jacobian, variance, jacobian)


# Of the middle of a rectified image: checkerboards tell it to about a pixel, and to no more once
# lens and pair were moved to another day's temperature.
_PRINCIPAL_PX = 1.0
_MOUNT_RAD = 0.002  # of the camera's heading on its robot: what measuring a mount reaches, 0.1 deg
# Of depths, by focal length, baseline and the right camera's turn: KITTI's published calibration
# leaves some tenths of a percent (Kreso and Segvic 2015, "Improving the egomotion estimation by
# correcting the calibration bias").
_SCALE = 0.003
_ATTRIBUTES = {"heading_rad": "calibration_heading_rad", "scale": "calibration_scale"}
N_OF_CAMERA = len(_ATTRIBUTES)  # independent errors of a camera
_CAMERA_ATTRIBUTE = "calibration_camera"


@dataclass(frozen=True)
class CalibrationError:
    """Standard deviations of what one robot's observations have in common; independent.

    Attributes:
        heading_rad: of the camera's heading in the robot's frame: its mount, and the middle of its
            image.
        scale: of all lengths, as a share: focal length and baseline.
        camera: whose errors they are: robots that name the same one err alike. Empty: the robot's
            own.
    """

    heading_rad: Annotated[float, Range(0, 1, "rad")] = 0.0
    scale: Annotated[float, Range(0, 1, "1")] = 0.0
    camera: str = ""

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def is_none(self) -> bool:
        """Whether the camera is known exactly."""
        return self.heading_rad == 0 and self.scale == 0

    def is_of_one_camera(self, other: "CalibrationError") -> bool:
        """Whether the other robot's errors are the same."""
        return self.camera != "" and self.camera == other.camera

    def moves_m(self, position_m: Float) -> Float:
        """How far one sigma of each error moves points (N, 2 or 3) of the robot's map: (N, 2, 3).

        In the plane: the map turns about its beginning, and grows. Heights are of the order of the
        camera's own, and roll and pitch are in the observations' covariances.
        """
        x, y = position_m[:, 0], position_m[:, 1]
        moved = np.zeros((len(position_m), N_OF_CAMERA, 3))
        moved[:, 0, 0], moved[:, 0, 1] = -self.heading_rad * y, self.heading_rad * x
        moved[:, 1, 0], moved[:, 1, 1] = self.scale * x, self.scale * y
        return moved

    def attributes(self) -> dict[str, str]:
        """As files have it in their metadata; nothing of a camera that is known exactly."""
        if self.is_none:
            return {}
        told = {key: repr(float(getattr(self, name))) for name, key in _ATTRIBUTES.items()}
        return told | ({_CAMERA_ATTRIBUTE: self.camera} if self.camera else {})


EXACT = CalibrationError()


def calibration_from(attributes: Mapping[str, str], where: object) -> CalibrationError:
    """What a file's metadata tell, EXACT where they tell nothing; raises InputError."""
    try:
        told = {name: float(attributes.get(key, "0")) for name, key in _ATTRIBUTES.items()}
        return CalibrationError(**told, camera=attributes.get(_CAMERA_ATTRIBUTE, ""))
    except ValueError as error:
        keys = " and ".join(_ATTRIBUTES.values())
        raise InputError(f"{where}: {keys} in its metadata: {error}") from error


def default_calibration_error(camera: StereoCamera) -> CalibrationError:
    """Of a camera that somebody calibrated, and said no more."""
    return CalibrationError(math.hypot(_PRINCIPAL_PX / camera.focal_px, _MOUNT_RAD), _SCALE)
