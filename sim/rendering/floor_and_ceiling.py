"""Floor and ceiling: mean texture over the footprint of each pixel.

A row of a level camera shows a horizontal plane at one depth, Z = h f / |v - c|. The footprint of a
pixel is Z / f wide and Z^2 / (h f) deep, so at large depths it is long, narrow and rotated against
the texels. It is sampled bilinearly along its length, from the pyramid level whose texels are as
large as its width (Heckbert 1989, section 3; McCormack et al. 1999, Feline).
"""

import functools
import math

import numpy as np
from numpy.typing import ArrayLike

from mapfusion.geometry.numerics import Float, kernel
from sim.rendering.scene import HorizontalPlane
from sim.rendering.walls import Pinhole, at_origin

BACKGROUND = 255.0  # grey level of the background in PyBullet
MOST_SAMPLES = 64  # most samples along a footprint
STEP_TEXELS = 2.0  # distance between samples; textures have a low pass of one texel
# Fixed-point numbers, which halve the time of loops: positions in 2^-22 cells, shares of a cell in
# 2^-8, sums in 2^-16 grey levels. Sums of 2 x MOST_SAMPLES values of 255 fit into 32 bits, and so
# do positions along PIECE pixels of at most two cells each.
PLACE_BITS, SHARE_BITS, PIECE = 22, 8, 128
PLACE_UNIT, SUM_UNIT = 1 << PLACE_BITS, 1 << 2 * SHARE_BITS
MOST_CELLS = 2 * PIECE
TO_SHARE = np.uint32(PLACE_BITS - SHARE_BITS)
WHOLE_SHARE, LOW_SHARE = np.uint32(1 << SHARE_BITS), np.uint32((1 << SHARE_BITS) - 1)
FIRST_AND_THIRD = np.uint32(0x00FF00FF)  # mask of these bytes of a cell
BYTE, HALF, LOW_HALF = np.uint32(8), np.uint32(16), np.uint32(0xFFFF)

RayCoefficients = tuple[float, float, float]
Line = tuple[float, float, float, float]  # x, y and their steps from pixel to pixel
Size = tuple[int, int]  # rows and columns of a pyramid level


def row_depth_m(camera: Pinhole, height_m: ArrayLike, v: ArrayLike) -> Float:
    """Return depths (N,) at which rays of rows (N,) meet planes; infinity without intersection."""
    down = (np.asarray(v) - camera.center_v) / camera.focal_px
    drop = camera.eye_z_m - np.asarray(height_m)
    with np.errstate(divide="ignore"):
        return np.where(drop * down > 0, drop / down, np.inf)


def footprints(camera: Pinhole, level: HorizontalPlane) -> np.ndarray:
    """Return the sampling of each row: samples along, samples across and pyramid level, (H, 3)."""
    per_m = float(level.shape[0, 1] / level.size_m[0])
    return _footprints(at_origin(camera), level.height_m, per_m, len(level.first))


@functools.lru_cache(maxsize=8)
def _footprints(camera: Pinhole, height_m: float, per_m: float, copies: int) -> np.ndarray:
    """Return `footprints` for a number of texels per metre and of pyramid levels."""
    edges_m = row_depth_m(camera, height_m, np.arange(camera.height_px + 1) - 0.5)
    z = row_depth_m(camera, height_m, np.arange(camera.height_px))
    seen = np.isfinite(edges_m[:-1]) & np.isfinite(edges_m[1:])
    along = np.abs(edges_m[1:][seen] - edges_m[:-1][seen]) * per_m
    across = z[seen] / camera.focal_px * per_m
    # the pyramid level at which footprints are at most two texels wide
    mantissa, halvings = np.frexp(across)
    k = np.clip(halvings - np.where(mantissa > 0.5, 1, 2), 0, copies - 1)
    across, along = np.ldexp(across, -k), np.ldexp(along, -k)
    plan = np.zeros((camera.height_px, 3), dtype=np.int64)
    plan[seen, 0] = np.clip(np.ceil(along / STEP_TEXELS), 1, MOST_SAMPLES)
    plan[seen, 1] = np.where(across <= 1, 1, 2)
    plan[seen, 2] = k
    return plan


def ray_coefficients(
    camera: Pinhole, level: HorizontalPlane
) -> tuple[RayCoefficients, RayCoefficients]:
    """Return coefficients a, b, c of texture coordinates of rays: right = a + (b + c u) Z, and up.

    Both coordinates are 0 to 1 on the texture.
    """
    cos, sin = math.cos(camera.theta), math.sin(camera.theta)
    left = camera.center_u / camera.focal_px
    corner_x, corner_y = level.corner_m.tolist()
    x0, y0 = camera.eye_x_m - corner_x, camera.eye_y_m - corner_y
    dx, dy = cos - left * sin, sin + left * cos

    def along(x: float, y: float) -> RayCoefficients:
        return x * x0 + y * y0, x * dx + y * dy, (x * sin - y * cos) / camera.focal_px

    return along(*level.right_per_m2.tolist()), along(*level.up_per_m2.tolist())


def draw_plane(
    camera: Pinhole,
    level: HorizontalPlane,
    is_above: bool,
    open_rows: np.ndarray,
    picture: np.ndarray,
) -> None:
    """Draw floor or ceiling in pixels that walls leave open on its side of the horizon.

    Args:
        camera: level camera.
        level: floor or ceiling.
        is_above: True if the plane lies above the horizon.
        open_rows: number of open rows of each column, from the image's edge on, shape (W,).
        picture: image, shape (H, W) uint8; changed.
    """
    plan, way = footprints(camera, level), ray_coefficients(camera, level)
    rise = (camera.eye_z_m - level.height_m) * camera.focal_px
    texels = level.shape, level.first, level.cells
    _fill(*texels, plan, way, rise, camera.center_v, is_above, open_rows, picture)


@kernel
def _fill(
    shape: np.ndarray,
    firsts: np.ndarray,
    cells: np.ndarray,
    plan: np.ndarray,
    way: tuple[RayCoefficients, RayCoefficients],
    rise: float,
    center_v: float,
    is_above: bool,
    open_rows: np.ndarray,
    picture: np.ndarray,
) -> None:
    """Draw row by row: the footprints of a row have one depth and lie on a line."""
    height, width = picture.shape
    (right_0, right_z, right_zu), (up_0, up_z, up_zu) = way
    place, cell = np.empty((3, PIECE), dtype=np.int32), np.empty(PIECE, dtype=np.uint32)
    sums = np.empty(PIECE, dtype=np.uint32)
    for first in range(0, width, PIECE):
        last = min(first + PIECE, width)
        least = most = open_rows[first]
        for j in range(first, last):
            least, most = min(least, open_rows[j]), max(most, open_rows[j])
        for row in range(most):
            v = row if is_above else height - 1 - row
            n, across, k = plan[v, 0], plan[v, 1], plan[v, 2]
            size, corner = (shape[k, 0], shape[k, 1]), int(firsts[k])
            end = first
            while end < last:
                begin, end = end, last
                if row >= least:  # the next open columns
                    while begin < last and row >= open_rows[begin]:
                        begin += 1
                    end = begin
                    while end < last and row < open_rows[end]:
                        end += 1
                count = end - begin
                value = SUM_UNIT * int(BACKGROUND) if n == 0 else 0
                for i in range(count):
                    sums[i] = value
                for side in range(across):
                    u = begin + (0.0 if across == 1 else side / 2 - 0.25)
                    for s in range(n if count else 0):
                        z = rise / (v - 0.5 + (s + 0.5) / n - center_v)
                        # the line of the row's footprints on the pyramid level, from `u` on
                        line = (
                            (right_0 + (right_z + right_zu * u) * z) * size[1] + 0.5,
                            (up_0 + (up_z + up_zu * u) * z) * size[0] + 0.5,
                            right_zu * z * size[1],
                            up_zu * z * size[0],
                        )
                        lowest, leftmost = _lowest_cell(line, count, size)
                        if lowest < 0:
                            _add_at_the_edge(cells, corner, line, size, count, sums)
                        else:
                            wide = size[1] + 1
                            # positions relative to the lowest cell, and cell indices
                            x, y, x_step, y_step = line
                            first_x, first_y = x - leftmost, y - lowest
                            from_x, step_x = (
                                np.int32(first_x * PLACE_UNIT),
                                np.int32(x_step * PLACE_UNIT),
                            )
                            from_y, step_y = (
                                np.int32(first_y * PLACE_UNIT),
                                np.int32(y_step * PLACE_UNIT),
                            )
                            stride = np.int32(wide)
                            for i in range(count):
                                at_x = np.int32(from_x + np.int32(step_x * np.int32(i)))
                                at_y = np.int32(from_y + np.int32(step_y * np.int32(i)))
                                place[0, i], place[1, i] = at_x, at_y
                                place[2, i] = np.int32((at_y >> PLACE_BITS) * stride) + (
                                    at_x >> PLACE_BITS
                                )
                            _look_up(cells, corner + lowest * wide + leftmost, place, count, cell)
                            for i in range(count):
                                sums[i] += _between(
                                    cell[i], np.uint32(place[0, i]), np.uint32(place[1, i])
                                )
                # draw rounded means of samples from column `begin` on
                samples = max(n * across, 1)
                scale, at = np.float32(1 / (SUM_UNIT * samples)), np.uintp(begin)
                for i in range(count):
                    shown = np.int32(scale * np.float32(sums[i]) + np.float32(0.5))
                    picture[v, at + np.uintp(i)] = np.uint8(shown)


@kernel
def _lowest_cell(line: Line, count: int, size: Size) -> tuple[int, int]:
    """Return the lowest row and column of a line's cells; -1 near the edge or if too long."""
    x, y, x_step, y_step = line
    height, width = size
    x_last, y_last = x + (count - 1) * x_step, y + (count - 1) * y_step
    left, right = min(x, x_last), max(x, x_last)
    low, high = min(y, y_last), max(y, y_last)
    inside = left >= 0.5 and right < width + 0.5 and low >= 0.5 and high < height + 0.5
    if not inside or max(right - left, high - low) >= MOST_CELLS:
        return -1, -1
    return int(low), int(left)


# Look-ups and arithmetic are in separate loops, so that the compiler vectorises them. The loops are
# kernels of their own, because Numba otherwise counts references of their arrays, which takes
# longer than the loop.


@kernel
def _look_up(
    cells: np.ndarray, lowest: int, place: np.ndarray, count: int, cell: np.ndarray
) -> None:
    """Fill in the cells at positions relative to the lowest cell."""
    corner = np.uint64(lowest)
    for i in range(count):
        cell[i] = cells[corner + np.uint64(place[2, i])]


@kernel
def _between(cell: np.uint32, x: np.uint32, y: np.uint32) -> np.uint32:
    """Return the bilinear interpolation between the bytes of a cell, in 2^-16 grey levels."""
    right, up = (x >> TO_SHARE) & LOW_SHARE, (y >> TO_SHARE) & LOW_SHARE
    # lower and upper edge at the same time, in the halves of one number
    lefts, rights = cell & FIRST_AND_THIRD, (cell >> BYTE) & FIRST_AND_THIRD
    edges = np.uint32(np.uint32(lefts * (WHOLE_SHARE - right)) + np.uint32(rights * right))
    lower, upper = edges & LOW_HALF, edges >> HALF
    return np.uint32(np.uint32(lower * (WHOLE_SHARE - up)) + np.uint32(upper * up))


@kernel
def _add_at_the_edge(
    cells: np.ndarray, corner: int, line: Line, size: Size, count: int, sums: np.ndarray
) -> None:
    """Add samples at any position; the background lies beside the texture."""
    height, width = size
    for i in range(count):
        x, y = line[0] + i * line[2], line[1] + i * line[3]
        if 0.5 <= x < width + 0.5 and 0.5 <= y < height + 0.5:
            column, row = int(x), int(y)
            cell = np.uint32(cells[corner + row * (width + 1) + column])
            part_x, part_y = np.uint32((x - column) * PLACE_UNIT), np.uint32((y - row) * PLACE_UNIT)
            sums[i] += _between(cell, part_x, part_y)
        else:
            sums[i] += np.uint32(SUM_UNIT * int(BACKGROUND))


def lookup_texels(level: HorizontalPlane, right: Float, up: Float) -> np.ndarray:
    """Return texels (...) at texture coordinates; the background beside the texture."""
    inside = (right >= 0) & (right < 1) & (up >= 0) & (up < 1)
    height, width = level.shape[0]
    # a texel is the lower left corner of the cell to the upper right of its centre
    row, column = (up[inside] * height).astype(int) + 1, (right[inside] * width).astype(int) + 1
    found = np.full(inside.shape, BACKGROUND)
    found[inside] = level.cells[row * (width + 1) + column] & 0xFF
    return found
