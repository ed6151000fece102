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
# Of the distance r: how far from where it was seen the places lie from which it is seen so again,
# sqrt((1.4 cos 30 - 1)^2 + (1.4 sin 30)^2) at the most.
_PLACES = math.hypot(
    FARTHEST_RATIO * math.cos(MOST_SLANT_RAD) - 1, FARTHEST_RATIO * math.sin(MOST_SLANT_RAD)
)


class Watch(NamedTuple):
    """What a robot looked at, for the kernel.

    Attributes:
        places: the grid over its poses.
        pose: (T, 3).
        reach_m: (T, B).
        bearing_rad, range_m: (2,) of the field of view.
        height_m: (H, 2).
    """

    places: Grid
    pose: Float
    reach_m: np.ndarray
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, viewing: Viewing) -> "Watch":
        """Of viewing evidence."""
        field, pose = viewing.field, np.ascontiguousarray(viewing.pose)
        reach = np.ascontiguousarray(viewing.reach_m)
        limits = (field.bearing_rad, field.range_m, field.height_m)
        return cls(Grid.of(pose[:, :2]), pose, reach, *limits)


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
    runs = np.empty((watch.places.shape[1], 2), np.int64)
    rows, n = np.empty(len(seen.p), np.int64), 0
    for i in range(len(seen.p)):
        r = seen.distance_m[i]
        x = seen.p[i, 0] - r * seen.direction[i, 0]
        y = seen.p[i, 1] - r * seen.direction[i, 1]
        frames = 0
        for run in range(runs_about(x, y, _PLACES * r, watch.places, runs)):
            for k in range(runs[run, 0], runs[run, 1]):
                if frames < LEAST_FRAMES and in_view(seen, i, watch.places.row[k], watch):
                    frames += 1
        if frames == LEAST_FRAMES:
            rows[n] = i
            n += 1
    return rows[:n]


@njit(cache=True)
def in_view(seen: Seen, i: int, t: int, watch: Watch) -> bool:
    """Whether landmark i lay in frame t as it was seen before, and nothing hid it."""
    dx, dy = seen.p[i, 0] - watch.pose[t, 0], seen.p[i, 1] - watch.pose[t, 1]
    range_m, before_m = math.hypot(dx, dy), seen.distance_m[i]
    if not NEAREST_RATIO * before_m <= range_m <= FARTHEST_RATIO * before_m or range_m == 0:
        return False
    if not watch.range_m[0] <= range_m <= watch.range_m[1]:
        return False
    along = dx * seen.direction[i, 0] + dy * seen.direction[i, 1]
    if along < math.cos(MOST_SLANT_RAD) * range_m:
        return False
    cos, sin = math.cos(watch.pose[t, 2]), math.sin(watch.pose[t, 2])
    bearing = math.atan2(cos * dy - sin * dx, cos * dx + sin * dy)
    low, high = watch.bearing_rad[0], watch.bearing_rad[1]
    if not low <= bearing <= high or high <= low:
        return False
    step = min(int(range_m / watch.range_m[1] * len(watch.height_m)), len(watch.height_m) - 1)
    if not watch.height_m[step, 0] <= seen.p[i, 2] <= watch.height_m[step, 1]:
        return False
    parts = watch.reach_m.shape[1]
    part = min(int((bearing - low) / (high - low) * parts), parts - 1)
    return range_m <= watch.reach_m[t, part] + _BEHIND_M
