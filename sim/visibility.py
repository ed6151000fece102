"""Which faces a camera can see at all: the renderer pays for every face ahead, hidden or not.

Walls are upright and TinyRenderer samples each pixel column along one vertical plane, so in plan a
column is one ray, and what lies behind the first wall that reaches the ceiling shows nowhere.
"""

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.se2 import Float, compose

MARGIN_M = 1e-3  # a face is taken as so much wider when it is seen, narrower when it hides others


class Visibility:
    """Sorts out the faces that neither camera of a robot can see.

    Args:
        corners_m: (F, 4, 3) of the world's faces, see `sim.floorplan.Face`.
        camera: its columns are the rays.
    """

    def __init__(self, corners_m: Float, camera: StereoCamera) -> None:
        self._camera = camera
        self._tilts = camera.mount_roll_rad != 0 or camera.mount_pitch_rad != 0
        heights = corners_m[:, :, 2]
        self._is_wall = np.ptp(heights, axis=1) > 0
        self._is_ceiling = ~self._is_wall & (heights[:, 0] > camera.mount_z_m)
        walls = corners_m[self._is_wall]
        self._start, edge = walls[:, 0, :2], walls[:, 1, :2] - walls[:, 0, :2]
        self._width_m = np.linalg.norm(edge, axis=1)
        self._along = edge / self._width_m[:, None]
        top_m = heights.max()  # a camera above it looks over all walls
        self._hides = (walls[:, 2, 2] >= top_m) & (top_m > camera.mount_z_m)
        center_u, center_v = camera.center_px
        to_left = (center_u - np.arange(camera.width_px)) / camera.focal_px
        self._ray = np.stack([np.ones_like(to_left), to_left], -1)  # in the camera's frame
        to_ceiling_m = top_m - camera.mount_z_m
        self._ceiling_from_m = to_ceiling_m * camera.focal_px / center_v - MARGIN_M

    def seen(self, T_world_robot: Float) -> np.ndarray:
        """Mask (F,) over the faces: False only where no pixel of either image shows the face.

        A robot at a pose (4, 4) may tilt: its columns are no rays in plan, and nothing is left out.
        """
        if self._tilts or np.ndim(T_world_robot) == 2:
            return np.ones(len(self._is_wall), dtype=bool)
        camera, half = self._camera, self._camera.baseline_m / 2
        left, right = (compose(T_world_robot, [camera.mount_x_m, y, 0.0]) for y in (half, -half))
        return self._seen_by_one(left) | self._seen_by_one(right)

    def _seen_by_one(self, T_world_camera: Float) -> np.ndarray:
        cos, sin = np.cos(T_world_camera[2]), np.sin(T_world_camera[2])
        ray = self._ray @ np.array([[cos, sin], [-sin, cos]])
        to_eye = T_world_camera[:2] - self._start
        # distance of the eye before a face's plane, and how fast each ray nears it
        front = np.stack([self._along[:, 1], -self._along[:, 0]])
        before = np.sum(to_eye.T * front, axis=0)
        nearing = -ray @ front
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where((before > 0) & (nearing > 0), before / nearing, np.inf)
            where = np.sum(to_eye * self._along, axis=1) + depth * (ray @ self._along.T)
        inside = np.minimum(where, self._width_m - where)  # below 0 or NaN: the ray misses
        hidden_beyond = np.where(self._hides & (inside > MARGIN_M), depth, np.inf).min(axis=1)
        shows = (inside > -MARGIN_M) & (depth <= hidden_beyond[:, None] + MARGIN_M)
        seen = np.ones(len(self._is_wall), dtype=bool)
        seen[self._is_wall] = np.any(shows, axis=0)
        seen[self._is_ceiling] = hidden_beyond.max() > self._ceiling_from_m
        return seen
