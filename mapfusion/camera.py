"""A rectified pair of pinhole cameras on a robot, and what its pixels mean in metres.

The cameras look along the robot's x axis, unless their mount tilts them. Pixels: u to the right, v
down, the centre of the top left pixel is (0, 0). A point at depth Z has disparity
d = u_left - u_right = f B / Z.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.arguments import Range, require_in_range
from mapfusion.se2 import Float
from mapfusion.se3 import tilt

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
