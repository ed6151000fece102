"""Visibility: landmarks of one map that the robot of the other map must have seen.

Poses are tested in blocks of consecutive frames. A bound for the whole block excludes most blocks;
the poses of the others are tested one by one.
"""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.align.nearest_neighbours import Grid, ranges_within
from mapfusion.geometry.numerics import WORD, Float, kernel, packed, popcount, trailing_zeros
from mapfusion.geometry.se2 import wrap
from mapfusion.viewing import FieldOfView, Viewing

# Consecutive frames per block. A robot moves and turns little in this time.
FRAMES_PER_BLOCK = 8
ROUNDING = 1e-9  # relative bound on the rounding error of a distance, an angle or a slope
# A landmark at most this far behind the farthest landmark of its sector is not occluded: within a
# sector, a slanted wall covers a range of distances.
BEHIND_M = 0.3
CELLS = 512  # slope cells; few of them contain the edge of a sector
_STEEPEST_RAD = math.pi / 2 - 1e-3  # bearing beyond which a slope resolves angles poorly


class PoseBlocks(NamedTuple):
    """C blocks of FRAMES_PER_BLOCK consecutive frames; the last block may be shorter.

    Attributes:
        x_m, y_m: centre of the positions, shape (C,).
        radius_m: radius about the centre that contains all positions, shape (C,).
        cos, sin: mean heading, shape (C,).
        least_cos: cosine of the largest angle between the mean heading and a visible point,
            shape (C,).
        reach_m: range of the farthest landmark in view of any pose, shape (C,).
    """

    x_m: Float
    y_m: Float
    radius_m: Float
    cos: Float
    sin: Float
    least_cos: Float
    reach_m: Float


class Poses(NamedTuple):
    """Poses of C blocks; the last block is padded with poses that saw nothing.

    Attributes:
        x_m, y_m, cos, sin: positions and headings, shape (C, FRAMES_PER_BLOCK).
        reach_m: range of the farthest landmark seen in each of the B sectors, followed by one
            value for points outside the field of view and one for points whose sector is
            undecided, shape (C, FRAMES_PER_BLOCK (B + 2)).
    """

    x_m: Float
    y_m: Float
    cos: Float
    sin: Float
    reach_m: Float


class BearingSectors(NamedTuple):
    """Lookup table from a slope (left over ahead) to one of the B sectors of the field of view.

    Attributes:
        part: sector of each slope cell, shape (CELLS,); B outside the field of view, B + 1 where
            the edge of a sector lies in the cell.
        first: slope at the start of the first cell.
        per_slope: number of cells per unit of slope.
    """

    part: np.ndarray
    first: float
    per_slope: float

    @classmethod
    def of(cls, field: FieldOfView, parts: int) -> "BearingSectors":
        """Return the table of a field of view with a number of sectors of equal angle."""
        low, high = field.bearing_rad
        if not low < high:
            return cls(np.full(CELLS, parts), 0.0, 1.0)
        if max(abs(low), abs(high)) > _STEEPEST_RAD:
            return cls(np.full(CELLS, parts + 1), 0.0, 1.0)
        width = (math.tan(high) - math.tan(low)) / (CELLS - 4)  # two cells on each side lie outside
        first = math.tan(low) - 2 * width
        begins = first + width * np.arange(CELLS)
        ends = begins[None] + np.array([[-ROUNDING], [width + ROUNDING]])
        lowest, highest = np.floor((np.arctan(ends) - low) / (high - low) * parts)
        part = np.where(lowest == highest, lowest, parts + 1)
        part[(highest < 0) | (lowest >= parts)] = parts
        return cls(part.astype(np.int64), first, 1 / width)


class ViewingHistory(NamedTuple):
    """Poses of a path of T frames and the ranges seen from each of them.

    Attributes:
        blocks: bounds of each block of poses.
        poses: single poses.
        parts: sectors of the field of view.
        reach_m: range of the farthest landmark seen in each sector, shape (T, B).
        bearing_rad, range_m: limits of the field of view, shape (2,).
        height_m: limits of the visible heights at each of H steps of range, shape (H, 2).
    """

    blocks: PoseBlocks
    poses: Poses
    parts: BearingSectors
    reach_m: np.ndarray
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, viewing: Viewing) -> "ViewingHistory":
        """Return the history of a map's viewing evidence."""
        field, reach = viewing.field, viewing.reach_m
        n_frames, n_parts = reach.shape
        n = -(-n_frames // FRAMES_PER_BLOCK)
        farthest = np.full((n * FRAMES_PER_BLOCK, n_parts + 2), -np.inf)
        farthest[:n_frames, :n_parts] = reach.astype(np.float64) + BEHIND_M
        farthest[:n_frames, n_parts + 1] = np.inf
        rows = np.minimum(np.arange(n * FRAMES_PER_BLOCK), n_frames - 1).reshape(
            n, FRAMES_PER_BLOCK
        )
        x, y, theta = (np.ascontiguousarray(viewing.pose[rows, k]) for k in range(3))
        aside_rad = float(np.abs(field.bearing_rad).max())
        reach_m = farthest[:, :n_parts].reshape(n, -1).max(axis=1)
        poses = Poses(x, y, np.cos(theta), np.sin(theta), farthest.reshape(n, -1))
        # bounds of each block
        mid_x, mid_y = ((v.min(axis=1) + v.max(axis=1)) / 2 for v in (x, y))
        square = (x - mid_x[:, None]) ** 2 + (y - mid_y[:, None]) ** 2
        mean = np.arctan2(poses.sin.sum(axis=1), poses.cos.sum(axis=1))
        turned = np.abs(wrap(theta - mean[:, None])).max(axis=1)
        min_cosine = np.cos(np.minimum(aside_rad + turned + ROUNDING, np.pi))
        radius_m = np.sqrt(square.max(axis=1))
        blocks = PoseBlocks(mid_x, mid_y, radius_m, np.cos(mean), np.sin(mean), min_cosine, reach_m)
        limits = field.bearing_rad, field.range_m, field.height_m
        return cls(blocks, poses, BearingSectors.of(field, n_parts), reach, *limits)


# Frames with a landmark in view that put the landmark into the map: a track is observed from its
# third frame on, and a landmark needs three observations (the defaults of
# `TrackParameters.min_length` and `min_count`).
LEAST_FRAMES = 5
# Frames in view of which LEAST_FRAMES consecutive ones remain if a track is lost in any one frame.
SURE_FRAMES = 2 * LEAST_FRAMES
# Visibility of a landmark from a path. UNSEEN: not in view. MAY: in view for a short time or from
# another distance or side, where only some landmarks are matched again, because the descriptor
# window covers other surfaces and the slant changes it. MUST: in view for long enough from a
# similar viewpoint, where nearly all are.
UNSEEN, MAY, MUST = 0, 1, 2


class ViewpointTolerance(NamedTuple):
    """Viewpoints with similar descriptors: largest ratio of scales and largest angle.

    The picture of a wall is scaled by the distance, and across also by the sine of the angle
    between the line of sight and the wall. The ratio bounds both.
    """

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
# Bits of the flags of a pose: the landmark is in view (MAY), it is in view from a similar viewpoint
# (ALIKE), and the sector is undecided so that the angle must be computed (UNSURE).
_MAY_BIT, _ALIKE_BIT, _UNSURE_BIT = 0, 1, 2
_LEAST_AHEAD = 1e-300  # m; avoids a division by zero; the sign of `ahead` excludes points behind


class ObservedLandmarks(NamedTuple):
    """N landmarks with their viewpoints, in the frame of the other robot.

    Attributes:
        p: positions, shape (N, 3).
        direction: unit vectors from the observing robot to the landmark, shape (N, 2).
        distance_m: distance from the observing robot, shape (N,); 0 if unknown.
        wall: unit vectors along the wall that contains the landmark, shape (N, 2); 0 if unknown.
    """

    p: Float
    direction: Float
    distance_m: Float
    wall: Float


# Landmarks within this distance in the plane, at least so many, give the direction of a wall. The
# spread of the landmarks across it is at most this share of the spread along it.
_WALL_RADIUS_M, _LEAST_OF_WALL, _WALL_THICKNESS = 0.5, 5, 0.3


def wall_directions(grid: Grid) -> Float:
    """Return unit vectors along the walls that contain N landmarks, shape (N, 2); 0 without a wall.

    The direction is the principal axis of the landmarks around each landmark.
    """
    n, xx, xy, yy = _second_moments(grid)
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)  # eigenvalues are mean + half, - half
    straight = (n >= _LEAST_OF_WALL) & (mean - half <= _WALL_THICKNESS**2 * (mean + half))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * (straight & (half > 0))[:, None]


@kernel
def _second_moments(grid: Grid) -> tuple[np.ndarray, Float, Float, Float]:
    """Return the number and the second central moments (N,) of the landmarks around each one."""
    p, row_of = grid.p, grid.row
    n = np.zeros(len(p), np.int64)
    xx, xy, yy = np.zeros(len(p)), np.zeros(len(p)), np.zeros(len(p))
    runs = np.empty((grid.shape[1], 2), np.int64)
    for k in range(len(p)):
        x = y = 0.0
        i = row_of[k]
        for run in range(ranges_within(p[k, 0], p[k, 1], _WALL_RADIUS_M, grid, runs)):
            for m in range(runs[run, 0], runs[run, 1]):
                dx, dy = p[m, 0] - p[k, 0], p[m, 1] - p[k, 1]
                if dx * dx + dy * dy <= _WALL_RADIUS_M * _WALL_RADIUS_M:
                    n[i] += 1
                    x, y = x + dx, y + dy
                    xx[i] += dx * dx
                    xy[i] += dx * dy
                    yy[i] += dy * dy
        xx[i] -= x * x / n[i]
        xy[i] -= x * y / n[i]
        yy[i] -= y * y / n[i]
    return n, xx, xy, yy


@kernel
def classify_visibility(seen: ObservedLandmarks, history: ViewingHistory) -> np.ndarray:
    """Return UNSEEN, MAY or MUST for each landmark, shape (N,).

    MAY needs at least LEAST_FRAMES frames with the landmark in view, MUST needs SURE_FRAMES.
    """
    p, direction, distance_m, wall = seen
    # unpacked once: each access through the tuple would count references
    blocks, poses, parts, reach_m, bearing_rad, range_m, height_m = history
    x, y, radius, cos, sin, least_cos, block_reach_m = blocks
    how, n_sectors = np.zeros(len(p), np.int64), reach_m.shape[1]
    eights = np.zeros((len(x) + WORD - 1) // WORD * 8, np.uint64)
    possible = eights.view(np.uint8)[: len(x)]
    lanes = np.zeros(1, np.uint64)
    flags = lanes.view(np.uint8)
    for i in range(len(p)):
        # np.int64 keeps one type; a literal 0 would compile the kernels a second time
        r, ux, uy, levels = distance_m[i], direction[i, 0], direction[i, 1], np.int64(0)
        for step in range(len(height_m)):
            levels |= (height_m[step, 0] <= p[i, 2] <= height_m[step, 1]) << step
        view_sector = p[i, 0], p[i, 1], ux, uy, max(r / _MAY_RATIO, range_m[0]), r * _MAY_RATIO
        _mark_possible_blocks(
            view_sector, x, y, radius, cos, sin, least_cos, block_reach_m, possible
        )
        must = may = 0
        for w in range(len(eights) // 8):
            word = packed(eights, w)
            while word and must < SURE_FRAMES:
                c = w * WORD + trailing_zeros(word)
                word &= word - np.uint64(1)
                sight = p[i, 0], p[i, 1], ux, uy, r * r, wall[i, 0], wall[i, 1]
                _flag_poses(sight, c, levels, poses, parts, range_m, len(height_m), flags)
                unsure = (lanes[0] >> np.uint64(_UNSURE_BIT)) & _ONES
                while unsure:
                    k = trailing_zeros(unsure) >> 3
                    unsure &= unsure - np.uint64(1)
                    # the exact bearing decides
                    dx, dy = p[i, 0] - poses.x_m[c, k], p[i, 1] - poses.y_m[c, k]
                    own_cos, own_sin = poses.cos[c, k], poses.sin[c, k]
                    bearing = math.atan2(own_cos * dy - own_sin * dx, own_cos * dx + own_sin * dy)
                    low, high = bearing_rad[0], bearing_rad[1]
                    in_view = low <= bearing <= high
                    if in_view:
                        sector = int((bearing - low) / (high - low) * n_sectors)
                        farthest = reach_m[c * FRAMES_PER_BLOCK + k, min(sector, n_sectors - 1)]
                        in_view = math.sqrt(dx * dx + dy * dy) <= farthest + BEHIND_M
                    flags[k] *= in_view
                may += popcount((lanes[0] >> np.uint64(_MAY_BIT)) & _ONES)
                must += popcount((lanes[0] >> np.uint64(_ALIKE_BIT)) & _ONES)
            if must >= SURE_FRAMES:
                break
        if must >= SURE_FRAMES:
            how[i] = MUST
        elif may >= LEAST_FRAMES:
            how[i] = MAY
    return how


@kernel
def _mark_possible_blocks(
    sector: tuple[float, float, float, float, float, float],
    x: Float,
    y: Float,
    radius: Float,
    cos: Float,
    sin: Float,
    least_cos: Float,
    reach_m: Float,
    possible: np.ndarray,
) -> None:
    """Mark the blocks (C,) that may contain a pose with the landmark in view.

    `sector` is the landmark's position, its viewing direction, and the smallest and largest
    distance of a pose. A displacement by at most the block's radius changes each length below by at
    most twice that radius. The loop has no branch and no other index, so that it is vectorised.
    """
    at_x, at_y, ux, uy, nearest, farthest = sector
    for k in range(len(possible)):
        dx, dy = at_x - x[k], at_y - y[k]
        away = math.sqrt(dx * dx + dy * dy)
        tolerance = radius[k] + ROUNDING * away
        along, dot_direction = dx * ux + dy * uy, cos[k] * dx + sin[k] * dy
        possible[k] = (
            (away + tolerance >= nearest)
            & (away - tolerance <= farthest)
            & (away - tolerance <= reach_m[k])
            & (along + 2 * tolerance >= _MAY_COS * away)
            & (dot_direction + 2 * tolerance >= least_cos[k] * away)
        )


@kernel
def _flag_poses(
    sight: tuple[float, float, float, float, float, float, float],
    c: int,
    levels: int,
    poses: Poses,
    parts: BearingSectors,
    range_m: Float,
    n_steps: int,
    flags: np.ndarray,
) -> None:
    """Set the flags (FRAMES_PER_BLOCK,) of each pose of block c for one landmark.

    `sight` is the landmark's position, its viewing direction, the square of its viewing distance
    and the direction of its wall. Bit h of `levels` is set if its height is in view at step h of
    the range. The loop is vectorised: no branch, and unsigned indices.
    """
    x, y, cos, sin, reach_m = poses
    part_of, first, per_slope = parts
    at_x, at_y, ux, uy, r2, wall_x, wall_y = sight
    own_facing2 = (ux * wall_y - uy * wall_x) ** 2  # squared sine of the angle to the wall
    nearest, farthest, columns = range_m[0], range_m[1], reach_m.shape[1] // FRAMES_PER_BLOCK
    per_range = farthest if farthest > 0 else 1.0
    row = np.uint64(c)
    for k in range(FRAMES_PER_BLOCK):
        dx, dy = at_x - x[c, k], at_y - y[c, k]
        square, along = dx * dx + dy * dy, dx * ux + dy * uy
        away = math.sqrt(square)
        facing2, seen2 = (dx * wall_y - dy * wall_x) ** 2, own_facing2 * square
        x_robot, y_robot = cos[c, k] * dx + sin[c, k] * dy, cos[c, k] * dy - sin[c, k] * dx
        slope = y_robot / max(x_robot, _LEAST_AHEAD)
        cell = np.uint64(min(max((slope - first) * per_slope, 0.0), CELLS - 1.0))
        part = np.uint64(part_of[cell])
        unsure = part == np.uint64(columns - 1)
        step = int(min(away / per_range * n_steps, n_steps - 1.0))
        may = (
            (r2 <= _MAY_RATIO2 * square)
            & (_MAY_RATIO2 * square <= _MAY_RATIO2 * _MAY_RATIO2 * r2)
            & (along > 0)
            & (along * along >= _MAY_COS2 * square)
            & (seen2 <= _MAY_RATIO2 * facing2)
            & (facing2 <= _MAY_RATIO2 * seen2)
            & ((x_robot > 0) | unsure)
            & (nearest <= away)
            & (away <= farthest)
            & (((levels >> step) & 1) == 1)
            & (away <= reach_m[row, np.uint64(k * columns) + part])
        )
        alike = (
            (r2 <= _MUST_RATIO2 * square)
            & (_MUST_RATIO2 * square <= _MUST_RATIO2 * _MUST_RATIO2 * r2)
            & (along * along >= _MUST_COS2 * square)
            & (seen2 <= _MUST_RATIO2 * facing2)
            & (facing2 <= _MUST_RATIO2 * seen2)
        )
        flags[k] = may * ((1 << _MAY_BIT) + (alike << _ALIKE_BIT) + (unsure << _UNSURE_BIT))
