"""Frame source: render any frame of a simulation, in any order and process.

Walls are upright and TinyRenderer samples each pixel column along one vertical plane. So in plan a
column is one ray, and the first wall that reaches the ceiling hides everything behind it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float, require_shape
from mapfusion.geometry.se2 import compose, transform_points
from sim.p3at import P3at
from sim.renderer import BulletRenderer, Renderer
from sim.rendering.ray_caster import RayCaster
from sim.stereo_head import SAME_SURFACE, RadiometricNoise, StereoFrame, depth_at, render_stereo
from sim.world import OUT_OF_SIGHT_M, World

MARGIN_M = 1e-3  # faces are widened by it when they are visible, narrowed when they occlude


class Visibility:
    """Visibility of faces from the cameras of a robot.

    Args:
        corners_m: corners of the world's faces, shape (F, 4, 3), see `sim.floorplan.Face`.
        camera: stereo camera, whose pixel columns are the rays.
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
        """Return a mask (F,) of faces, False only if no pixel of either image shows the face.

        The columns of a tilted camera are not rays in plan, so for a pose (4, 4) all are True.
        """
        if self._tilts or np.ndim(T_world_robot) == 2:
            return np.ones(len(self._is_wall), dtype=bool)
        camera, half = self._camera, self._camera.baseline_m / 2
        left, right = (compose(T_world_robot, [camera.mount_x_m, y, 0.0]) for y in (half, -half))
        return self._seen_by_one(left) | self._seen_by_one(right)

    def _seen_by_one(self, T_world_camera: Float) -> np.ndarray:
        """Return the mask (F,) of faces for one camera at a pose (3,)."""
        cos, sin = np.cos(T_world_camera[2]), np.sin(T_world_camera[2])
        ray = self._ray @ np.array([[cos, sin], [-sin, cos]])
        to_eye = T_world_camera[:2] - self._start
        # distance from a face's plane to the eye, and its decrease along each ray
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


class _Bullet:
    """PyBullet world with the bodies of all robots."""

    def __init__(
        self, faces: Path, camera: StereoCamera, robots: int, renderer: BulletRenderer
    ) -> None:
        self._camera = camera
        self._world = World(renderer)
        self._visibility = Visibility(self._world.add_painted_faces(faces), camera)
        self._bodies = [P3at(self._world, np.zeros(3)) for _ in range(robots)]

    def close(self) -> None:
        self._world.close()

    def render(
        self, poses: Float, index: int, noise: RadiometricNoise, rng: np.random.Generator
    ) -> StereoFrame:
        for i, (body, pose) in enumerate(zip(self._bodies, poses, strict=True)):
            body.place(pose, OUT_OF_SIGHT_M if i == index else 0.0)  # it does not see itself
        self._world.show_faces(self._visibility.seen(poses[index]))
        return render_stereo(self._world, self._camera, poses[index], noise, rng)


class FrameSource:
    """Rendered images of a world with robots, for a `with` block.

    Args:
        faces: folder that `sim.world.write_faces` wrote.
        camera: stereo camera of all robots.
        robots: names of the robots.
        renderer: renderer; raises InputError if it does not work.
    """

    def __init__(
        self,
        faces: Path,
        camera: StereoCamera,
        robots: Sequence[str],
        renderer: Renderer = "tiny",
    ) -> None:
        self._robots = list(robots)
        self._drawn: RayCaster | _Bullet
        if renderer == "raycast":
            self._drawn = RayCaster(faces, camera)
        else:
            self._drawn = _Bullet(faces, camera, len(self._robots), renderer)

    def __enter__(self) -> "FrameSource":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the renderer's world."""
        if isinstance(self._drawn, _Bullet):
            self._drawn.close()

    def render(
        self,
        T_world_robots: ArrayLike,
        robot: str,
        noise: RadiometricNoise,
        rng: np.random.Generator,
        colour: bool = True,
    ) -> StereoFrame:
        """Render the images of one robot.

        Args:
            T_world_robots: poses of all robots in the order of their names, shape (R, 3), or
                (R, 4, 4) for tilted bodies. The ray caster draws the other robots upright.
            robot: name of the robot.
            noise: sensor noise.
            rng: random generator.
            colour: False if the colour image is not needed.
        """
        poses = np.asarray(T_world_robots, dtype=np.float64)
        shape = (4, 4) if poses.ndim == 3 else (3,)
        require_shape("T_world_robots", poses, (len(self._robots), *shape))
        if robot not in self._robots:
            raise InputError(f"robot {robot}: unknown, there are {', '.join(self._robots)}")
        index = self._robots.index(robot)
        if isinstance(self._drawn, _Bullet):
            return self._drawn.render(poses, index, noise, rng)
        others = np.delete(poses, index, axis=0)
        return self._drawn.stereo(poses[index], others, noise, rng, colour)


def truth_behind(
    camera: StereoCamera, depth_m: np.ndarray, uv_px: ArrayLike, T_world_robot: ArrayLike
) -> tuple[Float, Float]:
    """Return world points at pixels of the left image, and their derivatives by the pixel.

    Between pixels of one surface the inverse depth is interpolated, which is linear in the image of
    a plane. At the edge of a surface the depth of the nearest pixel is used.

    Args:
        camera: camera of the image.
        depth_m: depth along the optical axis, shape (H, W).
        uv_px: pixels, shape (N, 2).
        T_world_robot: robot pose, shape (3,), or (4, 4) for a tilted body.

    Returns:
        Points (N, 3), NaN for the background, and their derivatives (N, 3, 2) by the pixel on the
        same surface: the difference to the next pixel, or to the previous pixel if the next one
        shows another surface; 0 if both do.
    """
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    steps = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], dtype=np.float64)
    there = (uv + steps[:, None]).reshape(-1, 2)
    depth = depth_at(depth_m, there)
    p_robot, T = camera.back_project(there, depth), np.asarray(T_world_robot, dtype=np.float64)
    p_world = (
        p_robot @ T[:3, :3].T + T[:3, 3] if T.shape == (4, 4) else transform_points(T, p_robot)
    )
    point = p_world.reshape(5, -1, 3)
    depth = depth.reshape(5, -1)
    same = (np.abs(depth - depth[0]) <= SAME_SURFACE * depth[0])[:, :, None]
    slope = np.empty((len(uv), 3, 2))
    for axis, (before, after) in enumerate(((1, 2), (3, 4))):
        back = np.where(same[before], -(point[before] - point[0]), 0.0)
        slope[:, :, axis] = np.where(same[after], point[after] - point[0], back)
    return point[0], slope
