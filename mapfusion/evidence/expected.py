"""Which landmarks of a map the robot of another must have seen, under a motion between the two."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.align.bits import WORD, packed, trailing_zeros
from mapfusion.se2 import Float, wrap
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
_MAY_RATIO, _MAY_COS = LIKE[MAY].ratio, math.cos(LIKE[MAY].slant_rad)
# Frames in a row that are ruled out at once: in so many a robot neither drives nor turns far.
_STRETCH = 8
_ROUNDING = 1e-9  # of a distance or an angle: more than it is off by rounding


class Stretches(NamedTuple):
    """C stretches of _STRETCH frames in a row, the last one shorter, for the kernel.

    Attributes:
        x_m, y_m: (C,) middle of the places.
        radius_m: (C,) about it within which all of them lie.
        cos, sin: (C,) of the mean heading.
        least_cos: (C,) of the angle between this and whatever lies in view from any of them.
        reach_m: (C,) range of the farthest that any of them had in view.
    """

    x_m: Float
    y_m: Float
    radius_m: Float
    cos: Float
    sin: Float
    least_cos: Float
    reach_m: Float

    @classmethod
    def of(cls, pose: Float, farthest_m: Float, aside_rad: float) -> "Stretches":
        """Of poses (T, 3) with what was in view: so far (T,), so far aside from their heading."""
        n = -(-len(pose) // _STRETCH)
        rows = np.minimum(np.arange(n * _STRETCH), len(pose) - 1).reshape(n, _STRETCH)
        places, theta = pose[rows, :2], pose[rows, 2]
        middle = (places.min(axis=1) + places.max(axis=1)) / 2
        radius = np.sqrt(np.sum((places - middle[:, None]) ** 2, axis=2)).max(axis=1)
        mean = np.arctan2(np.sin(theta).sum(axis=1), np.cos(theta).sum(axis=1))
        turned = np.abs(wrap(theta - mean[:, None])).max(axis=1)
        least = np.cos(np.minimum(aside_rad + turned + _ROUNDING, np.pi))
        x, y = middle.T.copy()
        return cls(x, y, radius, np.cos(mean), np.sin(mean), least, farthest_m[rows].max(axis=1))


class Watch(NamedTuple):
    """What a robot looked at, for the kernel.

    Attributes:
        place: (T, 2) of its poses.
        heading: (T, 3) cosine, sine and angle of them.
        reach_m: (T, B).
        farthest_m: (T,) range up to which anything was in view.
        stretches: the poses, several at a time.
        bearing_rad, range_m: (2,) of the field of view.
        height_m: (H, 2).
    """

    place: Float
    heading: Float
    reach_m: np.ndarray
    farthest_m: Float
    stretches: Stretches
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, viewing: Viewing) -> "Watch":
        """Of viewing evidence."""
        field, pose, theta = viewing.field, viewing.pose, viewing.pose[:, 2]
        heading = np.stack([np.cos(theta), np.sin(theta), theta], axis=1)
        farthest = viewing.reach_m.max(axis=1, initial=0.0).astype(np.float64) + _BEHIND_M
        stretches = Stretches.of(pose, farthest, float(np.abs(field.bearing_rad).max()))
        limits = (field.bearing_rad, field.range_m, field.height_m)
        return cls(pose[:, :2].copy(), heading, viewing.reach_m, farthest, stretches, *limits)


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
    at, heading, reach_m, farthest_m, stretches, bearing_rad, range_m, height_m = watch
    x, y, radius, cos, sin, least, reach = stretches
    how = np.zeros(len(p), np.int64)
    # what lies farther aside is not in view: most poses look elsewhere, told without an angle
    aside = max(abs(bearing_rad[0]), abs(bearing_rad[1]))
    least_cos = math.cos(aside) * (1 - _ROUNDING) if aside < math.pi / 2 else -1.0
    eights = np.zeros((len(x) + WORD - 1) // WORD * 8, np.uint64)
    possible = eights.view(np.uint8)[: len(x)]
    for i in range(len(p)):
        r, ux, uy = distance_m[i], direction[i, 0], direction[i, 1]
        own = (p[i, 0], p[i, 1], ux, uy, max(r / _MAY_RATIO, range_m[0]), r * _MAY_RATIO)
        _mark_possible(own, x, y, radius, cos, sin, least, reach, possible)
        r2, must, may = r * r, 0, 0
        for w in range(len(eights) // 8):
            word = packed(eights, w)
            while word and must < LEAST_FRAMES:
                first = (w * WORD + trailing_zeros(word)) * _STRETCH
                word &= word - np.uint64(1)
                for t in range(first, min(first + _STRETCH, len(at))):
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
                    if ahead < least_cos * away_m or away_m > farthest_m[t]:
                        continue
                    left = heading[t, 0] * dy - heading[t, 1] * dx
                    sight = (away_m, ahead, left, p[i, 2])
                    if _in_view(sight, bearing_rad, range_m, height_m, reach_m, t):
                        must, may = must + alike, may + 1
            if must >= LEAST_FRAMES:
                break
        if must >= LEAST_FRAMES:
            how[i] = MUST
        elif may >= LEAST_FRAMES:
            how[i] = MAY
    return how


@njit(cache=True)
def _mark_possible(
    own: tuple[float, float, float, float, float, float],
    x: Float,
    y: Float,
    radius: Float,
    cos: Float,
    sin: Float,
    least_cos: Float,
    reach_m: Float,
    possible: np.ndarray,
) -> None:
    """Mark the stretches (C,) that may have a pose from which a landmark lies in view as it did.

    Of the landmark are given its place, the direction in which it was seen, and how near and how
    far a pose may be. A place that is off by no more than a radius changes each length below by no
    more than twice that. Written so that the compiler takes several at once: no index but the
    loop's own, no branch.
    """
    at_x, at_y, ux, uy, nearest, farthest = own
    for k in range(len(possible)):
        dx, dy = at_x - x[k], at_y - y[k]
        away = math.sqrt(dx * dx + dy * dy)
        off = radius[k] + _ROUNDING * away
        along, ahead = dx * ux + dy * uy, cos[k] * dx + sin[k] * dy
        possible[k] = (
            (away + off >= nearest)
            & (away - off <= farthest)
            & (away - off <= reach_m[k])
            & (along + 2 * off >= _MAY_COS * away)
            & (ahead + 2 * off >= least_cos[k] * away)
        )


@njit(cache=True)
def _in_view(
    sight: tuple[float, float, float, float],
    bearings: Float,
    ranges: Float,
    heights: Float,
    reach_m: np.ndarray,
    t: int,
) -> bool:
    """Whether what lies at a range, ahead and left by so much, was in view at t, and not hidden.

    The fourth of what lies there is its height. The view is by bearing (2,), range (2,) and heights
    (H, 2); reach_m is (T, B).
    """
    range_m, ahead, left, z_m = sight
    low, high, parts = bearings[0], bearings[1], reach_m.shape[1]
    if not ranges[0] <= range_m <= ranges[1] or high <= low or range_m == 0:
        return False
    step = min(int(range_m / ranges[1] * len(heights)), len(heights) - 1)
    if not heights[step, 0] <= z_m <= heights[step, 1]:
        return False
    bearing = math.atan2(left, ahead)
    if not low <= bearing <= high:
        return False
    part = min(int((bearing - low) / (high - low) * parts), parts - 1)
    return range_m <= reach_m[t, part] + _BEHIND_M
