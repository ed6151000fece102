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
# Fixed-point numbers, which halve the time of loops: positions in 2^-22 cells, fractions of a cell
# in 2^-8, sums in 2^-16 grey levels. Sums of 2 x MOST_SAMPLES values of 255 fit into 32 bits, and
# so do positions along a chunk of CHUNK_PX pixels of a row, of at most two cells each.
POSITION_BITS, FRACTION_BITS, CHUNK_PX = 22, 8, 128
POSITION_UNIT, SUM_UNIT = 1 << POSITION_BITS, 1 << 2 * FRACTION_BITS
MOST_CELLS = 2 * CHUNK_PX
TO_FRACTION = np.uint32(POSITION_BITS - FRACTION_BITS)
FRACTION_ONE, FRACTION_MASK = np.uint32(1 << FRACTION_BITS), np.uint32((1 << FRACTION_BITS) - 1)
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
    is_visible = np.isfinite(edges_m[:-1]) & np.isfinite(edges_m[1:])
    length_texels = np.abs(edges_m[1:][is_visible] - edges_m[:-1][is_visible]) * per_m
    width_texels = z[is_visible] / camera.focal_px * per_m
    # the pyramid level at which footprints are at most two texels wide
    mantissa, halvings = np.frexp(width_texels)
    k = np.clip(halvings - np.where(mantissa > 0.5, 1, 2), 0, copies - 1)
    width_texels, length_texels = np.ldexp(width_texels, -k), np.ldexp(length_texels, -k)
    row_sampling = np.zeros((camera.height_px, 3), dtype=np.int64)
    row_sampling[is_visible, 0] = np.clip(np.ceil(length_texels / STEP_TEXELS), 1, MOST_SAMPLES)
    row_sampling[is_visible, 1] = np.where(width_texels <= 1, 1, 2)
    row_sampling[is_visible, 2] = k
    return row_sampling


def ray_coefficients(
    camera: Pinhole, level: HorizontalPlane
) -> tuple[RayCoefficients, RayCoefficients]:
    """Return coefficients a, b, c of texture coordinates of rays: right = a + (b + c u) Z, and up.

    Both coordinates are 0 to 1 on the texture.
    """
    cos, sin = math.cos(camera.theta), math.sin(camera.theta)
    left_edge = camera.center_u / camera.focal_px
    corner_x, corner_y = level.corner_m.tolist()
    x0, y0 = camera.eye_x_m - corner_x, camera.eye_y_m - corner_y
    dx, dy = cos - left_edge * sin, sin + left_edge * cos

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
    row_sampling, coefficients = footprints(camera, level), ray_coefficients(camera, level)
    depth_factor = (camera.eye_z_m - level.height_m) * camera.focal_px
    texels = level.shape, level.first, level.cells
    _draw_rows(
        *texels,
        row_sampling,
        coefficients,
        depth_factor,
        camera.center_v,
        is_above,
        open_rows,
        picture,
    )


@kernel
def _draw_rows(
    level_shapes: np.ndarray,
    level_starts: np.ndarray,
    cells: np.ndarray,
    row_sampling: np.ndarray,
    coefficients: tuple[RayCoefficients, RayCoefficients],
    depth_factor: float,
    center_v: float,
    is_above: bool,
    open_rows: np.ndarray,
    picture: np.ndarray,
) -> None:
    """Draw a horizontal plane row by row: all footprints of a row have one depth and lie on a line.

    Args:
        level_shapes: rows and columns of each pyramid level, shape (L, 2).
        level_starts: index of the first cell of each pyramid level, shape (L,).
        cells: packed 2x2 texels of all levels.
        row_sampling: sampling of each image row, as `footprints` returns it, shape (H, 3).
        coefficients: texture coordinates of rays, as `ray_coefficients` returns them.
        depth_factor: height of the camera over the plane times the focal length, in m px; the depth
            of row v is depth_factor / (v - center_v).
        center_v: row of the horizon.
        is_above: True if the plane lies above the horizon.
        open_rows: number of open rows of each column, from the image's edge on, shape (W,).
        picture: image, shape (H, W) uint8; changed.
    """
    height, width = picture.shape
    (right_0, right_z, right_zu), (up_0, up_z, up_zu) = coefficients
    position, cell = np.empty((3, CHUNK_PX), dtype=np.int32), np.empty(CHUNK_PX, dtype=np.uint32)
    sums = np.empty(CHUNK_PX, dtype=np.uint32)
    for first in range(0, width, CHUNK_PX):
        last = min(first + CHUNK_PX, width)
        min_open = max_open = open_rows[first]
        for j in range(first, last):
            min_open, max_open = min(min_open, open_rows[j]), max(max_open, open_rows[j])
        for row in range(max_open):
            v = row if is_above else height - 1 - row
            n, n_across, k = row_sampling[v, 0], row_sampling[v, 1], row_sampling[v, 2]
            size, corner = (level_shapes[k, 0], level_shapes[k, 1]), int(level_starts[k])
            end = first
            while end < last:
                begin, end = end, last
                if row >= min_open:  # the next open columns
                    while begin < last and row >= open_rows[begin]:
                        begin += 1
                    end = begin
                    while end < last and row < open_rows[end]:
                        end += 1
                count = end - begin
                value = SUM_UNIT * int(BACKGROUND) if n == 0 else 0
                for i in range(count):
                    sums[i] = value
                for side in range(n_across):
                    u = begin + (0.0 if n_across == 1 else side / 2 - 0.25)
                    for s in range(n if count else 0):
                        z = depth_factor / (v - 0.5 + (s + 0.5) / n - center_v)
                        # the line of the row's footprints on the pyramid level, from `u` on
                        line = (
                            (right_0 + (right_z + right_zu * u) * z) * size[1] + 0.5,
                            (up_0 + (up_z + up_zu * u) * z) * size[0] + 0.5,
                            right_zu * z * size[1],
                            up_zu * z * size[0],
                        )
                        lowest, leftmost = _lowest_cell(line, count, size)
                        if lowest < 0:
                            _add_border_samples(cells, corner, line, size, count, sums)
                        else:
                            wide = size[1] + 1
                            # positions relative to the lowest cell, and cell indices
                            x, y, x_step, y_step = line
                            first_x, first_y = x - leftmost, y - lowest
                            from_x, step_x = (
                                np.int32(first_x * POSITION_UNIT),
                                np.int32(x_step * POSITION_UNIT),
                            )
                            from_y, step_y = (
                                np.int32(first_y * POSITION_UNIT),
                                np.int32(y_step * POSITION_UNIT),
                            )
                            stride = np.int32(wide)
                            for i in range(count):
                                at_x = np.int32(from_x + np.int32(step_x * np.int32(i)))
                                at_y = np.int32(from_y + np.int32(step_y * np.int32(i)))
                                position[0, i], position[1, i] = at_x, at_y
                                position[2, i] = np.int32((at_y >> POSITION_BITS) * stride) + (
                                    at_x >> POSITION_BITS
                                )
                            _look_up(
                                cells, corner + lowest * wide + leftmost, position, count, cell
                            )
                            for i in range(count):
                                sums[i] += _interpolate(
                                    cell[i], np.uint32(position[0, i]), np.uint32(position[1, i])
                                )
                # draw rounded means of samples from column `begin` on
                samples = max(n * n_across, 1)
                scale, first_pixel = np.float32(1 / (SUM_UNIT * samples)), np.uintp(begin)
                for i in range(count):
                    grey_level = np.int32(scale * np.float32(sums[i]) + np.float32(0.5))
                    picture[v, first_pixel + np.uintp(i)] = np.uint8(grey_level)


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
    cells: np.ndarray, lowest: int, position: np.ndarray, count: int, cell: np.ndarray
) -> None:
    """Copy the cells at given positions.

    Args:
        cells: packed 2x2 texels of all levels.
        lowest: index of the lowest cell of the line.
        position: x and y in 2^-22 cells and cell index, relative to the lowest cell, shape (3, N).
        count: number of positions.
        cell: the cells, shape (N,); changed.
    """
    corner = np.uint64(lowest)
    for i in range(count):
        cell[i] = cells[corner + np.uint64(position[2, i])]


@kernel
def _interpolate(cell: np.uint32, x: np.uint32, y: np.uint32) -> np.uint32:
    """Return the bilinear interpolation between the bytes of a cell, in 2^-16 grey levels."""
    right, up = (x >> TO_FRACTION) & FRACTION_MASK, (y >> TO_FRACTION) & FRACTION_MASK
    # lower and upper edge at the same time, in the halves of one number
    lefts, rights = cell & FIRST_AND_THIRD, (cell >> BYTE) & FIRST_AND_THIRD
    edges = np.uint32(np.uint32(lefts * (FRACTION_ONE - right)) + np.uint32(rights * right))
    lower, upper = edges & LOW_HALF, edges >> HALF
    return np.uint32(np.uint32(lower * (FRACTION_ONE - up)) + np.uint32(upper * up))


@kernel
def _add_border_samples(
    cells: np.ndarray, corner: int, line: Line, size: Size, count: int, sums: np.ndarray
) -> None:
    """Add samples at any position; the background lies beside the texture."""
    height, width = size
    for i in range(count):
        x, y = line[0] + i * line[2], line[1] + i * line[3]
        if 0.5 <= x < width + 0.5 and 0.5 <= y < height + 0.5:
            column, row = int(x), int(y)
            cell = np.uint32(cells[corner + row * (width + 1) + column])
            part_x, part_y = (
                np.uint32((x - column) * POSITION_UNIT),
                np.uint32((y - row) * POSITION_UNIT),
            )
            sums[i] += _interpolate(cell, part_x, part_y)
        else:
            sums[i] += np.uint32(SUM_UNIT * int(BACKGROUND))


def lookup_texels(level: HorizontalPlane, right: Float, up: Float) -> np.ndarray:
    """Return texels (...) at texture coordinates; the background beside the texture."""
    inside = (right >= 0) & (right < 1) & (up >= 0) & (up < 1)
    height, width = level.shape[0]
    # a texel is the lower left corner of the cell to the upper right of its centre
    row, column = (up[inside] * height).astype(int) + 1, (right[inside] * width).astype(int) + 1
    texels = np.full(inside.shape, BACKGROUND)
    texels[inside] = level.cells[row * (width + 1) + column] & 0xFF
    return texels
