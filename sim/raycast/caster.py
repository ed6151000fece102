"""The ray caster: what a rectified pair of cameras sees of a painted world and of other robots."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from mapfusion.se2 import Float
from mapfusion.se3 import planar
from sim.exposure import expose
from sim.p3at import URDF
from sim.radiometry import RadiometricNoise
from sim.raycast.picture import Sight, depths, filtered, sampled, sight
from sim.raycast.plan import Pinhole
from sim.raycast.scene import REFUSED, Scene, read_scene
from sim.raycast.solids import read_solids
from sim.raycast.tilted import TiltedView
from sim.stereo_head import NEAR_M, StereoFrame, body_pose, camera_pose

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
        if camera.mount_z_m >= self._scene.walls.height_m:
            raise self._too_high(camera.mount_z_m)
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
        """Both images and the left one's depth for a robot, others at (R, 3).

        It is at a pose (3,), or (4, 4) where its body tilts; raises InputError where it looks from
        above the walls, or too far up or down.
        """
        half_m, poses, body = self._camera.baseline_m / 2, _poses(others), body_pose(T_world_robot)
        view = self._view(body, half_m)
        seen = self._sight(view, poses)
        left, depth_m = self._draw(self._scene, view, seen, self._grey), self._depth_m(view, seen)
        right = self.grey(body, -half_m, poses)
        rgb = self.rgb(body, half_m, poses) if colour else None
        return StereoFrame(expose(left, noise, rng), expose(right, noise, rng), depth_m, rgb)

    def grey(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """The grey picture (H, W) uint8 of a camera beside a robot's middle.

        Args:
            T_world_robot: (3,), or (4, 4) of a body that tilts.
            y_m: of the optical centre, to the left of the robot's axis.
            others: (R, 3) poses of the robots that may be seen.
        """
        view = self._view(T_world_robot, y_m)
        return self._draw(self._scene, view, self._sight(view, _poses(others)), self._grey)

    def rgb(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """The same in colour (H, W, 3) uint8; three times the work and the memory."""
        if not self._channels:
            self._channels = [read_scene(self._faces, channel) for channel in range(3)]
        view = self._view(T_world_robot, y_m)
        seen, colours = self._sight(view, _poses(others)), self._solids.rgb.T
        drawn = [
            self._draw(scene, view, seen, colour)
            for scene, colour in zip(self._channels, colours, strict=True)
        ]
        return np.stack(drawn, -1)

    def depth_m(self, T_world_robot: ArrayLike, y_m: float, others: ArrayLike) -> np.ndarray:
        """Depth (H, W) float32 along the optical axis behind each pixel's middle; NaN: nothing."""
        view = self._view(T_world_robot, y_m)
        return self._depth_m(view, self._sight(view, _poses(others)))

    def _sight(self, view: Pinhole | TiltedView, poses: Float) -> Sight:
        camera = view if isinstance(view, Pinhole) else view.level
        return sight(camera, self._scene.walls, self._solids, poses)

    def _depth_m(self, view: Pinhole | TiltedView, seen: Sight) -> np.ndarray:
        found = depths(seen, self._scene, self._solids)
        return found if isinstance(view, Pinhole) else view.depth_m(found)

    def _draw(
        self, scene: Scene, view: Pinhole | TiltedView, seen: Sight, grey: Float
    ) -> np.ndarray:
        kind = filtered if self._sampling == "footprint" else sampled
        drawn = kind(seen, scene, self._solids, grey)
        return drawn if isinstance(view, Pinhole) else view.picture(drawn)

    def _view(self, T_world_robot: ArrayLike, y_m: float) -> Pinhole | TiltedView:
        """A level camera, which can be drawn as it is, or a tilted one."""
        T = camera_pose(self._camera, T_world_robot, y_m)
        eye_z_m = float(T[2, 3])
        if eye_z_m >= self._scene.walls.height_m:
            raise self._too_high(eye_z_m)
        if T[2, 0] or T[2, 1]:
            return TiltedView.of(self._camera, T)
        camera, theta = self._camera, float(np.arctan2(T[1, 0], T[0, 0]))
        size, x, y = (camera.width_px, camera.height_px), float(T[0, 3]), float(T[1, 3])
        focal_px = float(camera.focal_px)
        return Pinhole(*size, focal_px, *camera.center_px, x, y, eye_z_m, theta, NEAR_M)

    def _too_high(self, eye_z_m: float) -> InputError:
        top_m = self._scene.walls.height_m
        return InputError(REFUSED.format(what=f"from {eye_z_m:g} m above walls of {top_m:g} m"))


def _poses(others: ArrayLike) -> Float:
    """Poses (R, 3) of robots that are drawn upright, whether they tilt or not."""
    found = np.asarray(others, dtype=np.float64)
    return np.ascontiguousarray(planar(found) if found.ndim == 3 else found).reshape(-1, 3)
