"""Walls, pixel column by pixel column: each pixel's mean over its footprint on the wall.

A level camera sees an upright wall's strip at one depth, so its footprints are rectangles on the
wall, side by side up the column. Sums of all texels left of and below a corner (Crow 1984) give the
exact mean over each: first the difference of two columns of sums, then that of two of its rows.
Loops that only reckon run in the processor's vectors, one that looks up as well does not: so what
can be reckoned beforehand has a loop of its own. And each is a function of its own that is given
its arrays by themselves: to hold on to them while it calls others would take as long as a loop.
"""

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from sim.raycast.scene import Walls
from sim.raycast.visible_walls import NONE, Pinhole, Plan

# A wall's level lines cross a column at a slope, which cuts a footprint's corners. A strip is cut
# into so many that lines cross each by no more than this: of cuts twice as fine the picture differs
# by less than a grey level is rounded, of cuts twice as coarse visibly.
STEEPEST_ROWS = 0.5
MOST_CUTS = 8  # a bound on the time of walls that are grazed
COVERED = np.float32(1 - 1e-6)  # shares are kept in single precision
LEAST_TEXELS = 1e-6  # of a strip at a wall's end: sums still tell them apart


@kernel
def draw_walls(camera: Pinhole, walls: Walls, plan: Plan, columns: np.ndarray) -> None:
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
            n = 0 if i == NONE else _cuts(camera, height_m, seen, i, low, high)
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
