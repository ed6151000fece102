"""Rectified stereo pair of pinhole cameras, and errors of its calibration.

The cameras look along the robot's x axis, unless their mount tilts them. Pixels: u to the right, v
down, the centre of the top left pixel is (0, 0). A point at depth Z has disparity
d = u_left - u_right = f B / Z.

An error of the calibration or of the mount affects all observations of a robot in the same way. The
residuals within one map do not show the error: a map rotated about its origin or scaled has the
same residuals. The error affects T_a_b between the maps of two robots, and the fused map. Robots
with the same calibration share the error, so averaging over robots does not remove it. Simulated
cameras are known exactly.
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
        width_px: width of both images.
        height_px: height of both images.
        focal_px: focal length.
        baseline_m: distance of the two optical centres.
        mount_x_m: distance of the middle of the optical centres ahead of the middle of the axles.
        mount_z_m: height of the middle of the optical centres above the floor.
        mount_roll_rad: rotation about the axis ahead; positive lowers the right camera.
        mount_pitch_rad: rotation about the axis to the left; positive looks down.
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
        """Principal point, in the middle of the image."""
        return (self.width_px - 1) / 2, (self.height_px - 1) / 2

    @cached_property  # used several times per frame
    def camera_axes(self) -> Float:
        """Camera axes ahead, left and up in the robot frame, as columns (3, 3)."""
        axes = tilt(self.mount_roll_rad, self.mount_pitch_rad)
        axes.flags.writeable = False
        return axes

    @property
    def p_robot_left(self) -> Float:
        """Optical centre of the left camera in the robot frame (3,)."""
        return self.p_robot_eye(self.baseline_m / 2)

    def p_robot_eye(self, y_m: float) -> Float:
        """Return the optical centre (3,) of a camera at `y_m` to the left of the pair's middle."""
        middle = np.array([self.mount_x_m, 0.0, self.mount_z_m])
        return middle + y_m * self.camera_axes[:, 1]

    def project(self, p_robot: ArrayLike) -> Float:
        """Project points (N, 3) of the robot frame.

        Returns:
            u and v in the left image, and disparity, pixels, shape (N, 3).
        """
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
        """Return points (N, 3) of the robot frame at left pixels (N, 2) and depths (N,)."""
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

    def rotate_pixels(self, uv_px: ArrayLike, R_robot_before: Float) -> Float:
        """Return the pixels of far points after a rotation of the robot.

        Args:
            uv_px: pixels before the rotation, shape (N, 2).
            R_robot_before: axes of the robot before, in its axes after, shape (3, 3).
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
        """Triangulate matched pixels.

        First-order propagation of independent noise in u, v and disparity (R_t of eq. 6): the error
        along the ray grows with the square of the depth.

        Args:
            uv_px: pixels of the left image, shape (N, 2).
            disparity_px: disparities, shape (N,).
            sigma_uv_px: standard deviation of u and v.
            sigma_disparity_px: standard deviation of the disparity, a number or shape (N,).

        Returns:
            Points of the robot frame, shape (N, 3), and their covariances, shape (N, 3, 3).
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


# Standard deviations of a usual calibration. Checkerboards determine the principal point to about a
# pixel, and temperature changes it afterwards.
_PRINCIPAL_PX = 1.0
_MOUNT_RAD = 0.002  # heading of the camera on its robot: accuracy of a measured mount, 0.1 deg
# Scale of the depths, by focal length, baseline and rotation of the right camera: errors of KITTI's
# published calibration are some tenths of a percent (Kreso and Segvic 2015, "Improving the
# egomotion estimation by correcting the calibration bias").
_SCALE = 0.003
_ATTRIBUTES = {"heading_rad": "calibration_heading_rad", "scale": "calibration_scale"}
N_OF_CAMERA = len(_ATTRIBUTES)  # number of independent errors of a camera
_CAMERA_ATTRIBUTE = "calibration_camera"


@dataclass(frozen=True)
class CalibrationError:
    """Standard deviations of the independent errors that all observations of a robot share.

    Attributes:
        heading_rad: heading of the camera in the robot frame, by mount and principal point.
        scale: relative error of all lengths, by focal length and baseline.
        camera: name of the camera; robots with the same name share the error. Empty for the robot's
            own camera.
    """

    heading_rad: Annotated[float, Range(0, 1, "rad")] = 0.0
    scale: Annotated[float, Range(0, 1, "1")] = 0.0
    camera: str = ""

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def is_none(self) -> bool:
        """True if the camera is known exactly."""
        return self.heading_rad == 0 and self.scale == 0

    def is_of_one_camera(self, other: "CalibrationError") -> bool:
        """Return True if two robots share the errors of one camera."""
        return self.camera != "" and self.camera == other.camera

    def moves_m(self, position_m: Float) -> Float:
        """Return the displacement of points of the robot's map by one sigma of each error.

        The heading error rotates the map about its origin, the scale error enlarges it. Errors of
        heights are neglected; those of roll and pitch are part of the observations' covariances.

        Args:
            position_m: points, shape (N, 2) or (N, 3).

        Returns:
            Displacements, shape (N, 2, 3).
        """
        x, y = position_m[:, 0], position_m[:, 1]
        moved = np.zeros((len(position_m), N_OF_CAMERA, 3))
        moved[:, 0, 0], moved[:, 0, 1] = -self.heading_rad * y, self.heading_rad * x
        moved[:, 1, 0], moved[:, 1, 1] = self.scale * x, self.scale * y
        return moved

    def attributes(self) -> dict[str, str]:
        """Return the metadata of files; empty for a camera that is known exactly."""
        if self.is_none:
            return {}
        sigmas = {key: repr(float(getattr(self, name))) for name, key in _ATTRIBUTES.items()}
        return sigmas | ({_CAMERA_ATTRIBUTE: self.camera} if self.camera else {})


EXACT = CalibrationError()


def calibration_from(attributes: Mapping[str, str], where: object) -> CalibrationError:
    """Read the calibration error from a file's metadata; EXACT if the metadata have none.

    Raises:
        InputError: a value is no number or out of its range; names the file `where`.
    """
    try:
        sigmas = {name: float(attributes.get(key, "0")) for name, key in _ATTRIBUTES.items()}
        return CalibrationError(**sigmas, camera=attributes.get(_CAMERA_ATTRIBUTE, ""))
    except ValueError as error:
        keys = " and ".join(_ATTRIBUTES.values())
        raise InputError(f"{where}: {keys} in its metadata: {error}") from error


def default_calibration_error(camera: StereoCamera) -> CalibrationError:
    """Return the usual errors of a calibrated camera without stated uncertainty."""
    return CalibrationError(math.hypot(_PRINCIPAL_PX / camera.focal_px, _MOUNT_RAD), _SCALE)
