"""Frames of a recording, each on its own: any process can render any frame in any order."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.arguments import require_shape
from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.se2 import Float, transform_points
from sim.depth_image import SAME_SURFACE, depth_at
from sim.p3at import P3at
from sim.radiometry import RadiometricNoise
from sim.raycast.caster import RayCaster
from sim.renderer import BulletRenderer, Renderer
from sim.stereo_head import StereoFrame, render_stereo
from sim.visibility import Visibility
from sim.world import OUT_OF_SIGHT_M, World


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
