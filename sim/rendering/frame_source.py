"""Frame source: render any frame of a simulation, in any order and process.

Walls are upright and TinyRenderer samples each pixel column along one vertical plane, so in plan a
column is one ray, and what lies behind the first wall that reaches the ceiling shows nowhere.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.errors import InputError
from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, transform_points
from mapfusion.parameters import require_shape
from sim.p3at import P3at
from sim.renderer import BulletRenderer, Renderer
from sim.rendering.ray_caster import RayCaster
from sim.stereo_head import SAME_SURFACE, RadiometricNoise, StereoFrame, depth_at, render_stereo
from sim.world import OUT_OF_SIGHT_M, World

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


class _Bullet:
    """PyBullet's world with all robots' bodies in it."""

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
        self, poses: Float, own: int, noise: RadiometricNoise, rng: np.random.Generator
    ) -> StereoFrame:
        for i, (body, pose) in enumerate(zip(self._bodies, poses, strict=True)):
            body.place(pose, OUT_OF_SIGHT_M if i == own else 0.0)  # it does not see itself
        self._world.show_faces(self._visibility.seen(poses[own]))
        return render_stereo(self._world, self._camera, poses[own], noise, rng)


class FrameSource:
    """A world with all robots' bodies; renders what one of them sees. Use it in a `with` block.

    Args:
        faces: folder that `sim.world.write_faces` has filled.
        camera: of all robots.
        robots: their names.
        renderer: what draws; raises InputError where it cannot.
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
        """Free the world."""
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
        """What `robot` sees when the robots (in the order of their names) stand at poses (R, 3).

        Bodies that tilt have poses (R, 4, 4); the ray caster draws the other robots upright.
        Without `colour` the frame may come without its picture in colour, which takes time.
        """
        poses = np.asarray(T_world_robots, dtype=np.float64)
        shape = (4, 4) if poses.ndim == 3 else (3,)
        require_shape("T_world_robots", poses, (len(self._robots), *shape))
        if robot not in self._robots:
            raise InputError(f"robot {robot}: unknown, there are {', '.join(self._robots)}")
        own = self._robots.index(robot)
        if isinstance(self._drawn, _Bullet):
            return self._drawn.render(poses, own, noise, rng)
        others = np.delete(poses, own, axis=0)
        return self._drawn.stereo(poses[own], others, noise, rng, colour)


def truth_behind(
    camera: StereoCamera, depth_m: np.ndarray, uv_px: ArrayLike, T_world_robot: ArrayLike
) -> tuple[Float, Float]:
    """World points behind pixels (N, 2) of the left image, and how they move with the pixel.

    Between pixels of one surface the inverse depth is interpolated (it is linear in the image for a
    plane); at the edge of a surface the nearest pixel's depth counts.

    Args:
        camera: of the image.
        depth_m: (H, W) along the optical axis.
        uv_px: pixels.
        T_world_robot: the robot's pose (3,), or (4, 4) where its body tilts.

    Returns:
        Points (N, 3), NaN where nothing is, and their derivatives (N, 3, 2) by the pixel on the
        surface that is seen there: the difference to the next pixel, or to the one before where
        that is another surface's; 0 where both are.
    """
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    steps = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], dtype=np.float64)
    there = (uv + steps[:, None]).reshape(-1, 2)
    depth = depth_at(depth_m, there)
    point = _in_world(T_world_robot, camera.back_project(there, depth)).reshape(5, -1, 3)
    depth = depth.reshape(5, -1)
    same = (np.abs(depth - depth[0]) <= SAME_SURFACE * depth[0])[:, :, None]
    slope = np.empty((len(uv), 3, 2))
    for axis, (before, after) in enumerate(((1, 2), (3, 4))):
        back = np.where(same[before], -(point[before] - point[0]), 0.0)
        slope[:, :, axis] = np.where(same[after], point[after] - point[0], back)
    return point[0], slope


def _in_world(T_world_robot: ArrayLike, p_robot: Float) -> Float:
    T = np.asarray(T_world_robot, dtype=np.float64)
    if T.shape == (4, 4):
        return p_robot @ T[:3, :3].T + T[:3, 3]
    return transform_points(T, p_robot)
