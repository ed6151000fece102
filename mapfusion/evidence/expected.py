"""Which landmarks of a map the robot of another must have seen, under a motion between the two."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.align.closest import Grid, runs_about
from mapfusion.se2 import Float
from mapfusion.viewing import Viewing

# A landmark is seen again from about where it was seen: as far off to within these ratios, and
# from a direction within that angle, descriptors match (U-SURF's window follows the depth, but not
# the slant).
NEAREST_RATIO, FARTHEST_RATIO = 0.7, 1.4
MOST_SLANT_RAD = math.radians(30.0)
LEAST_FRAMES = 3  # in which it lay in view: tracks become landmarks after as many sightings
# Beyond what was seen in that direction by no more than this a landmark is not hidden: the same
# wall, a little slanted within a part of the field of view.
_BEHIND_M = 0.3
_COS_SLANT = math.cos(MOST_SLANT_RAD)
# Of the distance r: how far from where it was seen the places lie from which it is seen so again,
# sqrt((1.4 cos 30 - 1)^2 + (1.4 sin 30)^2) at the most.
_PLACES = math.hypot(FARTHEST_RATIO * _COS_SLANT - 1, FARTHEST_RATIO * math.sin(MOST_SLANT_RAD))


class Watch(NamedTuple):
    """What a robot looked at, for the kernel.

    Attributes:
        places: the grid over its poses.
        heading: (T, 3) cosine, sine and angle of the poses, in the order of the grid.
        reach_m: (T, B) likewise.
        bearing_rad, range_m: (2,) of the field of view.
        height_m: (H, 2).
    """

    places: Grid
    heading: Float
    reach_m: np.ndarray
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, viewing: Viewing) -> "Watch":
        """Of viewing evidence."""
        field, places = viewing.field, Grid.of(viewing.pose[:, :2])
        theta = viewing.pose[places.row, 2]
        heading = np.stack([np.cos(theta), np.sin(theta), theta], axis=1)
        limits = (field.bearing_rad, field.range_m, field.height_m)
        return cls(places, heading, viewing.reach_m[places.row], *limits)


class Seen(NamedTuple):
    """N landmarks and how they were seen, in the frame of the robot that looks for them.

    Attributes:
        p: (N, 3) positions.
        direction: (N, 2) unit vectors from the robot that saw them.
        distance_m: (N,) from it; 0 for landmarks of which it is not known.
    """

    p: Float
    direction: Float
    distance_m: Float


@njit(cache=True)
def must_be_seen(seen: Seen, watch: Watch) -> np.ndarray:
    """Rows (n,) of the landmarks that lay in view, unhidden, in LEAST_FRAMES frames or more."""
    p, direction, distance_m = seen
    # arrays by themselves: taken from a tuple, each access would count its references
    places, heading, reach_m, bearing_rad, range_m, height_m = watch
    at, runs = places.p, np.empty((places.shape[1], 2), np.int64)
    rows, n = np.empty(len(p), np.int64), 0
    for i in range(len(p)):
        r, ux, uy = distance_m[i], direction[i, 0], direction[i, 1]
        least2, most2 = (NEAREST_RATIO * r) ** 2, (FARTHEST_RATIO * r) ** 2
        frames = 0
        about_x, about_y = p[i, 0] - r * ux, p[i, 1] - r * uy
        for run in range(runs_about(about_x, about_y, _PLACES * r, places, runs)):
            for t in range(runs[run, 0], runs[run, 1]):
                dx, dy = p[i, 0] - at[t, 0], p[i, 1] - at[t, 1]
                square, along = dx * dx + dy * dy, dx * ux + dy * uy
                if not least2 <= square <= most2 or along <= 0:
                    continue
                if along * along < _COS_SLANT * _COS_SLANT * square:
                    continue
                ahead = heading[t, 0] * dx + heading[t, 1] * dy
                left = heading[t, 0] * dy - heading[t, 1] * dx
                sight = (math.sqrt(square), math.atan2(left, ahead), p[i, 2])
                frames += _in_view(sight, bearing_rad, range_m, height_m, reach_m, t)
                if frames == LEAST_FRAMES:
                    break
            if frames == LEAST_FRAMES:
                break
        if frames == LEAST_FRAMES:
            rows[n] = i
            n += 1
    return rows[:n]


@njit(cache=True)
def _in_view(
    sight: tuple[float, float, float],
    bearings: Float,
    ranges: Float,
    heights: Float,
    reach_m: np.ndarray,
    t: int,
) -> bool:
    """Whether what lies at a range, a bearing and a height was in view at t, and nothing hid it.

    The view is by bearing (2,), range (2,) and heights (H, 2); reach_m is (T, B).
    """
    range_m, bearing, z_m = sight
    low, high, parts = bearings[0], bearings[1], reach_m.shape[1]
    if not ranges[0] <= range_m <= ranges[1] or high <= low or range_m == 0:
        return False
    if not low <= bearing <= high:
        return False
    step = min(int(range_m / ranges[1] * len(heights)), len(heights) - 1)
    if not heights[step, 0] <= z_m <= heights[step, 1]:
        return False
    part = min(int((bearing - low) / (high - low) * parts), parts - 1)
    return range_m <= reach_m[t, part] + _BEHIND_M
