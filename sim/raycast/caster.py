"""The ray caster: what a rectified pair of cameras sees of a painted world and of other robots."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.se2 import Float, compose
from sim.exposure import expose
from sim.p3at import URDF
from sim.radiometry import RadiometricNoise
from sim.raycast.picture import depths, filtered, sampled
from sim.raycast.plan import Pinhole
from sim.raycast.scene import REFUSED, Scene, read_scene
from sim.raycast.solids import read_solids
from sim.stereo_head import NEAR_M, StereoFrame

Sampling = Literal["footprint", "middle"]


class RayCaster:
    """Draws a painted world with robots in it.

    Args:
        faces: folder that `sim.world.write_faces` has filled.
        camera: of the robot that looks.
        sampling: a pixel is the mean over its footprint, or what its middle hits.

    Raises:
        InputError: the world or the camera is one that it cannot draw.
        DamagedFileError: a file of the folder is missing or damaged.
    """

    def __init__(self, faces: Path, camera: StereoCamera, sampling: Sampling = "footprint") -> None:
        self._faces, self._camera, self._sampling = faces, camera, sampling
        self._scene = read_scene(faces)
        top_m = self._scene.walls.height_m
        if camera.mount_z_m >= top_m:
            raise InputError(
                REFUSED.format(what=f"from {camera.mount_z_m:g} m above walls of {top_m:g} m")
            )
        self._channels: list[Scene] = []
        self._solids = read_solids(URDF)
        rgb = self._solids.rgb.astype(np.uint8)[None]
        self._grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[0].astype(np.float64)

    def stereo(
        self,
        T_world_robot: ArrayLike,
        others: ArrayLike,
        noise: RadiometricNoise,
        rng: np.random.Generator,
        colour: bool = False,
    ) -> StereoFrame:
        """Both images and the left one's depth for a robot at a pose (3,), others at (R, 3)."""
        half_m = self._camera.baseline_m / 2
        left, right = (self.grey(T_world_robot, y_m, others) for y_m in (half_m, -half_m))
        depth_m = self.depth_m(T_world_robot, half_m, others)
        rgb = self.rgb(T_world_robot, half_m, others) if colour else None
        return StereoFrame(expose(left, noise, rng), expose(right, noise, rng), depth_m, rgb)

    def grey(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """The grey picture (H, W) uint8 of a camera beside a robot's middle.

        Args:
            T_world_robot: (3,).
            y_m: of the optical centre, to the left of the robot's axis.
            others: (R, 3) poses of the robots that may be seen.
        """
        return self._draw(self._scene, T_world_robot, y_m, others, self._grey)

    def rgb(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """The same in colour (H, W, 3) uint8; three times the work and the memory."""
        if not self._channels:
            self._channels = [read_scene(self._faces, channel) for channel in range(3)]
        colours = self._solids.rgb.T
        drawn = [
            self._draw(scene, T_world_robot, y_m, others, colour.copy())
            for scene, colour in zip(self._channels, colours, strict=True)
        ]
        return np.stack(drawn, -1)

    def depth_m(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """Depth (H, W) float32 along the optical axis behind each pixel's middle; NaN: nothing."""
        scene, camera = self._scene, self._pinhole(T_world_robot, y_m)
        return depths(camera, scene.walls, scene.floor, scene.ceiling, self._solids, _poses(others))

    def _draw(
        self, scene: Scene, T_world_robot: ArrayLike, y_m: float, others: ArrayLike, grey: Float
    ) -> np.ndarray:
        kernel = filtered if self._sampling == "footprint" else sampled
        camera = self._pinhole(T_world_robot, y_m)
        return kernel(
            camera, scene.walls, scene.floor, scene.ceiling, self._solids, _poses(others), grey
        )

    def _pinhole(self, T_world_robot: ArrayLike, y_m: float) -> Pinhole:
        camera = self._camera
        x, y, theta = compose(T_world_robot, [camera.mount_x_m, y_m, 0.0]).tolist()
        center_u, center_v = camera.center_px
        size = (camera.width_px, camera.height_px)
        focal_px, z_m = float(camera.focal_px), float(camera.mount_z_m)
        return Pinhole(*size, focal_px, center_u, center_v, x, y, z_m, theta, NEAR_M)


def _poses(others: ArrayLike) -> Float:
    return np.ascontiguousarray(others, dtype=np.float64).reshape(-1, 3)
