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
    """Faces of walls in plan, all from the floor to one height.

    Attributes:
        start_m: (F, 2) their left ends, seen from the front.
        along: (F, 2) unit vectors to their right ends.
        width_m: (F,).
        height_m: of all of them.
        size: (F, 2) int64 texels along and up.
        first: (F,) int64, where a face's table begins in `sums`.
        sums: int32, one after the other the faces' tables (texels along + 1, texels up + 1): sums
            of all texels left of and below a texel's corner, modulo 2^32.
    """

    start_m: Float
    along: Float
    width_m: Float
    height_m: float
    size: np.ndarray
    first: np.ndarray
    sums: np.ndarray


class HorizontalPlane(NamedTuple):
    """The floor or the ceiling.

    Attributes:
        height_m: above the floor.
        corner_m: (2,) where its picture begins, lower left.
        right_per_m2: (2,) along the picture's lower edge, divided by the edge's length squared.
        up_per_m2: (2,) along its left edge, likewise.
        size_m: (2,) its edges' lengths.
        shape: (K, 2) int64 rows and columns of the picture and of its smaller copies.
        first: (K,) int64, where each begins in `cells`.
        cells: uint32, rows from the lower edge up: what lies between the middles of four texels,
            whose grey levels are its bytes: lower left, lower right, upper left, upper right. A
            copy of (H, W) texels has (H + 1, W + 1) cells, the outermost half beside it.
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
    """What stands still.

    Attributes:
        walls: all faces of walls.
        floor: below.
        ceiling: above; where there is none, one that is nowhere.
    """

    walls: Walls
    floor: HorizontalPlane
    ceiling: HorizontalPlane


def read_scene(folder: Path, channel: int | None = None) -> Scene:
    """The world that `sim.world.write_faces` left in `folder`, as one channel of its colours.

    Args:
        folder: with faces and their pictures.
        channel: of RGB; None for grey.

    Raises:
        InputError: it holds what the ray caster cannot draw.
        DamagedFileError: a file is missing or damaged.
    """

    def picture(i: int) -> np.ndarray:
        return _read_picture(face_files(folder, i)[1], channel)

    return make_scene(read_corners(folder / CORNERS), picture)


def make_scene(corners_m: Float, picture: Callable[[int], np.ndarray]) -> Scene:
    """The world of faces with corners (F, 4, 3), see `sim.floorplan.Face`.

    Args:
        corners_m: of all faces.
        picture: of a face: (H, W) uint8, its first row along the lower edge.

    Raises:
        InputError: it holds what the ray caster cannot draw.
    """
    heights = corners_m[:, :, 2]
    is_wall = np.ptp(heights, axis=1) > 0
    if not is_wall.any():
        raise InputError(REFUSED.format(what="a world without walls"))
    top_m = float(heights[is_wall].max())
    _require_drawable(corners_m, is_wall, top_m)
    walls = _walls(corners_m, np.flatnonzero(is_wall), top_m, picture)
    levels = {float(heights[i, 0]): _level(corners_m[i], picture(i)) for i in _others(is_wall)}
    floor = levels.get(0.0, _nowhere(0.0))
    return Scene(walls, floor, levels.get(top_m, _nowhere(top_m)))


def _others(is_wall: np.ndarray) -> list[int]:
    return np.flatnonzero(~is_wall).tolist()


def _require_drawable(corners_m: Float, is_wall: np.ndarray, top_m: float) -> None:
    """Upright walls from the floor to one height, nothing level but floor and ceiling."""
    walls, levels = corners_m[is_wall], corners_m[~is_wall]
    one_height = np.all(walls[:, :2, 2] == 0) and np.all(walls[:, 2:, 2] == top_m)
    if not one_height:
        raise InputError(REFUSED.format(what="walls of different heights"))
    if not np.all(np.isin(levels[:, :, 2], (0.0, top_m))):
        raise InputError(REFUSED.format(what="a ceiling that is not as high as the walls"))


def _read_picture(path: Path, channel: int | None) -> np.ndarray:
    """(H, W) uint8, its first row along the lower edge."""
    image = read_picture(path)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if channel is None else image[:, :, 2 - channel]
    return np.ascontiguousarray(grey[::-1])


def _walls(
    corners_m: Float, faces: np.ndarray, top_m: float, picture: Callable[[int], np.ndarray]
) -> Walls:
    start, end = corners_m[faces, 0, :2], corners_m[faces, 1, :2]
    width_m = np.linalg.norm(end - start, axis=1)
    pictures = [picture(int(i)) for i in faces]
    size = np.array([grey.shape[::-1] for grey in pictures])
    ends = np.cumsum(np.prod(size + 1, axis=1))
    first = np.concatenate([[0], ends[:-1]])
    sums = np.zeros(ends[-1], dtype=np.int32)
    for grey, begin, stop in zip(pictures, first, ends, strict=True):
        table = sums[begin:stop].reshape(grey.shape[1] + 1, grey.shape[0] + 1)
        table[1:, 1:] = _sums(grey)
    along = (end - start) / width_m[:, None]
    return Walls(start.copy(), along, width_m, top_m, size, first, sums)


def _sums(grey: np.ndarray) -> np.ndarray:
    """Summed-area table (W, H) int32 of a picture (H, W), by columns (Crow 1984)."""
    along = np.cumsum(grey.T, axis=0, dtype=np.int32)
    return np.cumsum(along, axis=1, dtype=np.int32, out=along)


def _nowhere(height_m: float) -> HorizontalPlane:
    corners_m = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    level = _level(corners_m, np.zeros((1, 1), dtype=np.uint8))
    return level._replace(height_m=height_m, corner_m=np.full(2, np.inf))


def _level(corners_m: Float, grey: np.ndarray) -> HorizontalPlane:
    corner, right, _, up = corners_m[:, :2]
    right, up = right - corner, up - corner
    copies: list[np.ndarray] = [grey.astype(np.float32)]
    while min(copies[-1].shape) > 1:
        height, width = copies[-1].shape
        # of odd sizes too each texel is the mean of what it covers
        half = (-(-width // 2), -(-height // 2))
        copies.append(cv2.resize(copies[-1], half, interpolation=cv2.INTER_AREA))
    cells = [_cells(copy) for copy in copies]
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


def _cells(grey: np.ndarray) -> np.ndarray:
    """A picture's cells, see `Level`; beyond its edge its outermost texels go on."""
    texels = np.pad(np.rint(grey).astype(np.uint32), 1, mode="edge")
    lower, upper = texels[:-1], texels[1:]
    corners = (lower[:, :-1], lower[:, 1:], upper[:, :-1], upper[:, 1:])
    return np.bitwise_or.reduce([grey << 8 * k for k, grey in enumerate(corners)]).ravel()
