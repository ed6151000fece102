"""One strip of a wall in one pixel column: each pixel's mean over its footprint on the wall.

A level camera sees an upright wall's strip at one depth, so its footprints are rectangles on the
wall, side by side up the column. Sums of all texels left of and below a corner (Crow 1984) give the
exact mean over each: first the difference of two columns of sums, then that of two of its rows.
"""

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
LEAST_TEXELS = 1e-6  # of a strip at a wall's end: sums still tell them apart


@njit(cache=True)
def add_column(
    camera: Pinhole, walls: Walls, seen: Float, j: int, face: np.ndarray, until: Float, count: int,
    total: Float, covered: Float, sums: Float,
) -> None:  # fmt: skip
    """Add what walls show in column j.

    Args:
        camera: level.
        walls: all faces.
        seen: as `sim.raycast.plan.project` gives them.
        j: the column.
        face: (MOST_STRIPS,) of its strips, as `sim.raycast.plan.strips` gives them.
        until: (MOST_STRIPS,) where they end.
        count: of them.
        total: (H,) grey levels times covered share, added to.
        covered: (H,) covered share of each pixel, added to.
        sums: room for a column of sums.
    """
    low = j - 0.5
    for s in range(count):
        i, high = face[s], until[s]
        if i != NONE:
            n = _cuts(camera, walls, seen[i], low, high)
            for k in range(n):
                a, b = low + k * (high - low) / n, low + (k + 1) * (high - low) / n
                _add_strip(camera, walls, seen, i, a, b, total, covered, sums)
        low = high


@njit(cache=True)
def _cuts(camera: Pinhole, walls: Walls, face: Float, low: float, high: float) -> int:
    """Into how many strips the one from `low` to `high` in u is cut."""
    w = face[2] + face[3] * (low + high) / 2
    highest = max(camera.eye_z_m, walls.height_m - camera.eye_z_m) * camera.focal_px * w
    from_middle = min(highest, max(camera.center_v, camera.height_px - 1 - camera.center_v))
    crossed = from_middle * abs(face[3]) / w * (high - low)
    return min(int(crossed / STEEPEST_ROWS) + 1, MOST_CUTS)


@njit(cache=True)
def most_texels_up(walls: Walls) -> int:
    """Of all faces."""
    most = 0
    for i in range(len(walls.size)):
        most = max(most, walls.size[i, 1])
    return most


@njit(cache=True)
def _add_strip(
    camera: Pinhole,
    walls: Walls,
    seen: Float,
    i: int,
    low: float,
    high: float,
    total: Float,
    covered: Float,
    column: Float,
) -> None:
    """Add what face i shows between `low` and `high` in u to a column's pixels."""
    w = seen[i, 2] + seen[i, 3] * (low + high) / 2
    texels_along, texels_up = walls.size[i]
    begin = (seen[i, 4] + seen[i, 5] * low) / (seen[i, 2] + seen[i, 3] * low) - seen[i, 6]
    end = (seen[i, 4] + seen[i, 5] * high) / (seen[i, 2] + seen[i, 3] * high) - seen[i, 6]
    per_m = texels_along / walls.width_m[i]
    begin, end = _inside(begin * per_m, end * per_m, float(texels_along))
    # rows of the picture that the strip reaches, and rows of texels that they see
    top = camera.center_v - (walls.height_m - camera.eye_z_m) * camera.focal_px * w
    bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
    first = max(int(np.floor(top + 0.5)), 0)
    last = min(int(np.floor(bottom + 0.5)), camera.height_px - 1)
    a_row = texels_up / (walls.height_m * camera.focal_px * w)  # texels
    at_center = camera.eye_z_m / walls.height_m * texels_up
    highest_q = at_center - (first - 0.5 - camera.center_v) * a_row
    lowest_q = at_center - (last + 0.5 - camera.center_v) * a_row
    lowest, highest = max(int(lowest_q) - 1, 0), min(int(highest_q) + 2, texels_up)
    _column_of_sums(walls, i, begin, end, lowest, highest, column)
    scale = (high - low) / (end - begin)
    _add_means(column, texels_up, highest_q, a_row, scale, total[first : last + 1])
    for v in range(first, last + 1):
        covered[v] += high - low
    covered[first] -= (high - low) * max(top - (first - 0.5), 0.0)
    covered[last] -= (high - low) * max(last + 0.5 - bottom, 0.0)


@njit(cache=True)
def _add_means(sums: Float, n: int, q: float, a_row: float, scale: float, total: Float) -> None:
    """Add means over footprints of `a_row` texels each, the first one's upper end at `q`.

    What sticks out over the wall's n texels adds nothing: it is the share that is not covered.
    """
    above = _until(sums, n, q)
    scale /= a_row
    for v in range(len(total)):
        q -= a_row
        below = _until(sums, n, q)
        total[v] += scale * (above - below)
        above = below


@njit(cache=True)
def _until(sums: Float, n: int, q: float) -> float:
    """The sum of all texels below a place between 0 and n."""
    q = min(max(q, 0.0), n - 1e-9)
    k = int(q)
    return sums[k] + (q - k) * (sums[k + 1] - sums[k])


@njit(cache=True)
def _inside(low: float, high: float, n: float) -> tuple[float, float]:
    """An interval of texels inside of 0 to n; never empty, since means over it are asked for."""
    low = min(max(low, 0.0), n - LEAST_TEXELS)
    return low, min(max(high, low + LEAST_TEXELS), n)


@njit(cache=True)
def _column_of_sums(
    walls: Walls, i: int, begin: float, end: float, lowest: int, highest: int, column: Float
) -> None:
    """Sums of all texels between two places along face i, below each row of texels."""
    texels_along, n = walls.size[i, 0], walls.size[i, 1] + 1
    k, m = min(int(begin), texels_along - 1), min(int(end), texels_along - 1)
    a, b = begin - k, end - m
    left, right = walls.first[i] + k * n + lowest, walls.first[i] + m * n + lowest
    count = highest + 1 - lowest
    low, after_low = walls.sums[left:][:count], walls.sums[left + n :][:count]
    high, after_high = walls.sums[right:][:count], walls.sums[right + n :][:count]
    sums = column[lowest : highest + 1]
    for r in range(count):
        # differences are exact, though the sums may have run over
        between = np.int32(high[r] - low[r])
        more, less = np.int32(after_high[r] - high[r]), np.int32(after_low[r] - low[r])
        sums[r] = between + b * more - a * less
