"""Small scenes whose pictures are known, and the cameras that look at them."""

from collections.abc import Callable

import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.geometry.se2 import compose
from sim.p3at import URDF
from sim.rendering.ray_caster import find_visible, render_filtered
from sim.rendering.robots import read_solids
from sim.rendering.scene import Scene, make_scene
from sim.rendering.walls import Pinhole

NOBODY = np.zeros((0, 3))
SOLIDS = read_solids(URDF)
GREY = np.zeros(len(SOLIDS.rgb))
HEIGHT_M, TEXELS_PER_M = 2.5, 250


def pinhole(camera: StereoCamera, T_world_robot: np.ndarray, y_m: float = 0.0) -> Pinhole:
    """One of a robot's cameras."""
    x, y, theta = compose(T_world_robot, [camera.mount_x_m, y_m, 0.0]).tolist()
    size = (camera.width_px, camera.height_px)
    return Pinhole(*size, camera.focal_px, *camera.center_px, x, y, camera.mount_z_m, theta, 0.1)


def one_wall(
    start: np.ndarray, end: np.ndarray, grey: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Scene:
    """A single wall seen from the right of its way; `grey` of metres along and up, broadcast."""
    corners = np.zeros((4, 3))
    corners[:, :2] = [start, end, end, start]
    corners[2:, 2] = HEIGHT_M
    n = round(float(np.linalg.norm(end - start)) * TEXELS_PER_M)
    along = (np.arange(n) + 0.5) * np.linalg.norm(end - start) / n
    up = (np.arange(round(HEIGHT_M * TEXELS_PER_M)) + 0.5)[:, None] / TEXELS_PER_M
    picture = np.rint(np.broadcast_to(grey(along, up), (len(up), n))).astype(np.uint8)
    return make_scene(corners[None], lambda _: picture)


def slanted(distance_m: float, slant_rad: float, half_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends of a wall whose middle lies ahead on the x axis, turned from facing it by a slant."""
    middle = np.array([distance_m, 0.0])
    to_right = np.array([np.sin(slant_rad), -np.cos(slant_rad)])
    return middle - half_m * to_right, middle + half_m * to_right


def look(scene: Scene, camera: Pinhole) -> np.ndarray:
    """The filtered picture (H, W) as float64, nobody else in view."""
    seen = find_visible(camera, scene.walls, SOLIDS, NOBODY)
    return render_filtered(seen, scene, SOLIDS, GREY).astype(np.float64)


def along_m(start: np.ndarray, end: np.ndarray, camera: Pinhole, u: np.ndarray) -> np.ndarray:
    """Return where rays through columns `u` meet a wall's line, in metres from its start."""
    left = (camera.center_u - u) / camera.focal_px
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    ray = np.stack([cos - left * sin, sin + left * cos], -1)
    along = (end - start) / np.linalg.norm(end - start)
    to_start = start - np.array([camera.eye_x_m, camera.eye_y_m])
    # eye + z ray = start + t along
    cross = ray[..., 0] * along[1] - ray[..., 1] * along[0]
    return (to_start[0] * ray[..., 1] - to_start[1] * ray[..., 0]) / cross
