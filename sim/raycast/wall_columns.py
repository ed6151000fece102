"""One strip of a wall in one pixel column: each pixel's mean over its footprint on the wall.

A level camera sees an upright wall's strip at one depth, so its footprints are rectangles on the
wall, side by side up the column. Sums of all texels left of and below a corner (Crow 1984) give the
exact mean over each: first the difference of two columns of sums, then that of two of its rows.
"""

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from sim.raycast.plan import Pinhole
from sim.raycast.scene import Walls

# A wall's level lines cross a column at a slope, which cuts a footprint's corners. A strip is cut
# into so many that they cross none of them by more than this, up to a most.
STEEPEST = 0.5
MOST_CUTS = 8


@njit(cache=True)
def cuts(camera: Pinhole, walls: Walls, face: Float, low: float, high: float) -> int:
    """Into how many strips the one from `low` to `high` in u is cut."""
    w = face[2] + face[3] * (low + high) / 2
    highest = max(camera.eye_z_m, walls.height_m - camera.eye_z_m) * camera.focal_px * w
    from_middle = min(highest, max(camera.center_v, camera.height_px - 1 - camera.center_v))
    crossed = from_middle * abs(face[3]) / w * (high - low)
    return min(int(crossed / STEEPEST) + 1, MOST_CUTS)


@njit(cache=True)
def add_strip(
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
    """Add what face i shows between `low` and `high` in u to a column's pixels.

    Args:
        camera: level.
        walls: all faces.
        seen: as `sim.raycast.plan.project` gives them.
        i: the face.
        low: where the strip begins in u.
        high: where it ends.
        total: (H,) grey levels times covered share, added to.
        covered: (H,) covered share of each pixel, added to.
        column: room for a column of sums.
    """
    w = seen[i, 2] + seen[i, 3] * (low + high) / 2
    texels_along, texels_up = walls.size[i]
    begin = (seen[i, 4] + seen[i, 5] * low) / (seen[i, 2] + seen[i, 3] * low) - seen[i, 6]
    end = (seen[i, 4] + seen[i, 5] * high) / (seen[i, 2] + seen[i, 3] * high) - seen[i, 6]
    per_m = texels_along / walls.width_m[i]
    begin, end = _at_least_a_texel(begin * per_m, end * per_m, texels_along)
    # rows of the picture that the strip reaches, and rows of texels that they see
    top = camera.center_v - (walls.height_m - camera.eye_z_m) * camera.focal_px * w
    bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
    first = max(int(np.floor(top + 0.5)), 0)
    last = min(int(np.floor(bottom + 0.5)), camera.height_px - 1)
    a_row = texels_up / (walls.height_m * camera.focal_px * w)  # texels
    at_center = camera.eye_z_m / walls.height_m * texels_up
    lowest = max(int(at_center - (last + 0.5 - camera.center_v) * a_row) - 1, 0)
    highest = min(int(at_center - (first - 0.5 - camera.center_v) * a_row) + 2, texels_up)
    _column_of_sums(walls, i, begin, end, lowest, highest, column)
    width, pixel = high - low, end - begin
    for v in range(first, last + 1):
        share = width * (min(v + 0.5, bottom) - max(v - 0.5, top))
        middle = at_center - (v - camera.center_v) * a_row
        below, above = _at_least_a_texel(middle - a_row / 2, middle + a_row / 2, texels_up)
        k, m = int(below), int(above)
        sum_below = column[k] + (below - k) * (column[min(k + 1, texels_up)] - column[k])
        sum_above = column[m] + (above - m) * (column[min(m + 1, texels_up)] - column[m])
        total[v] += share * (sum_above - sum_below) / ((above - below) * pixel)
        covered[v] += share


@njit(cache=True)
def _at_least_a_texel(low: float, high: float, n: int) -> tuple[float, float]:
    """An interval of texels, widened to one (linear interpolation), inside of 0 to n."""
    if high - low < 1:
        low, high = (low + high - 1) / 2, (low + high + 1) / 2
    low, high = min(max(low, 0.0), n - 0.5), max(min(high, float(n)), 0.5)
    return low, high


@njit(cache=True)
def _column_of_sums(
    walls: Walls, i: int, begin: float, end: float, lowest: int, highest: int, column: Float
) -> None:
    """Sums of all texels between two places along face i, below each row of texels."""
    texels_along, texels_up = walls.size[i]
    n = texels_up + 1
    k, m = min(int(begin), texels_along - 1), min(int(end), texels_along - 1)
    a, b = begin - k, end - m
    sums = walls.sums
    left, right = walls.first[i] + k * n, walls.first[i] + m * n
    for r in range(lowest, highest + 1):
        # differences are exact, though the sums may have run over
        between = np.uint32(sums[right + r] - sums[left + r])
        more = np.uint32(sums[right + n + r] - sums[right + r])
        less = np.uint32(sums[left + n + r] - sums[left + r])
        column[r] = between + b * more - a * less
