"""The stereo head: what a rectified pair of pinhole cameras on a robot sees of a world."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mapfusion.camera import StereoCamera
from mapfusion.se2 import Float
from mapfusion.se3 import from_planar, pose
from sim.exposure import expose
from sim.radiometry import RadiometricNoise
from sim.world import World

NEAR_M = 0.1  # nearer than any wall can come to the lens
FAR_M = 100.0  # beyond the largest building's diagonal
LAMP_M = (0.0, 0.0, 1000.0)  # so far above that its light is parallel
BACKGROUND_M = 0.99 * FAR_M  # an untouched depth buffer is not exactly 1


@dataclass(frozen=True)
class StereoFrame:
    """What one robot sees at one moment.

    Attributes:
        left: (H, W) uint8 gray.
        right: (H, W) uint8 gray.
        depth_m: (H, W) float32 along the optical axis of the left camera; NaN where nothing is.
        left_rgb: (H, W, 3) uint8 without noise, for people; None where nobody asked for it.
    """

    left: np.ndarray
    right: np.ndarray
    depth_m: np.ndarray
    left_rgb: np.ndarray | None


def render_stereo(
    world: World,
    camera: StereoCamera,
    T_world_robot: ArrayLike,
    noise: RadiometricNoise,
    rng: np.random.Generator,
) -> StereoFrame:
    """Render both images and the left one's depth for a robot.

    Its pose is (3,), or (4, 4) where its body tilts.
    """
    left_rgba, buffer = _render(world, camera, T_world_robot, camera.baseline_m / 2)
    right_rgba, _ = _render(world, camera, T_world_robot, -camera.baseline_m / 2)
    left, right = (cv2.cvtColor(rgba, cv2.COLOR_RGBA2GRAY) for rgba in (left_rgba, right_rgba))
    left_rgb = cv2.cvtColor(left_rgba, cv2.COLOR_RGBA2RGB)
    depth_m = _metric_depth(buffer)
    return StereoFrame(expose(left, noise, rng), expose(right, noise, rng), depth_m, left_rgb)


def _render(
    world: World, camera: StereoCamera, T_world_robot: ArrayLike, y_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """RGBA (H, W, 4) uint8 and the depth buffer (H, W) of a camera beside the robot's middle."""
    p, tiny = world.bullet, world.renderer == "tiny"
    # EGL takes no coefficients; a lamp along all meshes' normals shows the texture as painted
    lamp = {} if tiny else {"lightDirection": LAMP_M}
    _, _, rgba, buffer, _ = p.getCameraImage(
        camera.width_px,
        camera.height_px,
        viewMatrix=_view_matrix(camera_pose(camera, T_world_robot, y_m)),
        projectionMatrix=_projection_matrix(camera, sampled_at_px=0.0 if tiny else 0.5),
        shadow=0,
        # the texture as painted: a wall looks the same from everywhere
        lightAmbientCoeff=1.0,
        lightDiffuseCoeff=0.0,
        lightSpecularCoeff=0.0,
        renderer=p.ER_TINY_RENDERER if tiny else p.ER_BULLET_HARDWARE_OPENGL,
        flags=p.ER_NO_SEGMENTATION_MASK,
        physicsClientId=world.client,
        **lamp,
    )
    shape = (camera.height_px, camera.width_px)
    return np.reshape(rgba, (*shape, 4)).astype(np.uint8, copy=False), np.reshape(buffer, shape)


def camera_pose(camera: StereoCamera, T_world_robot: ArrayLike, y_m: float) -> Float:
    """T_world_camera (4, 4): x along the optical axis, y left, z up.

    Args:
        camera: how the pair is mounted.
        T_world_robot: (3,), or (4, 4) of a body that tilts.
        y_m: of the camera, to the left of the middle of the pair.
    """
    return body_pose(T_world_robot) @ _mounted(camera, y_m)


def body_pose(T_world_robot: ArrayLike) -> Float:
    """T_world_robot (4, 4) of a body at a pose (3,), or (4, 4) where it tilts."""
    T = np.asarray(T_world_robot, dtype=np.float64)
    return T if T.shape == (4, 4) else from_planar(T)


@functools.lru_cache(maxsize=4)
def _mounted(camera: StereoCamera, y_m: float) -> Float:
    """T_robot_camera (4, 4)."""
    return pose(camera.camera_axes, camera.p_robot_eye(y_m))


def _view_matrix(T_world_camera: Float) -> list[float]:
    """World to OpenGL's camera (x right, y up, z backwards), column by column."""
    ahead, left, up = T_world_camera[:3, :3].T
    matrix = np.eye(4)
    matrix[:3, :3] = [-left, up, -ahead]
    matrix[:3, 3] = -matrix[:3, :3] @ T_world_camera[:3, 3]
    return matrix.T.ravel().tolist()


def _projection_matrix(camera: StereoCamera, sampled_at_px: float) -> list[float]:
    """Exact pinhole, column by column.

    The principal point belongs on pixel (width - 1) / 2. TinyRenderer samples pixel i at the
    coordinate i of a viewport that is `width` wide, so there the middle of its frustum falls on
    width / 2, half a pixel off; OpenGL samples at i + 1/2, where nothing is to be mended.
    """
    off_px = 1 - 2 * sampled_at_px
    width, height, f = camera.width_px, camera.height_px, camera.focal_px
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 2] = 2 * f / width, off_px / width
    matrix[1, 1], matrix[1, 2] = 2 * f / height, off_px / height
    matrix[2, 2] = -(FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    matrix[2, 3] = -2 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    matrix[3, 2] = -1
    return matrix.T.ravel().tolist()


def _metric_depth(buffer: np.ndarray) -> np.ndarray:
    depth = FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * buffer.astype(np.float64))
    depth[depth > BACKGROUND_M] = np.nan
    return depth.astype(np.float32)
