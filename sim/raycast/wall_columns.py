"""Walls, pixel column by pixel column: each pixel's mean over its footprint on the wall.

A level camera sees an upright wall's strip at one depth, so its footprints are rectangles on the
wall, side by side up the column. Sums of all texels left of and below a corner (Crow 1984) give the
exact mean over each: first the difference of two columns of sums, then that of two of its rows.
Each loop does one thing: those that only look up and those that only reckon run in the processor's
vectors, one that does both does not.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from sim.raycast.plan import NONE, Pinhole
from sim.raycast.scene import Walls

# A wall's level lines cross a column at a slope, which cuts a footprint's corners. A strip is cut
# into so many that lines cross each by no more than this: of cuts twice as fine the picture differs
# by less than a grey level is rounded, of cuts twice as coarse visibly.
STEEPEST_ROWS = 0.5
MOST_CUTS = 8  # a bound on the time of walls that are grazed
COVERED = np.float32(1 - 1e-6)  # shares are kept in single precision
LEAST_TEXELS = 1e-6  # of a strip at a wall's end: sums still tell them apart


class Column(NamedTuple):
    """Room for what one column needs on the way, in single precision.

    Attributes:
        sums: of a strip's texels up to each row of texels.
        row: (H + 1,) int32 row of texels in which the edges between pixels lie.
        share: (H + 1,) of that row below the edge.
        until: (H + 1,) sum of all that lies below the edge.
        more: (H + 1,) what that row adds.
        total: (H,) grey levels times covered share.
        covered: (H,) share of each pixel that walls cover.
        rounded: (H,) uint8 of `total`.
    """

    sums: np.ndarray
    row: np.ndarray
    share: np.ndarray
    until: np.ndarray
    more: np.ndarray
    total: np.ndarray
    covered: np.ndarray
    rounded: np.ndarray


@njit(cache=True)
def open_rows(
    camera: Pinhole, walls: Walls, seen: Float, face: np.ndarray, until: Float, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How many rows from the upper edge and from the lower one walls leave open, wholly or partly.

    Args:
        camera: level.
        walls: all faces.
        seen: as `sim.raycast.plan.project` gives them.
        face: as `sim.raycast.plan.strips` gives them.
        until: likewise.
        count: likewise.

    Returns:
        Of each column (W,) those above the horizon, and those from it on.
    """
    above = np.zeros(camera.width_px, dtype=np.int32)
    below = np.zeros(camera.width_px, dtype=np.int32)
    horizon = int(np.ceil(camera.center_v))
    for j in range(camera.width_px):
        low = j - 0.5
        for s in range(count[j]):
            i, high = face[j, s], until[j, s]
            # where it is farthest; nowhere it is infinitely far
            w = min(seen[i, 2] + seen[i, 3] * low, seen[i, 2] + seen[i, 3] * high)
            top, bottom = _edges(camera, walls, 0.0 if i == NONE else w)
            rows = min(int(max(np.floor(top + 0.5) + 1, 0.0)), horizon)
            above[j] = max(above[j], rows)
            rows = camera.height_px - max(int(np.floor(bottom + 0.5)), horizon)
            below[j] = max(below[j], rows)
            low = high
    return above, below


@njit(cache=True)
def _edges(camera: Pinhole, walls: Walls, w: float) -> tuple[float, float]:
    """Where a wall's upper and lower edge lie in v, at inverse depth w."""
    top = camera.center_v - (walls.height_m - camera.eye_z_m) * camera.focal_px * w
    return top, camera.center_v + camera.eye_z_m * camera.focal_px * w


@njit(cache=True)
def draw_walls(
    camera: Pinhole,
    walls: Walls,
    seen: Float,
    face: np.ndarray,
    until: Float,
    count: np.ndarray,
    picture: np.ndarray,
) -> None:
    """Draw walls over a picture (H, W) uint8 of what is behind them; arguments as above."""
    height, most_up = camera.height_px, 0
    for i in range(len(walls.size)):
        most_up = max(most_up, walls.size[i, 1])
    column = Column(
        np.empty(most_up + 1, dtype=np.float32),
        np.empty(height + 1, dtype=np.int32),
        np.empty(height + 1, dtype=np.float32),
        np.empty(height + 1, dtype=np.float32),
        np.empty(height + 1, dtype=np.float32),
        np.empty(height, dtype=np.float32),
        np.empty(height, dtype=np.float32),
        np.empty(height, dtype=np.uint8),
    )
    for j in range(camera.width_px):
        first, last = _add_column(camera, walls, seen, j, face, until, count[j], column)
        _show(column, first, last, j, picture)


@njit(cache=True)
def _show(column: Column, first: int, last: int, j: int, picture: np.ndarray) -> None:
    """Draw a column's rows from `first` to `last`, rounded, over what is there."""
    for v in range(len(column.total)):
        column.rounded[v] = np.uint8(np.int32(column.total[v] + np.float32(0.5)))
    for v in range(first, last + 1):
        if column.covered[v] < COVERED:
            shown = column.total[v] + (1 - column.covered[v]) * picture[v, j]
            picture[v, j] = np.uint8(shown + 0.5)
        else:
            picture[v, j] = column.rounded[v]


@njit(cache=True)
def _add_column(
    camera: Pinhole,
    walls: Walls,
    seen: Float,
    j: int,
    face: np.ndarray,
    until: Float,
    count: int,
    column: Column,
) -> tuple[int, int]:
    """Fill in `total` and `covered` of column j; the first and the last row that walls are in."""
    column.total[:] = 0.0
    column.covered[:] = 0.0
    first, last = camera.height_px - 1, 0
    low = j - 0.5
    for s in range(count):
        i, high = face[j, s], until[j, s]
        if i != NONE:
            n = _cuts(camera, walls, seen[i, 2], seen[i, 3], low, high)
            for k in range(n):
                a, b = low + k * (high - low) / n, low + (k + 1) * (high - low) / n
                upper, lower = _add_strip(camera, walls, seen, i, a, b, column)
                first, last = min(first, upper), max(last, lower)
        low = high
    return first, last


@njit(cache=True)
def _cuts(
    camera: Pinhole, walls: Walls, at_zero: float, slope: float, low: float, high: float
) -> int:
    """Into how many strips one is cut whose inverse depth is at_zero + slope u."""
    w = at_zero + slope * (low + high) / 2
    highest = max(camera.eye_z_m, walls.height_m - camera.eye_z_m) * camera.focal_px * w
    from_middle = min(highest, max(camera.center_v, camera.height_px - 1 - camera.center_v))
    crossed = from_middle * abs(slope) / w * (high - low)
    return min(int(crossed / STEEPEST_ROWS) + 1, MOST_CUTS)


@njit(cache=True)
def _add_strip(
    camera: Pinhole,
    walls: Walls,
    seen: Float,
    i: int,
    low: float,
    high: float,
    column: Column,
) -> tuple[int, int]:
    """Add what face i shows between `low` and `high` in u; the rows from and to which it does."""
    w_0, w_u, t_0, t_u = seen[i, 2], seen[i, 3], seen[i, 4], seen[i, 5]
    w = w_0 + w_u * (low + high) / 2
    texels_along, texels_up = walls.size[i, 0], walls.size[i, 1]
    begin = (t_0 + t_u * low) / (w_0 + w_u * low) - seen[i, 6]
    end = (t_0 + t_u * high) / (w_0 + w_u * high) - seen[i, 6]
    per_m = texels_along / walls.width_m[i]
    begin, end = _inside(begin * per_m, end * per_m, float(texels_along))
    # rows of the picture that the strip reaches, and rows of texels that they see
    top, bottom = _edges(camera, walls, w)
    first = int(max(np.floor(top + 0.5), 0.0))
    last = int(min(np.floor(bottom + 0.5), camera.height_px - 1.0))
    a_row = texels_up / (walls.height_m * camera.focal_px * w)  # texels
    at_center = camera.eye_z_m / walls.height_m * texels_up
    highest_q = at_center - (first - 0.5 - camera.center_v) * a_row
    lowest_q = at_center - (last + 0.5 - camera.center_v) * a_row
    lowest, highest = max(int(lowest_q) - 1, 0), min(int(highest_q) + 2, texels_up)
    _column_of_sums(walls, i, begin, end, lowest, highest, column.sums)
    scale = (high - low) / ((end - begin) * a_row)
    _add_means(column, highest - lowest, highest_q - lowest, a_row, scale, first, last)
    _cover(column, high - low, top, bottom, first, last)
    return first, last


@njit(cache=True)
def _cover(column: Column, share: float, top: float, bottom: float, first: int, last: int) -> None:
    """Add a strip's share to what is covered of pixels, less of those that its edges cross."""
    for v in range(first, last + 1):
        column.covered[v] += np.float32(share)
    column.covered[first] -= share * max(top - (first - 0.5), 0.0)
    column.covered[last] -= share * max(last + 0.5 - bottom, 0.0)


@njit(cache=True)
def _inside(low: float, high: float, n: float) -> tuple[float, float]:
    """An interval of texels inside of 0 to n; never empty, since means over it are asked for."""
    low = min(max(low, 0.0), n - LEAST_TEXELS)
    return low, min(max(high, low + LEAST_TEXELS), n)


@njit(cache=True)
def _column_of_sums(
    walls: Walls, i: int, begin: float, end: float, lowest: int, highest: int, sums: np.ndarray
) -> None:
    """Sums of all texels between two places along face i, from the row `lowest` up to each row."""
    texels_along, n = walls.size[i, 0], walls.size[i, 1] + 1
    k, m = min(int(begin), texels_along - 1), min(int(end), texels_along - 1)
    a, b = np.float32(begin - k), np.float32(end - m)
    left, right = walls.first[i] + k * n + lowest, walls.first[i] + m * n + lowest
    count = highest + 1 - lowest
    low, after_low = walls.sums[left:][:count], walls.sums[left + n :][:count]
    high, after_high = walls.sums[right:][:count], walls.sums[right + n :][:count]
    # differences are exact, though the sums may have run over
    between = np.int32(high[0] - low[0])
    more, less = np.int32(after_high[0] - high[0]), np.int32(after_low[0] - low[0])
    for r in range(count):
        whole = np.int32(np.int32(high[r] - low[r]) - between)
        gained = np.int32(np.int32(after_high[r] - high[r]) - more)
        lost = np.int32(np.int32(after_low[r] - low[r]) - less)
        sums[r] = np.float32(whole) + (b * np.float32(gained) - a * np.float32(lost))


@njit(cache=True)
def _add_means(
    column: Column,
    n: int,
    q: float,
    a_row: float,
    scale: float,
    first: int,
    last: int,
) -> None:
    """Add means over footprints of `a_row` texels each, that of row `first` ending at `q` above.

    What sticks out over the n rows of texels adds nothing: it is the share that is not covered.
    """
    sums, row, share, until, more = column.sums, column.row, column.share, column.until, column.more
    total, start = column.total, np.uint64(first)
    edges, top, weight = last + 2 - first, np.float32(n), np.float32(scale)
    begin, step, last_row = np.float32(q), np.float32(a_row), np.int32(n - 1)
    for v in range(edges):
        at = min(max(begin - step * np.float32(v), np.float32(0)), top)
        row[v] = min(np.int32(at), last_row)
        share[v] = at - np.float32(row[v])
    for v in range(edges):
        k = np.uint64(row[v])
        until[v] = sums[k]
        more[v] = sums[k + np.uint64(1)]
    for v in range(edges):
        until[v] += share[v] * (more[v] - until[v])
    for v in range(edges - 1):
        total[start + np.uint64(v)] += weight * (until[v] - until[v + 1])
