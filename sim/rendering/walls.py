"""Walls in an image: visibility per pixel column, and mean texture over each pixel's footprint.

In the image of a level camera the inverse depth w = 1 / Z of an upright wall is linear in the
column coordinate u (Hartley and Zisserman 2004, projection of lines): with the wall's line
n (p - s) = 0 and a ray Z (1, (c - u) / f), Z n (1, (c - u) / f) = n s. So the nearest wall is the
upper envelope of line segments over u, and its breaks are at ends and crossings of segments.

A strip of an upright wall has one depth, so the footprints of its pixels are rectangles on the
wall, side by side up the column. Summed-area tables (Crow 1984) give the exact mean over each
rectangle: the difference of two columns of sums, then that of two rows.

Arithmetic and look-ups are in separate loops, so that the compiler vectorises the arithmetic. Some
loops are kernels of their own, because Numba otherwise counts references of their arrays, which
takes as long as the loop.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from sim.rendering.scene import Walls

NO_WALL = -1  # index of a strip without a wall
_THINNEST_PX = 1e-9  # thinner strips are dropped
_JUST_RIGHT_PX = 1e-7  # offset to the right of a break at which depths are compared
_MOST_PIECES = 10  # bound on strips per face; the upper envelope has fewer


class Pinhole(NamedTuple):
    """Level pinhole camera.

    Attributes:
        width_px: width of the image.
        height_px: height of the image.
        focal_px: focal length.
        center_u: column of the principal point.
        center_v: row of the principal point.
        eye_x_m: x of the optical centre.
        eye_y_m: y of the optical centre.
        eye_z_m: z of the optical centre.
        theta: direction of the optical axis, counter-clockwise from the world's x axis.
        near_m: depth of the near plane.
    """

    width_px: int
    height_px: int
    focal_px: float
    center_u: float
    center_v: float
    eye_x_m: float
    eye_y_m: float
    eye_z_m: float
    theta: float
    near_m: float


def at_origin(camera: Pinhole) -> Pinhole:
    """Return the camera at the origin, whose rows have the same depths on horizontal planes."""
    return camera._replace(eye_x_m=0.0, eye_y_m=0.0, theta=0.0)


class VisibleWalls(NamedTuple):
    """Visible walls as N strips of one face and column each, from left to right.

    Column j reaches from u = j - 1/2 to j + 1/2.

    Attributes:
        seen: projections of all faces, shape (F, 7), see `find_visible_walls`.
        face: visible face of each strip, or NO_WALL, shape (N,) int64.
        low: start of each strip in u, shape (N,).
        high: end of each strip in u, shape (N,).
        first: first strip of each column, and N, shape (W + 1,) int64.
        middle: visible face at the centre of each column, or NO_WALL, shape (W,) int64.
        middle_m: its depth; infinity without a wall, shape (W,).
        above: number of rows from the upper edge not fully covered by walls, shape (W,) int64.
        below: number of rows from the lower edge not fully covered by walls, shape (W,) int64.
    """

    seen: Float
    face: np.ndarray
    low: Float
    high: Float
    first: np.ndarray
    middle: np.ndarray
    middle_m: Float
    above: np.ndarray
    below: np.ndarray


@kernel
def find_visible_walls(camera: Pinhole, walls: Walls) -> VisibleWalls:
    """Return the visible walls of a camera."""
    # Projections of the faces: start u, end u, w0, w1, t0, t1, t2, with w = w0 + w1 u. The position
    # along the face in metres is t = (t0 + t1 u) / w - t2. A face that is behind the camera or
    # turned away from it starts at infinity and ends at minus infinity.
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    f, c = camera.focal_px, camera.center_u
    seen = np.empty((len(walls.width_m), 7))
    for i in range(len(seen)):
        x, y = walls.start_m[i, 0] - camera.eye_x_m, walls.start_m[i, 1] - camera.eye_y_m
        start_z, start_y = cos * x + sin * y, cos * y - sin * x
        ahead = cos * walls.along[i, 0] + sin * walls.along[i, 1]
        left = cos * walls.along[i, 1] - sin * walls.along[i, 0]
        end_z, end_y = start_z + walls.width_m[i] * ahead, start_y + walls.width_m[i] * left
        # distance of the optical centre in front of the face, whose front is on its right side
        before = start_y * ahead - start_z * left
        seen[i, 0], seen[i, 1] = np.inf, -np.inf
        if before <= 0 or max(start_z, end_z) <= camera.near_m:
            continue
        # 0 = Z (y ahead - left) - before, with y = (c - u) / f
        w_0, w_u = (ahead * c / f - left) / before, -ahead / (f * before)
        seen[i, 2], seen[i, 3] = w_0, w_u
        seen[i, 4], seen[i, 5] = ahead + left * c / f, -left / f
        seen[i, 6] = ahead * start_z + left * start_y
        for k, z, y in ((0, start_z, start_y), (1, end_z, end_y)):
            if z > camera.near_m:
                seen[i, k] = c - f * y / z
            else:  # cut at the near plane
                seen[i, k] = (1 / camera.near_m - w_0) / w_u
    face, low, high, first, middle, middle_m = _strips(seen, camera.width_px)
    # rows of each column that walls leave open
    above = np.empty(camera.width_px, dtype=np.int64)
    below = np.empty(camera.width_px, dtype=np.int64)
    horizon = int(np.ceil(camera.center_v))
    for j in range(camera.width_px):
        w = np.inf  # inverse depth of the farthest wall; 0 without a wall
        for s in range(first[j], first[j + 1]):
            w_0, w_u = seen[face[s], 2], seen[face[s], 3]
            w = min(w, w_0 + w_u * low[s], w_0 + w_u * high[s]) if face[s] != NO_WALL else 0.0
        top = camera.center_v - (walls.height_m - camera.eye_z_m) * camera.focal_px * w
        bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
        above[j] = max(0, min(int(max(np.floor(top + 0.5) + 1, 0.0)), horizon))
        below[j] = max(0, camera.height_px - max(int(np.floor(bottom + 0.5)), horizon))
    return VisibleWalls(seen, face, low, high, first, middle, middle_m, above, below)


@kernel
def _strips(
    seen: Float, width_px: int
) -> tuple[np.ndarray, Float, Float, np.ndarray, np.ndarray, Float]:
    """Return face, low, high, first, middle and middle_m of `VisibleWalls`.

    A face is the nearest one until it ends, until another face starts in front of it, or until
    another face crosses it and becomes the nearest.
    """
    face = np.empty(width_px + _MOST_PIECES * (len(seen) + 1), dtype=np.int64)
    low, high = np.empty(len(face)), np.empty(len(face))
    first, middle = np.empty(width_px + 1, dtype=np.int64), np.empty(width_px, dtype=np.int64)
    middle_m = np.empty(width_px)
    first[0], column, n = 0, 0, 0
    at, now, last = -0.5, NO_WALL, width_px - 0.5
    while at < last:
        if now == NO_WALL:
            nearest = 0.0
            for i in range(len(seen)):
                w = seen[i, 2] + seen[i, 3] * (at + _JUST_RIGHT_PX)
                if seen[i, 0] <= at < seen[i, 1] and w > nearest:
                    now, nearest = i, w
        stop, w_0, w_u, follower = last, 0.0, 0.0, NO_WALL
        if now != NO_WALL:
            stop, w_0, w_u = min(seen[now, 1], last), seen[now, 2], seen[now, 3]
        for i in range(len(seen)):
            start, more_0, more_u = seen[i, 0], seen[i, 2] - w_0, seen[i, 3] - w_u
            if at < start < stop and more_0 + more_u * (start + _JUST_RIGHT_PX) > 0:
                stop, follower = start, NO_WALL
            elif more_u > 0 and max(at, start) < -more_0 / more_u < min(stop, seen[i, 1]):
                stop, follower = -more_0 / more_u, i
        while at < stop:
            end = min(stop, column + 0.5)
            if end - at >= _THINNEST_PX and n < len(face):
                face[n], low[n], high[n] = now, at, end
                n += 1
            if at <= column < end:
                middle[column], middle_m[column] = now, np.inf
                if now != NO_WALL:
                    middle_m[column] = 1 / (w_0 + w_u * column)
            if end == column + 0.5:
                column += 1
                first[column] = n
            at = end
        now = follower
    return face[:n], low[:n], high[:n], first, middle, middle_m


def inverse_depths(visible_walls: VisibleWalls, first: int, last: int) -> Float:
    """Return inverse depths (N,) at the centres of strips in columns `first` to `last` - 1."""
    strips = slice(visible_walls.first[first], visible_walls.first[last])
    face, middle = (
        visible_walls.face[strips],
        (visible_walls.low[strips] + visible_walls.high[strips]) / 2,
    )
    w = visible_walls.seen[face, 2] + visible_walls.seen[face, 3] * middle
    w[face == NO_WALL] = 0.0
    return w


# Horizontal lines on a wall cross a column at a slope, which a rectangular footprint ignores. A
# strip is cut so that lines cross each part by at most this number of rows. Half of it changes the
# image by less than the rounding of grey levels, twice of it changes the image visibly.
STEEPEST_ROWS = 0.5
MOST_CUTS = 8  # bounds the time for walls at grazing angles
COVERED = np.float32(1 - 1e-6)  # shares are kept in single precision
LEAST_TEXELS = 1e-6  # least width of a strip at the end of a wall, to divide by


@kernel
def draw_walls(
    camera: Pinhole, walls: Walls, visible_walls: VisibleWalls, columns: np.ndarray
) -> None:
    """Draw walls over the background.

    Args:
        camera: level camera.
        walls: all faces.
        visible_walls: visible walls.
        columns: transposed image, shape (W, H) uint8; changed.
    """
    seen, face, lows, highs = (
        visible_walls.seen,
        visible_walls.face,
        visible_walls.low,
        visible_walls.high,
    )
    height, height_m, width_m, size = camera.height_px, walls.height_m, walls.width_m, walls.size
    begins, table = walls.first, walls.sums
    # per row of texels in a strip: sum of all texels up to it
    most_rows = 0
    for i in range(len(size)):
        most_rows = max(most_rows, size[i, 1])
    sums = np.empty(most_rows + 1, dtype=np.float32)
    # per edge between pixels: row of texels, share of the row below the edge, sum up to the edge
    row, row_fraction = np.empty(height + 1, dtype=np.int32), np.empty(height + 1, dtype=np.float32)
    below = np.empty(height + 1, dtype=np.float32)
    # per pixel: grey level times covered share, and covered share
    total, covered = np.empty(height, dtype=np.float32), np.empty(height, dtype=np.float32)
    # height of a wall beyond the horizon, and rows of the image beyond it
    highest_m = max(camera.eye_z_m, height_m - camera.eye_z_m)
    middle_rows = max(camera.center_v, camera.height_px - 1 - camera.center_v)
    for j in range(camera.width_px):
        first, last = height - 1, 0
        lowest_top, highest_bottom = 0, height - 1
        for v in range(len(total)):
            total[v], covered[v] = 0.0, 0.0
        for s in range(visible_walls.first[j], visible_walls.first[j + 1]):
            i, low, high = face[s], lows[s], highs[s]
            n = 0  # parts that the strip is cut into
            if i != NO_WALL:
                slope = seen[i, 3]
                w = seen[i, 2] + slope * (low + high) / 2
                crossed = min(highest_m * camera.focal_px * w, middle_rows)
                crossed = crossed * abs(slope) / w * (high - low)
                n = min(int(crossed / STEEPEST_ROWS) + 1, MOST_CUTS)
            for k in range(n):
                a, b = low + k * (high - low) / n, low + (k + 1) * (high - low) / n
                # start and end of the strip in v, and the height of a row in texels
                w_0, w_u = seen[i, 2], seen[i, 3]
                w = w_0 + w_u * (a + b) / 2
                top = camera.center_v - (height_m - camera.eye_z_m) * camera.focal_px * w
                bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
                step = size[i, 1] / (height_m * camera.focal_px * w)
                upper = int(max(np.floor(top + 0.5), 0.0))
                lower = int(min(np.floor(bottom + 0.5), camera.height_px - 1.0))
                # start and end of the strip along the face in texels
                t_0, t_u, n_texels = seen[i, 4], seen[i, 5], float(size[i, 0])
                per_m = size[i, 0] / width_m[i]
                begin = ((t_0 + t_u * a) / (w_0 + w_u * a) - seen[i, 6]) * per_m
                end = ((t_0 + t_u * b) / (w_0 + w_u * b) - seen[i, 6]) * per_m
                begin = min(max(begin, 0.0), n_texels - LEAST_TEXELS)
                end = min(max(end, begin + LEAST_TEXELS), n_texels)
                # rows of texels in the rows of the strip
                at_center = camera.eye_z_m / height_m * size[i, 1]
                highest_q = at_center - (upper - 0.5 - camera.center_v) * step
                lowest_q = at_center - (lower + 0.5 - camera.center_v) * step
                bottom_row, top_row = max(int(lowest_q) - 1, 0), min(int(highest_q) + 2, size[i, 1])
                rows, edges = top_row - bottom_row, lower + 2 - upper
                _add_columns(table, begins[i], size, i, begin, end, bottom_row, top_row, sums)
                _find_rows(highest_q - bottom_row, step, rows, edges, row, row_fraction)
                # sums up to the edges
                for v in range(edges):
                    k = np.uint64(row[v])
                    at_row = sums[k]
                    below[v] = at_row + row_fraction[v] * (sums[k + np.uint64(1)] - at_row)
                # means over footprints are differences between edges
                scale = (b - a) / ((end - begin) * step)
                start, weight = np.uint64(upper), np.float32(scale)
                for v in range(lower + 1 - upper):
                    total[start + np.uint64(v)] += weight * (below[v] - below[v + 1])
                _cover(covered, b - a, top, bottom, upper, lower)
                first, last = min(first, upper), max(last, lower)
                lowest_top, highest_bottom = max(lowest_top, upper), min(highest_bottom, lower)
        # rows between the edges of all strips have the same share; skip blending if it is 1
        begin, end = lowest_top + 1, highest_bottom
        if begin >= end or covered[begin] < COVERED:
            begin = end = last + 1
        # draw rows `begin` to `end` - 1, which walls cover
        start = np.uintp(begin)
        for i in range(end - begin):
            v = start + np.uintp(i)
            columns[j, v] = np.uint8(np.int32(total[v] + np.float32(0.5)))
        # blend the other rows from `first` to `last` with the background
        v = first
        while v <= last:
            if v == begin:
                v = end
                continue
            if covered[v] < COVERED:
                columns[j, v] = np.uint8(total[v] + (1 - covered[v]) * columns[j, v] + 0.5)
            else:
                columns[j, v] = np.uint8(np.int32(total[v] + np.float32(0.5)))
            v += 1


@kernel
def _cover(
    covered: np.ndarray, share: float, top: float, bottom: float, first: int, last: int
) -> None:
    """Add a strip's share to the covered shares, less at pixels that its edges cross."""
    begin, whole = np.uintp(first), np.float32(share)
    for i in range(last + 1 - first):
        covered[begin + np.uintp(i)] += whole
    covered[first] -= share * max(top - (first - 0.5), 0.0)
    covered[last] -= share * max(last + 0.5 - bottom, 0.0)


@kernel
def _add_columns(
    table: np.ndarray,
    first: int,
    size: np.ndarray,
    i: int,
    begin: float,
    end: float,
    lowest: int,
    highest: int,
    sums: np.ndarray,
) -> None:
    """Fill in sums of texels between two positions along face i, from a row up to each row."""
    texels_along, n = size[i, 0], size[i, 1] + 1
    k, m = min(int(begin), texels_along - 1), min(int(end), texels_along - 1)
    a, b = np.float32(begin - k), np.float32(end - m)
    left, right = first + k * n + lowest, first + m * n + lowest
    count = highest + 1 - lowest
    low, after_low = table[left:][:count], table[left + n :][:count]
    high, after_high = table[right:][:count], table[right + n :][:count]
    # differences are exact, even if the sums have overflowed
    between = np.int32(high[0] - low[0])
    more, less = np.int32(after_high[0] - high[0]), np.int32(after_low[0] - low[0])
    for r in range(count):
        whole = np.int32(np.int32(high[r] - low[r]) - between)
        gained = np.int32(np.int32(after_high[r] - high[r]) - more)
        lost = np.int32(np.int32(after_low[r] - low[r]) - less)
        sums[r] = np.float32(whole) + (b * np.float32(gained) - a * np.float32(lost))


@kernel
def _find_rows(
    q: float, texels: float, n: int, edges: int, row: np.ndarray, row_fraction: np.ndarray
) -> None:
    """Fill in row and share of edges at a distance of `texels`, the first one at `q`.

    Edges outside the n rows are moved to the border, because the parts outside are not covered.
    """
    top, begin, step, last_row = np.float32(n), np.float32(q), np.float32(texels), np.int32(n - 1)
    for v in range(edges):
        at = min(max(begin - step * np.float32(v), np.float32(0)), top)
        row[v] = min(np.int32(at), last_row)
        row_fraction[v] = at - np.float32(row[v])
