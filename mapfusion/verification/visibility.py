"""Visibility: landmarks of one map that the robot of the other must have seen."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import WORD, Float, kernel, ones, packed, trailing_zeros
from mapfusion.geometry.se2 import wrap
from mapfusion.viewing import FieldOfView, Viewing

# Frames in a row that are looked at together: in so many a robot neither drives nor turns far.
STRETCH = 8
ROUNDING = 1e-9  # of a distance, an angle or a slope: more than it is off by rounding
# Beyond what was seen in that direction by no more than this a landmark is not hidden: the same
# wall, a little slanted within a part of the field of view.
BEHIND_M = 0.3
CELLS = 512  # of slopes; so many that few hold an edge of a part
_STEEPEST_RAD = math.pi / 2 - 1e-3  # aside: from there on a slope says little of an angle


class Stretches(NamedTuple):
    """C stretches of STRETCH frames in a row, the last one shorter.

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


class Poses(NamedTuple):
    """The poses of C stretches, the last one filled up with poses that saw nothing.

    Attributes:
        x_m, y_m, cos, sin: (C, STRETCH) places and headings.
        reach_m: (C, STRETCH (B + 2)) range up to which something was in view in each of B parts of
            the field of view; then for what lies in none of them, and for what may lie in any.
    """

    x_m: Float
    y_m: Float
    cos: Float
    sin: Float
    reach_m: Float


class BearingSectors(NamedTuple):
    """In which of B parts of the field of view something lies, by its slope: left over ahead.

    Attributes:
        part: (CELLS,) of a cell of slopes; B where it is in none, B + 1 where an edge is near.
        first: slope at which the first cell begins.
        per_slope: cells for a slope of 1.
    """

    part: np.ndarray
    first: float
    per_slope: float

    @classmethod
    def of(cls, field: FieldOfView, parts: int) -> "BearingSectors":
        """Of a field of view in so many parts of equal angles."""
        low, high = field.bearing_rad
        if not low < high:
            return cls(np.full(CELLS, parts), 0.0, 1.0)
        if max(abs(low), abs(high)) > _STEEPEST_RAD:
            return cls(np.full(CELLS, parts + 1), 0.0, 1.0)
        width = (math.tan(high) - math.tan(low)) / (CELLS - 4)  # the outer two lie in no part
        first = math.tan(low) - 2 * width
        begins = first + width * np.arange(CELLS)
        ends = begins[None] + np.array([[-ROUNDING], [width + ROUNDING]])
        lowest, highest = np.floor((np.arctan(ends) - low) / (high - low) * parts)
        part = np.where(lowest == highest, lowest, parts + 1)
        part[(highest < 0) | (lowest >= parts)] = parts
        return cls(part.astype(np.int64), first, 1 / width)


class ViewingHistory(NamedTuple):
    """All poses of a path of T frames, and what was in view from them.

    Attributes:
        stretches: several poses together.
        poses: by themselves.
        parts: of the field of view.
        reach_m: (T, B) range of the farthest landmark seen in each part.
        bearing_rad, range_m: (2,) of the field of view.
        height_m: (H, 2).
    """

    stretches: Stretches
    poses: Poses
    parts: BearingSectors
    reach_m: np.ndarray
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, viewing: Viewing) -> "ViewingHistory":
        """Of viewing evidence."""
        field, reach = viewing.field, viewing.reach_m
        n_frames, n_parts = reach.shape
        n = -(-n_frames // STRETCH)
        farthest = np.full((n * STRETCH, n_parts + 2), -np.inf)
        farthest[:n_frames, :n_parts] = reach.astype(np.float64) + BEHIND_M
        farthest[:n_frames, n_parts + 1] = np.inf
        rows = np.minimum(np.arange(n * STRETCH), n_frames - 1).reshape(n, STRETCH)
        x, y, theta = (np.ascontiguousarray(viewing.pose[rows, k]) for k in range(3))
        aside_rad = float(np.abs(field.bearing_rad).max())
        reach_m = farthest[:, :n_parts].reshape(n, -1).max(axis=1)
        poses = Poses(x, y, np.cos(theta), np.sin(theta), farthest.reshape(n, -1))
        together = _together(poses, theta, reach_m, aside_rad)
        limits = field.bearing_rad, field.range_m, field.height_m
        return cls(together, poses, BearingSectors.of(field, n_parts), reach, *limits)


def _together(poses: Poses, theta: Float, reach_m: Float, aside_rad: float) -> Stretches:
    """Poses of angles theta (C, STRETCH) that saw so far (C,), and so far aside."""
    x, y = ((v.min(axis=1) + v.max(axis=1)) / 2 for v in (poses.x_m, poses.y_m))
    square = (poses.x_m - x[:, None]) ** 2 + (poses.y_m - y[:, None]) ** 2
    mean = np.arctan2(poses.sin.sum(axis=1), poses.cos.sum(axis=1))
    turned = np.abs(wrap(theta - mean[:, None])).max(axis=1)
    least = np.cos(np.minimum(aside_rad + turned + ROUNDING, np.pi))
    return Stretches(x, y, np.sqrt(square.max(axis=1)), np.cos(mean), np.sin(mean), least, reach_m)


# In which it lay in view: a track is observed from its third frame on, and after three observations
# its landmark is in the map (the defaults of `TrackParameters.min_length` and `min_count`).
LEAST_FRAMES = 5
# How a landmark that another robot saw lay in view of this one: not at all; from another distance
# or side, from where some are found again (U-SURF's window follows the depth, but the window of one
# picture holds other things at another distance, and the slant changes it); from about where it was
# seen, from where nearly all are.
UNSEEN, MAY, MUST = 0, 1, 2


class ViewpointTolerance(NamedTuple):
    """From where a landmark looks as it did: within a ratio of its distance, and an angle."""

    ratio: float
    slant_rad: float


VIEWPOINT_TOLERANCES = {
    MUST: ViewpointTolerance(1.4, math.radians(30.0)),
    MAY: ViewpointTolerance(2.0, math.radians(45.0)),
}
_MUST_RATIO2, _MAY_RATIO2 = (
    VIEWPOINT_TOLERANCES[MUST].ratio ** 2,
    VIEWPOINT_TOLERANCES[MAY].ratio ** 2,
)
_MUST_COS2, _MAY_COS2 = (
    math.cos(VIEWPOINT_TOLERANCES[MUST].slant_rad) ** 2,
    math.cos(VIEWPOINT_TOLERANCES[MAY].slant_rad) ** 2,
)
_MAY_RATIO, _MAY_COS = (
    VIEWPOINT_TOLERANCES[MAY].ratio,
    math.cos(VIEWPOINT_TOLERANCES[MAY].slant_rad),
)
_ONES = np.uint64(0x0101010101010101)  # the lowest bit of each byte
# Bits of what `_look` says of a pose: it may have seen a landmark, from about where it was seen, or
# so it is but for the part of the field of view, which is to be looked up by the angle.
_MAY_BIT, _ALIKE_BIT, _UNSURE_BIT = 0, 1, 2
_LEAST_AHEAD = 1e-300  # m; what is behind has no slope, and is told by its sign


class ObservedLandmarks(NamedTuple):
    """N landmarks and how they were seen, in the frame of the robot that looks for them.

    Attributes:
        p: (N, 3) positions.
        direction: (N, 2) unit vectors from the robot that saw them.
        distance_m: (N,) from it; 0 for landmarks of which it is not known.
    """

    p: Float
    direction: Float
    distance_m: Float


@kernel
def classify_visibility(seen: ObservedLandmarks, watch: ViewingHistory) -> np.ndarray:
    """UNSEEN, MAY or MUST (N,) of each landmark: LEAST_FRAMES frames or more had it in view so."""
    p, direction, distance_m = seen
    # arrays by themselves: taken from a tuple, each access would count its references
    stretches, poses, parts, reach_m, bearing_rad, range_m, height_m = watch
    x, y, radius, cos, sin, least_cos, stretch_m = stretches
    how = np.zeros(len(p), np.int64)
    eights = np.zeros((len(x) + WORD - 1) // WORD * 8, np.uint64)
    possible = eights.view(np.uint8)[: len(x)]
    lanes = np.zeros(1, np.uint64)
    said = lanes.view(np.uint8)
    for i in range(len(p)):
        # a plain 0 is a type of its own, for which kernels would be compiled once more
        r, ux, uy, levels = distance_m[i], direction[i, 0], direction[i, 1], np.int64(0)
        for step in range(len(height_m)):
            levels |= (height_m[step, 0] <= p[i, 2] <= height_m[step, 1]) << step
        own = p[i, 0], p[i, 1], ux, uy, max(r / _MAY_RATIO, range_m[0]), r * _MAY_RATIO
        _mark_possible(own, x, y, radius, cos, sin, least_cos, stretch_m, possible)
        must = may = 0
        for w in range(len(eights) // 8):
            word = packed(eights, w)
            while word and must < LEAST_FRAMES:
                c = w * WORD + trailing_zeros(word)
                word &= word - np.uint64(1)
                sight = p[i, 0], p[i, 1], ux, uy, r * r
                _look(sight, c, levels, poses, parts, range_m, len(height_m), said)
                unsure = (lanes[0] >> np.uint64(_UNSURE_BIT)) & _ONES
                while unsure:
                    k = trailing_zeros(unsure) >> 3
                    unsure &= unsure - np.uint64(1)
                    said[k] *= _is_in_view(sight, c, k, poses, bearing_rad, reach_m)
                may += ones((lanes[0] >> np.uint64(_MAY_BIT)) & _ONES)
                must += ones((lanes[0] >> np.uint64(_ALIKE_BIT)) & _ONES)
            if must >= LEAST_FRAMES:
                break
        if must >= LEAST_FRAMES:
            how[i] = MUST
        elif may >= LEAST_FRAMES:
            how[i] = MAY
    return how


@kernel
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
        off = radius[k] + ROUNDING * away
        along, ahead = dx * ux + dy * uy, cos[k] * dx + sin[k] * dy
        possible[k] = (
            (away + off >= nearest)
            & (away - off <= farthest)
            & (away - off <= reach_m[k])
            & (along + 2 * off >= _MAY_COS * away)
            & (ahead + 2 * off >= least_cos[k] * away)
        )


@kernel
def _look(
    sight: tuple[float, float, float, float, float],
    c: int,
    levels: int,
    poses: Poses,
    parts: BearingSectors,
    range_m: Float,
    n_steps: int,
    said: np.ndarray,
) -> None:
    """Say (STRETCH,) whether and how a landmark lay in view of each pose of a stretch.

    Of the landmark are given its place, the direction in which it was seen and the square of its
    distance then; and at which steps of range, as bits, its height is in view. Written, as the
    above, so that the compiler takes several poses at once; indices without a sign for the same.
    """
    x, y, cos, sin, reach_m = poses
    part_of, first, per_slope = parts
    at_x, at_y, ux, uy, r2 = sight
    nearest, farthest, columns = range_m[0], range_m[1], reach_m.shape[1] // STRETCH
    per_range = farthest if farthest > 0 else 1.0
    row = np.uint64(c)
    for k in range(STRETCH):
        dx, dy = at_x - x[c, k], at_y - y[c, k]
        square, along = dx * dx + dy * dy, dx * ux + dy * uy
        away = math.sqrt(square)
        ahead, left = cos[c, k] * dx + sin[c, k] * dy, cos[c, k] * dy - sin[c, k] * dx
        slope = left / max(ahead, _LEAST_AHEAD)
        cell = np.uint64(min(max((slope - first) * per_slope, 0.0), CELLS - 1.0))
        part = np.uint64(part_of[cell])
        unsure = part == np.uint64(columns - 1)
        step = int(min(away / per_range * n_steps, n_steps - 1.0))
        may = (
            (r2 <= _MAY_RATIO2 * square)
            & (_MAY_RATIO2 * square <= _MAY_RATIO2 * _MAY_RATIO2 * r2)
            & (along > 0)
            & (along * along >= _MAY_COS2 * square)
            & ((ahead > 0) | unsure)
            & (nearest <= away)
            & (away <= farthest)
            & (((levels >> step) & 1) == 1)
            & (away <= reach_m[row, np.uint64(k * columns) + part])
        )
        alike = (
            (r2 <= _MUST_RATIO2 * square)
            & (_MUST_RATIO2 * square <= _MUST_RATIO2 * _MUST_RATIO2 * r2)
            & (along * along >= _MUST_COS2 * square)
        )
        said[k] = may * ((1 << _MAY_BIT) + (alike << _ALIKE_BIT) + (unsure << _UNSURE_BIT))


@kernel
def _is_in_view(
    sight: tuple[float, float, float, float, float],
    c: int,
    k: int,
    poses: Poses,
    bearings: Float,
    reach_m: np.ndarray,
) -> bool:
    """Whether a place is in view of a pose by its bearing, and not hidden, by the angle itself.

    The field of view is by bearing (2,); reach_m is (T, B).
    """
    dx, dy = sight[0] - poses.x_m[c, k], sight[1] - poses.y_m[c, k]
    cos, sin = poses.cos[c, k], poses.sin[c, k]
    bearing = math.atan2(cos * dy - sin * dx, cos * dx + sin * dy)
    low, high, parts = bearings[0], bearings[1], reach_m.shape[1]
    if not low <= bearing <= high:
        return False
    part = min(int((bearing - low) / (high - low) * parts), parts - 1)
    return math.sqrt(dx * dx + dy * dy) <= reach_m[c * STRETCH + k, part] + BEHIND_M
