"""Walls in an image: visibility per pixel column, and mean texture over each pixel's footprint.

A level camera's picture maps an upright wall's line in plan to inverse depth w = 1 / Z, which is
linear in the column's coordinate u (Hartley and Zisserman 2004, projection of lines): with the line
n (p - s) = 0 and a ray Z (1, (c - u) / f), Z n (1, (c - u) / f) = n s. So the nearest wall is the
upper envelope of straight segments over u, and its breaks lie at segments' ends and crossings.

A level camera sees an upright wall's strip at one depth, so its footprints are rectangles on the
wall, side by side up the column. Sums of all texels left of and below a corner (Crow 1984) give the
exact mean over each: first the difference of two columns of sums, then that of two of its rows.
Loops that only reckon run in the processor's vectors, one that looks up as well does not: so what
can be reckoned beforehand has a loop of its own. And each is a function of its own that is given
its arrays by themselves: to hold on to them while it calls others would take as long as a loop.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from sim.rendering.scene import Walls

NO_WALL = -1  # no wall
_THINNEST_PX = 1e-9  # what is thinner is not told apart
_JUST_RIGHT_PX = 1e-7  # of a place: there what begins at it is nearer than the rest, or is not
_MOST_PIECES = 10  # for each face; an upper envelope of so many segments has fewer


class Pinhole(NamedTuple):
    """One level camera.

    Attributes:
        width_px: of the picture.
        height_px: likewise.
        focal_px: focal length.
        center_u: principal point.
        center_v: likewise.
        eye_x_m: optical centre.
        eye_y_m: likewise.
        eye_z_m: likewise.
        theta: of the optical axis, counter-clockwise from the world's x axis.
        near_m: what is nearer along the axis is not seen.
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
    """A camera whose rows see floors as far off as those of another one do."""
    return camera._replace(eye_x_m=0.0, eye_y_m=0.0, theta=0.0)


class VisibleWalls(NamedTuple):
    """What a camera sees of the walls, from left to right: N strips of one face and column each.

    Column j reaches from u = j - 1/2 to j + 1/2.

    Attributes:
        seen: (F, 7) all faces, see `_project`.
        face: (N,) int64 that is seen in a strip, or NONE.
        low: (N,) where in u it begins.
        high: (N,) where it ends.
        first: (W + 1,) int64 each column's first strip, and N.
        middle: (W,) int64 the face that each column's middle sees, or NONE.
        middle_m: (W,) its depth there; infinity for none.
        above: (W,) int64 how many rows from the upper edge on walls leave open, wholly or partly.
        below: (W,) int32 the same from the lower edge on.
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
    """What a camera sees of the walls."""
    # Project faces (F, 7) into the picture: from u, to u, w0, w1, t0, t1, t2: w = w0 + w1 u.
    # t is the place along the face in metres: t = (t0 + t1 u) / w - t2. A face that is not seen,
    # being behind or turned away, is from infinity to minus infinity.
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    f, c = camera.focal_px, camera.center_u
    seen = np.empty((len(walls.width_m), 7))
    for i in range(len(seen)):
        x, y = walls.start_m[i, 0] - camera.eye_x_m, walls.start_m[i, 1] - camera.eye_y_m
        start_z, start_y = cos * x + sin * y, cos * y - sin * x
        ahead = cos * walls.along[i, 0] + sin * walls.along[i, 1]
        left = cos * walls.along[i, 1] - sin * walls.along[i, 0]
        end_z, end_y = start_z + walls.width_m[i] * ahead, start_y + walls.width_m[i] * left
        # distance of the eye before the face; its front lies to the right of the way along it
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
            else:  # cut where w is that of the near plane
                seen[i, k] = (1 / camera.near_m - w_0) / w_u
    face, low, high, first, middle, middle_m = _strips(seen, camera.width_px)
    above, below = _open_rows(camera, walls.height_m, seen, face, low, high, first)
    return VisibleWalls(seen, face, low, high, first, middle, middle_m, above, below)


@kernel
def _strips(
    seen: Float, width_px: int
) -> tuple[np.ndarray, Float, Float, np.ndarray, np.ndarray, Float]:
    """What is seen in each column: `Plan`'s face, low, high, first, middle and its depth.

    A face is the nearest until it ends, until another one begins before it, or until another one
    crosses it, which then is the nearest.
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


@kernel
def _open_rows(
    camera: Pinhole,
    height_m: float,
    seen: Float,
    face: np.ndarray,
    low: Float,
    high: Float,
    first: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How many rows of each column walls leave open, see `Plan`."""
    above = np.empty(camera.width_px, dtype=np.int64)
    below = np.empty(camera.width_px, dtype=np.int64)
    horizon = int(np.ceil(camera.center_v))
    for j in range(camera.width_px):
        w = np.inf  # where walls are farthest; nowhere they are infinitely far
        for s in range(first[j], first[j + 1]):
            w_0, w_u = seen[face[s], 2], seen[face[s], 3]
            w = min(w, w_0 + w_u * low[s], w_0 + w_u * high[s]) if face[s] != NO_WALL else 0.0
        top = camera.center_v - (height_m - camera.eye_z_m) * camera.focal_px * w
        bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
        above[j] = max(0, min(int(max(np.floor(top + 0.5) + 1, 0.0)), horizon))
        below[j] = max(0, camera.height_px - max(int(np.floor(bottom + 0.5)), horizon))
    return above, below


def inverse_depths(plan: VisibleWalls, first: int, last: int) -> Float:
    """Of what is seen in the middles of strips (N,) in columns from `first` to before `last`."""
    strips = slice(plan.first[first], plan.first[last])
    face, middle = plan.face[strips], (plan.low[strips] + plan.high[strips]) / 2
    w = plan.seen[face, 2] + plan.seen[face, 3] * middle
    w[face == NO_WALL] = 0.0
    return w


# A wall's level lines cross a column at a slope, which cuts a footprint's corners. A strip is cut
# into so many that lines cross each by no more than this: of cuts twice as fine the picture differs
# by less than a grey level is rounded, of cuts twice as coarse visibly.
STEEPEST_ROWS = 0.5
MOST_CUTS = 8  # a bound on the time of walls that are grazed
COVERED = np.float32(1 - 1e-6)  # shares are kept in single precision
LEAST_TEXELS = 1e-6  # of a strip at a wall's end: sums still tell them apart


@kernel
def draw_walls(camera: Pinhole, walls: Walls, plan: VisibleWalls, columns: np.ndarray) -> None:
    """Draw walls over what is behind them.

    Args:
        camera: level.
        walls: all faces.
        plan: what the camera sees of them.
        columns: the picture's (W, H) uint8, changed, each one after the other in memory.
    """
    seen, face, lows, highs = plan.seen, plan.face, plan.low, plan.high
    height, height_m, width_m, size = camera.height_px, walls.height_m, walls.width_m, walls.size
    begins, table = walls.first, walls.sums
    # of a strip: sums of its texels up to each row of texels; of the edges between pixels: the row
    # of texels that they lie in, the share of it below them, sums up to them; of pixels: grey
    # levels times covered share, and that share
    sums = np.empty(_most_rows(size) + 1, dtype=np.float32)
    row, share = np.empty(height + 1, dtype=np.int32), np.empty(height + 1, dtype=np.float32)
    below = np.empty(height + 1, dtype=np.float32)
    total, covered = np.empty(height, dtype=np.float32), np.empty(height, dtype=np.float32)
    for j in range(camera.width_px):
        first, last = height - 1, 0
        lowest_top, highest_bottom = 0, height - 1
        for v in range(len(total)):
            total[v], covered[v] = 0.0, 0.0
        for s in range(plan.first[j], plan.first[j + 1]):
            i, low, high = face[s], lows[s], highs[s]
            n = 0 if i == NO_WALL else _cuts(camera, height_m, seen, i, low, high)
            for k in range(n):
                a, b = low + k * (high - low) / n, low + (k + 1) * (high - low) / n
                top, bottom, step = _rows(camera, height_m, seen, i, a, b, size)
                upper = int(max(np.floor(top + 0.5), 0.0))
                lower = int(min(np.floor(bottom + 0.5), camera.height_px - 1.0))
                begin, end = _texels(seen, i, a, b, width_m, size)
                # rows of texels that the strip's rows of the picture see
                at_center = camera.eye_z_m / height_m * size[i, 1]
                highest_q = at_center - (upper - 0.5 - camera.center_v) * step
                lowest_q = at_center - (lower + 0.5 - camera.center_v) * step
                bottom_row, top_row = max(int(lowest_q) - 1, 0), min(int(highest_q) + 2, size[i, 1])
                rows, edges = top_row - bottom_row, lower + 2 - upper
                _add_columns(table, begins[i], size, i, begin, end, bottom_row, top_row, sums)
                _find_rows(highest_q - bottom_row, step, rows, edges, row, share)
                # Fill in the sums below edges.
                for v in range(edges):
                    k = np.uint64(row[v])
                    at_row = sums[k]
                    below[v] = at_row + share[v] * (sums[k + np.uint64(1)] - at_row)
                # Add means over footprints, from the sums below the edges between them.
                scale = (b - a) / ((end - begin) * step)
                start, weight = np.uint64(upper), np.float32(scale)
                for v in range(lower + 1 - upper):
                    total[start + np.uint64(v)] += weight * (below[v] - below[v + 1])
                _cover(covered, b - a, top, bottom, upper, lower)
                first, last = min(first, upper), max(last, lower)
                lowest_top, highest_bottom = max(lowest_top, upper), min(highest_bottom, lower)
        # rows between the edges of all strips are covered alike; if wholly, nothing shines through
        begin, end = lowest_top + 1, highest_bottom
        if begin >= end or covered[begin] < COVERED:
            begin = end = last + 1
        # Draw a column's rows from `begin` to before `end`, which walls cover.
        start = np.uintp(begin)
        for i in range(end - begin):
            v = start + np.uintp(i)
            columns[j, v] = np.uint8(np.int32(total[v] + np.float32(0.5)))
        # Draw its other rows, from `first` to `last`, over what is there.
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
def _most_rows(size: np.ndarray) -> int:
    most = 0
    for i in range(len(size)):
        most = max(most, size[i, 1])
    return most


@kernel
def _cuts(camera: Pinhole, height_m: float, seen: Float, i: int, low: float, high: float) -> int:
    """Into how many strips one of face i is cut."""
    slope = seen[i, 3]
    w = seen[i, 2] + slope * (low + high) / 2
    highest = max(camera.eye_z_m, height_m - camera.eye_z_m) * camera.focal_px * w
    from_middle = min(highest, max(camera.center_v, camera.height_px - 1 - camera.center_v))
    crossed = from_middle * abs(slope) / w * (high - low)
    return min(int(crossed / STEEPEST_ROWS) + 1, MOST_CUTS)


@kernel
def _rows(
    camera: Pinhole,
    height_m: float,
    seen: Float,
    i: int,
    low: float,
    high: float,
    size: np.ndarray,
) -> tuple[float, float, float]:
    """Where a strip of face i begins and ends in v, and how many texels a row is high."""
    w = seen[i, 2] + seen[i, 3] * (low + high) / 2
    top = camera.center_v - (height_m - camera.eye_z_m) * camera.focal_px * w
    bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
    return top, bottom, size[i, 1] / (height_m * camera.focal_px * w)


@kernel
def _texels(
    seen: Float, i: int, low: float, high: float, width_m: Float, size: np.ndarray
) -> tuple[float, float]:
    """Where a strip begins and ends along face i; never empty, since means over it are wanted."""
    w_0, w_u, t_0, t_u = seen[i, 2], seen[i, 3], seen[i, 4], seen[i, 5]
    begin = (t_0 + t_u * low) / (w_0 + w_u * low) - seen[i, 6]
    end = (t_0 + t_u * high) / (w_0 + w_u * high) - seen[i, 6]
    n, per_m = float(size[i, 0]), size[i, 0] / width_m[i]
    begin = min(max(begin * per_m, 0.0), n - LEAST_TEXELS)
    return begin, min(max(end * per_m, begin + LEAST_TEXELS), n)


@kernel
def _cover(
    covered: np.ndarray, share: float, top: float, bottom: float, first: int, last: int
) -> None:
    """Add a strip's share to what is covered of pixels, less of those that its edges cross."""
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
    """Sums of all texels between two places along face i, from the row `lowest` up to each row."""
    texels_along, n = size[i, 0], size[i, 1] + 1
    k, m = min(int(begin), texels_along - 1), min(int(end), texels_along - 1)
    a, b = np.float32(begin - k), np.float32(end - m)
    left, right = first + k * n + lowest, first + m * n + lowest
    count = highest + 1 - lowest
    low, after_low = table[left:][:count], table[left + n :][:count]
    high, after_high = table[right:][:count], table[right + n :][:count]
    # differences are exact, though the sums may have run over
    between = np.int32(high[0] - low[0])
    more, less = np.int32(after_high[0] - high[0]), np.int32(after_low[0] - low[0])
    for r in range(count):
        whole = np.int32(np.int32(high[r] - low[r]) - between)
        gained = np.int32(np.int32(after_high[r] - high[r]) - more)
        lost = np.int32(np.int32(after_low[r] - low[r]) - less)
        sums[r] = np.float32(whole) + (b * np.float32(gained) - a * np.float32(lost))


@kernel
def _find_rows(
    q: float, texels: float, n: int, edges: int, row: np.ndarray, share: np.ndarray
) -> None:
    """Fill in rows of texels in which edges lie, so many texels apart, the first at `q` above.

    What sticks out over the n rows of texels adds nothing: it is the share that is not covered.
    """
    top, begin, step, last_row = np.float32(n), np.float32(q), np.float32(texels), np.int32(n - 1)
    for v in range(edges):
        at = min(max(begin - step * np.float32(v), np.float32(0)), top)
        row[v] = min(np.int32(at), last_row)
        share[v] = at - np.float32(row[v])
