"""Whole pictures: each pixel the mean of its footprint, or the texel that its middle hits."""

import functools
import math
from typing import NamedTuple

import cv2
import numpy as np

from mapfusion.geometry.numerics import Float
from sim.raycast.floor_and_ceiling import Way, fill, row_depth_m, texels, ways
from sim.raycast.robots import Body, by_distance, cast, draw, is_hidden, place, within_view
from sim.raycast.scene import Level, Scene, Walls
from sim.raycast.solids import Solids
from sim.raycast.visible_walls import NONE, Pinhole, Plan, anywhere, look
from sim.raycast.wall_columns import draw_walls


class Sight(NamedTuple):
    """Where things are before a camera, whatever their colours.

    Attributes:
        camera: level.
        plan: what it sees of the walls.
        bodies: the robots that walls do not hide, from the nearest to the farthest.
    """

    camera: Pinhole
    plan: Plan
    bodies: list[Body]


def sight(camera: Pinhole, walls: Walls, solids: Solids, poses: Float) -> Sight:
    """What a camera has before it, robots at poses (R, 3) among it."""
    plan, bodies = look(camera, walls), list[Body]()
    for pose in by_distance(camera, within_view(camera, solids.reach_m, poses)):
        if not is_hidden(camera, plan, solids.reach_m, pose):
            bodies.append(place(camera, solids, pose))
    return Sight(camera, plan, [body for body in bodies if len(body.shown)])


def filtered(of: Sight, scene: Scene, solids: Solids, grey: Float) -> np.ndarray:
    """Grey levels (H, W) uint8, each the mean over the pixel's footprint.

    Args:
        of: what the camera has before it.
        scene: what stands still.
        solids: of one robot.
        grey: (S,) the solids' grey levels.
    """
    camera, plan = of.camera, of.plan
    picture = np.empty((camera.height_px, camera.width_px), dtype=np.uint8)
    fill(camera, scene.ceiling, True, plan.above, picture)
    fill(camera, scene.floor, False, plan.below, picture)
    # walls are drawn by columns, which in a picture lie far apart in memory
    columns = cv2.transpose(picture)
    draw_walls(camera, scene.walls, plan, columns)
    picture = cv2.transpose(columns)
    if of.bodies:
        draw(camera, plan, solids, of.bodies, grey, picture)
    return picture


def depths(of: Sight, scene: Scene, solids: Solids) -> np.ndarray:
    """Depth (H, W) float32 along the optical axis behind the pixels' middles; NaN for nothing."""
    depth_m = _still_depths(of, scene)
    cast(of.camera, solids, of.bodies, np.zeros(len(solids.rgb)), depth_m)
    if np.any(of.plan.middle == NONE):
        depth_m[np.isinf(depth_m)] = np.nan
    return depth_m


def _still_depths(of: Sight, scene: Scene) -> np.ndarray:
    """Depth (H, W) of what stands still; infinity for nothing."""
    camera, plan = of.camera, of.plan
    levels_m = _depths_of_levels(anywhere(camera), scene.floor.height_m, scene.ceiling.height_m)
    depth_m = np.empty((camera.height_px, camera.width_px), dtype=np.float32)
    np.minimum(plan.middle_m.astype(np.float32), levels_m.astype(np.float32)[:, None], out=depth_m)
    beside = np.flatnonzero(plan.middle == NONE)
    if len(beside):  # only a column without walls shows where floors end
        for level, rows in _sides(camera, scene):
            z = levels_m[rows, None]
            right, up = (_along(way, beside, z) for way in ways(camera, level))
            inside = (right >= 0) & (right < 1) & (up >= 0) & (up < 1)
            depth_m[rows, beside] = np.where(inside, z, np.inf)
    return depth_m


@functools.lru_cache(maxsize=1)
def _depths_of_levels(camera: Pinhole, floor_m: float, ceiling_m: float) -> Float:
    """Depths (H,) of floor and ceiling at two heights, were there no walls."""
    v = np.arange(camera.height_px)
    height_m = np.where(v < camera.center_v, ceiling_m, floor_m)
    return row_depth_m(camera, height_m, v)


def _sides(camera: Pinhole, scene: Scene) -> list[tuple[Level, slice]]:
    """Ceiling and floor, and the rows on their side of the horizon."""
    horizon = min(max(math.ceil(camera.center_v), 0), camera.height_px)
    return [(scene.ceiling, slice(horizon)), (scene.floor, slice(horizon, camera.height_px))]


def sampled(of: Sight, scene: Scene, solids: Solids, grey: Float) -> np.ndarray:
    """Grey levels (H, W) uint8 of what the pixels' middles hit; arguments as of `filtered`."""
    picture = _still_texels(of, scene)
    cast(of.camera, solids, of.bodies, grey, _still_depths(of, scene), picture)
    return picture


def _still_texels(of: Sight, scene: Scene) -> np.ndarray:
    """Texels (H, W) uint8 of what stands still."""
    camera, plan, walls, u = of.camera, of.plan, scene.walls, np.arange(of.camera.width_px)
    face, wall_m = plan.middle, plan.middle_m
    seen, size = plan.seen[face], walls.size[face]
    levels_m = _depths_of_levels(anywhere(camera), scene.floor.height_m, scene.ceiling.height_m)
    along = np.where(face == NONE, 0.0, (seen[:, 4] + seen[:, 5] * u) * wall_m - seen[:, 6])
    right = np.clip(along / walls.width_m[face] * size[:, 0], 0, size[:, 0] - 1).astype(np.int64)
    first = walls.first[face] + right * (size[:, 1] + 1)
    picture = np.empty((camera.height_px, camera.width_px), dtype=np.uint8)
    for level, rows in _sides(camera, scene):
        to_right, to_up = (_along(way, u, levels_m[rows, None]) for way in ways(camera, level))
        picture[rows] = texels(level, to_right, to_up)
    v, j = np.nonzero(wall_m < levels_m[:, None])
    height_m = camera.eye_z_m - (v - camera.center_v) * wall_m[j] / camera.focal_px
    up = (height_m / walls.height_m * size[j, 1]).astype(np.int64)
    here = first[j] + np.minimum(up, size[j, 1] - 1)
    there, sums = here + size[j, 1] + 1, walls.sums
    picture[v, j] = sums[there + 1] - sums[there] - sums[here + 1] + sums[here]
    return picture


def _along(way: Way, u: np.ndarray, z: Float) -> Float:
    """Where on a level's picture columns' rays are at depths, see `ways`; NaN infinitely far."""
    with np.errstate(invalid="ignore"):
        return way[0] + (way[1] + way[2] * u) * z
