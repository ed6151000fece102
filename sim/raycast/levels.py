"""Floor and ceiling: what a pixel's footprint on them shows on average.

A row of a level camera's picture shows a level plane at one depth, Z = h f / |v - c|. A footprint
is Z / f wide and Z^2 / (h f) deep: far off it is long and narrow, turned against the picture's
texels: it is filled with bilinear samples all along it, from the copy whose texels are as
large as it is wide (Heckbert 1989, section 3; McCormack et al. 1999, Feline).
"""

import numpy as np
from numba import njit

from sim.raycast.plan import Pinhole
from sim.raycast.scene import Level

BACKGROUND = 255.0  # grey level of what is nowhere, as PyBullet has it
MOST_SAMPLES = 64  # along a footprint
STEP_TEXELS = 2.0  # between samples; floors are painted with a low pass of one texel
# Places are whole numbers of 2^-22 cells, shares of a cell of 2^-8, sums of 2^-16 grey levels: so
# loops take half the time. 2 x MOST_SAMPLES values of 255 still fit into 32 bits,
# and so does the way of PIECE pixels, of two cells each at most.
PLACE_BITS, SHARE_BITS, PIECE = 22, 8, 128
PLACE_UNIT, SUM_UNIT = 1 << PLACE_BITS, 1 << 2 * SHARE_BITS
MOST_CELLS = 2 * PIECE
TO_SHARE = np.uint32(PLACE_BITS - SHARE_BITS)
WHOLE_SHARE, LOW_SHARE = np.uint32(1 << SHARE_BITS), np.uint32((1 << SHARE_BITS) - 1)
FIRST_AND_THIRD = np.uint32(0x00FF00FF)  # bytes of a cell
BYTE, HALF, LOW_HALF = np.uint32(8), np.uint32(16), np.uint32(0xFFFF)

Way = tuple[float, float, float]


@njit(cache=True)
def row_depth_m(camera: Pinhole, height_m: float, v: float) -> float:
    """Depth at which a ray through row `v` meets a level plane; infinity if it does not."""
    down = (v - camera.center_v) / camera.focal_px
    drop = camera.eye_z_m - height_m
    return drop / down if drop * down > 0 else np.inf


@njit(cache=True)
def footprints(camera: Pinhole, level: Level) -> np.ndarray:
    """How each row is sampled (H, 3) int64: samples along, samples across, copy of the picture."""
    plan = np.zeros((camera.height_px, 3), dtype=np.int64)
    per_m = level.shape[0, 1] / level.size_m[0]
    for i in range(camera.height_px):
        z = row_depth_m(camera, level.height_m, float(i))
        inner = row_depth_m(camera, level.height_m, i - 0.5)
        outer = row_depth_m(camera, level.height_m, i + 0.5)
        if not (np.isfinite(inner) and np.isfinite(outer)):
            continue
        across, along, k = z / camera.focal_px * per_m, abs(outer - inner) * per_m, 0
        while across > 2 and k < len(level.first) - 1:
            across, along, k = across / 2, along / 2, k + 1
        plan[i, 0] = min(max(np.ceil(along / STEP_TEXELS), 1), MOST_SAMPLES)
        plan[i, 1] = 1 if across <= 1 else 2
        plan[i, 2] = k
    return plan


@njit(cache=True)
def ways(camera: Pinhole, level: Level) -> tuple[Way, Way]:
    """How rays go over a picture: right = a + (b + c u) Z, and up likewise, both 0 to 1 on it."""
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    x0, y0 = camera.eye_x_m - level.corner_m[0], camera.eye_y_m - level.corner_m[1]
    left = camera.center_u / camera.focal_px
    dx, dy = cos - left * sin, sin + left * cos
    right, up = level.right_per_m2, level.up_per_m2
    return (
        (
            right[0] * x0 + right[1] * y0,
            right[0] * dx + right[1] * dy,
            (right[0] * sin - right[1] * cos) / camera.focal_px,
        ),
        (
            up[0] * x0 + up[1] * y0,
            up[0] * dx + up[1] * dy,
            (up[0] * sin - up[1] * cos) / camera.focal_px,
        ),
    )


@njit(cache=True)
def fill(
    camera: Pinhole,
    level: Level,
    is_above: bool,
    open_rows: np.ndarray,
    picture: np.ndarray,
) -> None:
    """Draw floor or ceiling where walls leave pixels open on its side of the horizon.

    Row by row: there the depth is one, and footprints lie side by side on a line.

    Args:
        camera: level.
        level: floor or ceiling.
        is_above: whether it lies above the horizon.
        open_rows: (W,) so many rows of each column, from the picture's edge on, are open.
        picture: (H, W) uint8, changed.
    """
    plan, way = footprints(camera, level), ways(camera, level)
    room, sums = np.empty((4, PIECE), np.int32), np.empty(PIECE, np.uint32)
    for first in range(0, camera.width_px, PIECE):
        last = min(first + PIECE, camera.width_px)
        for n in range(np.max(open_rows[first:last])):
            v = n if is_above else camera.height_px - 1 - n
            begin = first
            while begin < last:
                end = begin
                while end < last and n < open_rows[end]:
                    end += 1
                if begin < end:
                    _sum_pixels(camera, level, way, plan, v, begin, end - begin, room, sums)
                    samples = max(plan[v, 0] * plan[v, 1], 1)
                    _show(sums, samples, v, begin, end - begin, picture)
                begin = end + 1


@njit(cache=True)
def _show(
    sums: np.ndarray, samples: int, v: int, begin: int, count: int, picture: np.ndarray
) -> None:
    """Draw means of samples, rounded, into a row's pixels from `begin` on."""
    scale, shown = np.float32(1 / (SUM_UNIT * samples)), picture[v, begin:]
    for i in range(count):
        shown[i] = np.uint8(np.int32(scale * np.float32(sums[i]) + np.float32(0.5)))


@njit(cache=True)
def _sum_pixels(
    camera: Pinhole,
    level: Level,
    way: tuple[Way, Way],
    plan: np.ndarray,
    v: int,
    begin: int,
    count: int,
    room: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Fill the first `count` of `sums` with the samples of a row's pixels from `begin` on."""
    n, across, k = plan[v, 0], plan[v, 1], plan[v, 2]
    for i in range(count):
        sums[i] = SUM_UNIT * int(BACKGROUND) if n == 0 else 0
    height, width = level.shape[k, 0], level.shape[k, 1]
    (right_0, right_z, right_zu), (up_0, up_z, up_zu) = way
    rise = (camera.eye_z_m - level.height_m) * camera.focal_px
    for side in range(across):
        u = begin + (0.0 if across == 1 else side / 2 - 0.25)
        for s in range(n):
            z = rise / (v - 0.5 + (s + 0.5) / n - camera.center_v)
            # cells lie between the middles of texels
            x = (right_0 + (right_z + right_zu * u) * z) * width + 0.5
            y = (up_0 + (up_z + up_zu * u) * z) * height + 0.5
            x_step, y_step = right_zu * z * width, up_zu * z * height
            x_last, y_last = x + (count - 1) * x_step, y + (count - 1) * y_step
            left, right = min(x, x_last), max(x, x_last)
            low, high = min(y, y_last), max(y, y_last)
            inside = left >= 0.5 and right < width + 0.5 and low >= 0.5 and high < height + 0.5
            if inside and max(right - left, high - low) < MOST_CELLS:
                _add_samples(level, k, x, y, x_step, y_step, int(left), int(low), count, room, sums)
            else:
                for i in range(count):
                    sums[i] += _at_the_edge(level, k, x + i * x_step, y + i * y_step)


@njit(cache=True)
def _add_samples(
    level: Level,
    k: int,
    x: float,
    y: float,
    x_step: float,
    y_step: float,
    column: int,
    row: int,
    count: int,
    room: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Add samples of copy k on a line to the first `count` of `sums`.

    Places are in cells, none to the left of `column` or below `row`. Each loop does one thing:
    those that only look up and those that only reckon run in the processor's vectors, one that
    does both does not.
    """
    wide = level.shape[k, 1] + 1
    corner = np.uint64(level.first[k] + row * wide + column)
    at_x, at_y, place, cell = room[0], room[1], room[2], room[3].view(np.uint32)
    first_x, step_x = np.int32((x - column) * PLACE_UNIT), np.int32(x_step * PLACE_UNIT)
    first_y, step_y = np.int32((y - row) * PLACE_UNIT), np.int32(y_step * PLACE_UNIT)
    for i in range(count):
        at_x[i] = first_x + np.int32(step_x * np.int32(i))
        at_y[i] = first_y + np.int32(step_y * np.int32(i))
    for i in range(count):
        place[i] = np.int32((at_y[i] >> PLACE_BITS) * np.int32(wide)) + (at_x[i] >> PLACE_BITS)
    for i in range(count):
        cell[i] = level.cells[corner + np.uint64(place[i])]
    for i in range(count):
        sums[i] += _between(cell[i], np.uint32(at_x[i]), np.uint32(at_y[i]))


@njit(cache=True, inline="always")
def _between(cell: np.uint32, x: np.uint32, y: np.uint32) -> np.uint32:
    """What lies between a cell's corners, the bytes of one number, in 2^-16 grey levels."""
    right, up = (x >> TO_SHARE) & LOW_SHARE, (y >> TO_SHARE) & LOW_SHARE
    # lower and upper edge at once, in the halves of one number
    lefts, rights = cell & FIRST_AND_THIRD, (cell >> BYTE) & FIRST_AND_THIRD
    edges = np.uint32(np.uint32(lefts * (WHOLE_SHARE - right)) + np.uint32(rights * right))
    lower, upper = edges & LOW_HALF, edges >> HALF
    return np.uint32(np.uint32(lower * (WHOLE_SHARE - up)) + np.uint32(upper * up))


@njit(cache=True)
def _at_the_edge(level: Level, k: int, x: float, y: float) -> np.uint32:
    """A sample anywhere; beside the picture there is nothing."""
    height, width = level.shape[k, 0], level.shape[k, 1]
    inside = 0.5 <= x < width + 0.5 and 0.5 <= y < height + 0.5
    column, row = int(x) if inside else 0, int(y) if inside else 0
    cell = np.uint32(level.cells[level.first[k] + row * (width + 1) + column])
    part_x, part_y = np.uint32((x - column) * PLACE_UNIT), np.uint32((y - row) * PLACE_UNIT)
    return _between(cell, part_x, part_y) if inside else np.uint32(SUM_UNIT * int(BACKGROUND))


@njit(cache=True)
def texel(level: Level, right: float, up: float) -> float:
    """The texel that a point of the picture lies on; the background beside it."""
    if not (0 <= right < 1 and 0 <= up < 1):
        return BACKGROUND
    height, width = level.shape[0]
    # it is the first corner of the cell to the right of its middle and above it
    row, column = int(up * height) + 1, int(right * width) + 1
    return float(level.cells[row * (width + 1) + column] & np.uint32(0xFF))
