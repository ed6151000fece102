"""Painted world in memory: flat arrays of walls in plan, and of texels."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float
from sim.world import CORNERS, face_files, read_corners, read_picture

REFUSED = "render.renderer: raycast cannot draw {what}; renderer: tiny can"


class Walls(NamedTuple):
    """Faces of walls in plan, all from the floor to the same height.

    Attributes:
        start_m: left ends, seen from the front, shape (F, 2).
        along: unit vectors to the right ends, shape (F, 2).
        width_m: widths, shape (F,).
        height_m: height of all faces.
        size: numbers of texels along and up, shape (F, 2) int64.
        first: start of each face's table in `sums`, shape (F,) int64.
        sums: concatenated summed-area tables of the faces, int32, with shape (texels along + 1,
            texels up + 1) each: sums of all texels left of and below a texel's corner, modulo 2^32.
    """

    start_m: Float
    along: Float
    width_m: Float
    height_m: float
    size: np.ndarray
    first: np.ndarray
    sums: np.ndarray


class HorizontalPlane(NamedTuple):
    """Floor or ceiling with a pyramid of textures.

    Attributes:
        height_m: height above the floor.
        corner_m: lower left corner of the texture, shape (2,).
        right_per_m2: vector along the lower edge, divided by its squared length, shape (2,).
        up_per_m2: vector along the left edge, divided by its squared length, shape (2,).
        size_m: lengths of the edges, shape (2,).
        shape: rows and columns of the K pyramid levels, shape (K, 2) int64.
        first: start of each pyramid level in `cells`, shape (K,) int64.
        cells: squares between the centres of four texels, uint32, rows from the lower edge up. The
            bytes are the grey levels of the texels: lower left, lower right, upper left, upper
            right. A pyramid level of (H, W) texels has (H + 1, W + 1) cells; the outermost cells
            lie half outside.
    """

    height_m: float
    corner_m: Float
    right_per_m2: Float
    up_per_m2: Float
    size_m: Float
    shape: np.ndarray
    first: np.ndarray
    cells: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Static scene.

    Attributes:
        walls: all faces of walls.
        floor: the floor.
        ceiling: the ceiling; without one, a plane at infinity.
    """

    walls: Walls
    floor: HorizontalPlane
    ceiling: HorizontalPlane


def read_scene(folder: Path, channel: int | None = None) -> Scene:
    """Read one colour channel of the world that `sim.world.write_faces` wrote to `folder`.

    Args:
        folder: folder with faces and their textures.
        channel: channel of RGB; None for grey.

    Raises:
        InputError: the ray caster cannot draw the world.
        DamagedFileError: a file is missing or damaged.
    """

    def picture(i: int) -> np.ndarray:
        bgr = read_picture(face_files(folder, i)[1])
        grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY) if channel is None else bgr[:, :, 2 - channel]
        return np.ascontiguousarray(grey[::-1])  # first row along the lower edge

    return make_scene(read_corners(folder / CORNERS), picture)


def make_scene(corners_m: Float, picture: Callable[[int], np.ndarray]) -> Scene:
    """Return the scene of faces with corners (F, 4, 3), see `sim.floorplan.Face`.

    Args:
        corners_m: corners of all faces.
        picture: function that returns the texture of a face, shape (H, W) uint8, its first row
            along the lower edge.

    Raises:
        InputError: the ray caster cannot draw the world.
    """
    heights = corners_m[:, :, 2]
    is_wall = np.ptp(heights, axis=1) > 0
    if not is_wall.any():
        raise InputError(REFUSED.format(what="a world without walls"))
    # walls reach from the floor to one height; other faces are floor or ceiling
    top_m = float(heights[is_wall].max())
    if np.any(heights[is_wall, :2] != 0) or np.any(heights[is_wall, 2:] != top_m):
        raise InputError(REFUSED.format(what="walls of different heights"))
    if not np.all(np.isin(heights[~is_wall], (0.0, top_m))):
        raise InputError(REFUSED.format(what="a ceiling that is not as high as the walls"))
    # walls with their summed-area tables (Crow 1984)
    faces = np.flatnonzero(is_wall)
    start, end = corners_m[faces, 0, :2], corners_m[faces, 1, :2]
    width_m = np.linalg.norm(end - start, axis=1)
    pictures = [picture(int(i)) for i in faces]
    size = np.array([grey.shape[::-1] for grey in pictures])
    ends = np.cumsum(np.prod(size + 1, axis=1))
    first = np.concatenate([[0], ends[:-1]])
    sums = np.zeros(ends[-1], dtype=np.int32)
    for grey, begin, stop in zip(pictures, first, ends, strict=True):
        table = sums[begin:stop].reshape(grey.shape[1] + 1, grey.shape[0] + 1)
        along = np.cumsum(grey.T, axis=0, dtype=np.int32)
        table[1:, 1:] = np.cumsum(along, axis=1, dtype=np.int32, out=along)
    direction = (end - start) / width_m[:, None]
    walls = Walls(start.copy(), direction, width_m, top_m, size, first, sums)
    # floor and ceiling
    planes = {
        float(heights[i, 0]): _make_plane(corners_m[i], picture(i))
        for i in np.flatnonzero(~is_wall).tolist()
    }
    floor = planes.get(0.0, _plane_at_infinity(0.0))
    return Scene(walls, floor, planes.get(top_m, _plane_at_infinity(top_m)))


def _plane_at_infinity(height_m: float) -> HorizontalPlane:
    """Return a plane that no ray meets."""
    corners_m = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    plane = _make_plane(corners_m, np.zeros((1, 1), dtype=np.uint8))
    return plane._replace(height_m=height_m, corner_m=np.full(2, np.inf))


def _make_plane(corners_m: Float, grey: np.ndarray) -> HorizontalPlane:
    """Return a plane with corners (4, 3) and the pyramid of its texture (H, W)."""
    corner, right, _, up = corners_m[:, :2]
    right, up = right - corner, up - corner
    copies: list[np.ndarray] = [grey.astype(np.float32)]
    while min(copies[-1].shape) > 1:
        height, width = copies[-1].shape
        # each texel is the mean over its area, for odd sizes too
        half = (-(-width // 2), -(-height // 2))
        copies.append(cv2.resize(copies[-1], half, interpolation=cv2.INTER_AREA))
    cells = []
    for copy in copies:  # texels beyond the edge repeat the outermost ones
        texels = np.pad(np.rint(copy).astype(np.uint32), 1, mode="edge")
        lower, upper = texels[:-1], texels[1:]
        corners = (lower[:, :-1], lower[:, 1:], upper[:, :-1], upper[:, 1:])
        packed = np.bitwise_or.reduce([texel << 8 * k for k, texel in enumerate(corners)])
        cells.append(packed.ravel())
    first = np.concatenate([[0], np.cumsum([len(copy) for copy in cells])[:-1]])
    return HorizontalPlane(
        float(corners_m[0, 2]),
        corner.copy(),
        right / (right @ right),
        up / (up @ up),
        np.array([np.linalg.norm(right), np.linalg.norm(up)], dtype=np.float64),
        np.array([copy.shape for copy in copies]),
        first,
        np.concatenate(cells),
    )
