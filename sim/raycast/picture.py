"""Whole pictures: each pixel the mean of its footprint, or the texel that its middle hits."""

import cv2
import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from sim.raycast.levels import BACKGROUND, Way, fill, row_depth_m, texel, ways
from sim.raycast.plan import NONE, Pinhole, nearest, project, strips
from sim.raycast.robots import cast, draw
from sim.raycast.scene import Level, Walls
from sim.raycast.solids import Solids
from sim.raycast.wall_columns import draw_walls, open_rows
from sim.raycast.windows import by_distance


def filtered(
    camera: Pinhole, walls: Walls, floor: Level, ceiling: Level, solids: Solids, poses: Float,
    grey: Float,
) -> np.ndarray:  # fmt: skip
    """Grey levels (H, W) uint8, each the mean over the pixel's footprint.

    Args:
        camera: level.
        walls: as they stand.
        floor: below.
        ceiling: above.
        solids: of one robot.
        poses: (R, 3) of the robots in the world.
        grey: (S,) the solids' grey levels.
    """
    seen = project(camera, walls)
    face, until, count = strips(camera, seen)
    above, below = open_rows(camera, walls, seen, face, until, count)
    picture = np.empty((camera.height_px, camera.width_px), dtype=np.uint8)
    fill(camera, ceiling, True, above, picture)
    fill(camera, floor, False, below, picture)
    # walls are drawn by columns, which in a picture lie far apart in memory
    columns = cv2.transpose(picture)
    draw_walls(camera, walls, seen, face, until, count, columns)
    picture = cv2.transpose(columns)
    if len(poses):
        in_order = by_distance(camera, poses)
        draw(camera, seen, face, until, count, solids, in_order, grey, picture)
    return picture


def depths(
    camera: Pinhole, walls: Walls, floor: Level, ceiling: Level, solids: Solids, poses: Float
) -> np.ndarray:
    """Depth (H, W) float32 along the optical axis behind the pixels' middles; NaN for nothing."""
    depth_m = _still_depths(camera, walls, floor, ceiling)
    nothing = np.zeros((0, 0), dtype=np.uint8)
    if len(poses):
        cast(camera, solids, poses, np.zeros(0), depth_m, nothing)
    return depth_m


@kernel
def _still_depths(camera: Pinhole, walls: Walls, floor: Level, ceiling: Level) -> np.ndarray:
    """Depth (H, W) of what stands still."""
    seen = project(camera, walls)
    face = nearest(seen, np.arange(camera.width_px).astype(np.float64))
    wall_m = np.full(camera.width_px, np.inf, dtype=np.float32)
    for j in range(camera.width_px):
        if face[j] != NONE:
            wall_m[j] = 1 / (seen[face[j], 2] + seen[face[j], 3] * j)
    depth_m = np.empty((camera.height_px, camera.width_px), dtype=np.float32)
    for v in range(camera.height_px):
        level = ceiling if v < camera.center_v else floor
        level_m = np.float32(row_depth_m(camera, level.height_m, float(v)))
        for j in range(camera.width_px):
            depth_m[v, j] = min(wall_m[j], level_m)
    for j in range(camera.width_px):  # only a column without walls shows where floors end
        if face[j] == NONE:
            for v in range(camera.height_px):
                level = ceiling if v < camera.center_v else floor
                right, up = ways(camera, level)
                z = row_depth_m(camera, level.height_m, float(v))
                if not (0 <= _along(right, j, z) < 1 and 0 <= _along(up, j, z) < 1):
                    depth_m[v, j] = np.nan
    return depth_m


def sampled(
    camera: Pinhole, walls: Walls, floor: Level, ceiling: Level, solids: Solids, poses: Float,
    grey: Float,
) -> np.ndarray:  # fmt: skip
    """Grey levels (H, W) uint8 of what the pixels' middles hit; arguments as of `filtered`."""
    picture = _still_texels(camera, walls, floor, ceiling)
    if len(poses):
        cast(camera, solids, poses, grey, _still_depths(camera, walls, floor, ceiling), picture)
    return picture


@kernel
def _still_texels(camera: Pinhole, walls: Walls, floor: Level, ceiling: Level) -> np.ndarray:
    """Texels (H, W) uint8 of what stands still."""
    seen = project(camera, walls)
    face = nearest(seen, np.arange(camera.width_px).astype(np.float64))
    picture = np.empty((camera.height_px, camera.width_px), dtype=np.uint8)
    ways_up, ways_down = ways(camera, ceiling), ways(camera, floor)
    for j in range(camera.width_px):
        i, wall_m, right = face[j], np.inf, 0
        if i != NONE:
            wall_m = 1 / (seen[i, 2] + seen[i, 3] * j)
            along = (seen[i, 4] + seen[i, 5] * j) * wall_m - seen[i, 6]
            right = int(along / walls.width_m[i] * walls.size[i, 0])
            right = min(max(right, 0), walls.size[i, 0] - 1)
        for v in range(camera.height_px):
            level, way = (ceiling, ways_up) if v < camera.center_v else (floor, ways_down)
            z = row_depth_m(camera, level.height_m, float(v))
            if wall_m < z:
                height_m = camera.eye_z_m - (v - camera.center_v) * wall_m / camera.focal_px
                row = min(int(height_m / walls.height_m * walls.size[i, 1]), walls.size[i, 1] - 1)
                picture[v, j] = _wall_texel(walls, i, right, row)
            elif np.isfinite(z):
                picture[v, j] = texel(level, _along(way[0], j, z), _along(way[1], j, z))
            else:
                picture[v, j] = BACKGROUND
    return picture


@kernel
def _along(way: Way, u: float, z: float) -> float:
    """Where on a level's picture a column's ray is at a depth, see `ways`."""
    return way[0] + (way[1] + way[2] * u) * z


@kernel_part
def _wall_texel(walls: Walls, i: int, right: int, up: int) -> float:
    n = walls.size[i, 1] + 1
    here = walls.first[i] + right * n + up
    there = here + n
    sums = walls.sums
    return float(np.int32(sums[there + 1] - sums[there] - sums[here + 1] + sums[here]))
