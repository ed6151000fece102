"""Which landmarks of a map the robot of another must have seen, under a motion between the two."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.align.closest import Grid, runs_about
from mapfusion.se2 import Float
from mapfusion.viewing import Viewing

# In which it lay in view: a track is observed from its third frame on, and after three observations
# its landmark is in the map (the defaults of `TrackParameters.min_length` and `min_count`).
LEAST_FRAMES = 5
# How a landmark that another robot saw lay in view of this one: not at all; from another distance
# or side, from where some are found again (U-SURF's window follows the depth, but the window of one
# picture holds other things at another distance, and the slant changes it); from about where it was
# seen, from where nearly all are.
UNSEEN, MAY, MUST = 0, 1, 2


class Likeness(NamedTuple):
    """From where a landmark looks as it did: within a ratio of its distance, and an angle."""

    ratio: float
    slant_rad: float


LIKE = {MUST: Likeness(1.4, math.radians(30.0)), MAY: Likeness(2.0, math.radians(45.0))}
# Beyond what was seen in that direction by no more than this a landmark is not hidden: the same
# wall, a little slanted within a part of the field of view.
_BEHIND_M = 0.3
_MUST_RATIO2, _MAY_RATIO2 = LIKE[MUST].ratio ** 2, LIKE[MAY].ratio ** 2
_MUST_COS2, _MAY_COS2 = math.cos(LIKE[MUST].slant_rad) ** 2, math.cos(LIKE[MAY].slant_rad) ** 2
# Of the distance r: how far from where it was seen the places lie from which it may be seen so
# again: of the places on the edge, the farthest is as far off and as much aside as may be.
_PLACES = math.hypot(
    LIKE[MAY].ratio * math.cos(LIKE[MAY].slant_rad) - 1,
    LIKE[MAY].ratio * math.sin(LIKE[MAY].slant_rad),
)


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
def how_seen(seen: Seen, watch: Watch) -> np.ndarray:
    """UNSEEN, MAY or MUST (N,) of each landmark: LEAST_FRAMES frames or more had it in view so."""
    p, direction, distance_m = seen
    # arrays by themselves: taken from a tuple, each access would count its references
    places, heading, reach_m, bearing_rad, range_m, height_m = watch
    at, runs = places.p, np.empty((places.shape[1], 2), np.int64)
    how = np.zeros(len(p), np.int64)
    # what lies farther aside is not in view: most poses look elsewhere, told without an angle
    aside = max(abs(bearing_rad[0]), abs(bearing_rad[1]))
    least_cos = math.cos(aside) * (1 - 1e-9) if aside < math.pi / 2 else -1.0
    for i in range(len(p)):
        r, ux, uy = distance_m[i], direction[i, 0], direction[i, 1]
        r2, must, may = r * r, 0, 0
        about_x, about_y = p[i, 0] - r * ux, p[i, 1] - r * uy
        for run in range(runs_about(about_x, about_y, _PLACES * r, places, runs)):
            for t in range(runs[run, 0], runs[run, 1]):
                dx, dy = p[i, 0] - at[t, 0], p[i, 1] - at[t, 1]
                square, along = dx * dx + dy * dy, dx * ux + dy * uy
                if not r2 <= _MAY_RATIO2 * square <= _MAY_RATIO2 * _MAY_RATIO2 * r2:
                    continue
                if along <= 0 or along * along < _MAY_COS2 * square:
                    continue
                alike = r2 <= _MUST_RATIO2 * square <= _MUST_RATIO2 * _MUST_RATIO2 * r2
                alike = alike and along * along >= _MUST_COS2 * square
                if not alike and may >= LEAST_FRAMES:
                    continue
                ahead = heading[t, 0] * dx + heading[t, 1] * dy
                away_m = math.sqrt(square)
                if ahead < least_cos * away_m:
                    continue
                left = heading[t, 0] * dy - heading[t, 1] * dx
                sight = (away_m, math.atan2(left, ahead), p[i, 2])
                if _in_view(sight, bearing_rad, range_m, height_m, reach_m, t):
                    must, may = must + alike, may + 1
                if must == LEAST_FRAMES:
                    break
            if must == LEAST_FRAMES:
                break
        if must == LEAST_FRAMES:
            how[i] = MUST
        elif may >= LEAST_FRAMES:
            how[i] = MAY
    return how


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
