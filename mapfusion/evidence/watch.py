"""What a robot looked at, laid out for the kernel that asks what it must have seen."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float, wrap
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


class Parts(NamedTuple):
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
    def of(cls, field: FieldOfView, parts: int) -> "Parts":
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


class Watch(NamedTuple):
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
    parts: Parts
    reach_m: np.ndarray
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, viewing: Viewing) -> "Watch":
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
        return cls(together, poses, Parts.of(field, n_parts), reach, *limits)


def _together(poses: Poses, theta: Float, reach_m: Float, aside_rad: float) -> Stretches:
    """Poses of angles theta (C, STRETCH) that saw so far (C,), and so far aside."""
    x, y = ((v.min(axis=1) + v.max(axis=1)) / 2 for v in (poses.x_m, poses.y_m))
    square = (poses.x_m - x[:, None]) ** 2 + (poses.y_m - y[:, None]) ** 2
    mean = np.arctan2(poses.sin.sum(axis=1), poses.cos.sum(axis=1))
    turned = np.abs(wrap(theta - mean[:, None])).max(axis=1)
    least = np.cos(np.minimum(aside_rad + turned + ROUNDING, np.pi))
    return Stretches(x, y, np.sqrt(square.max(axis=1)), np.cos(mean), np.sin(mean), least, reach_m)
