"""What each pixel column sees of the walls in plan: hidden lines in one dimension, exactly.

A level camera's picture maps an upright wall's line in plan to inverse depth w = 1 / Z, which is
linear in the column's coordinate u (Hartley and Zisserman 2004, projection of lines): with the line
n (p - s) = 0 and a ray Z (1, (c - u) / f), Z n (1, (c - u) / f) = n s. So the nearest wall is the
upper envelope of straight segments over u, and its breaks lie at segments' ends and crossings.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from sim.raycast.scene import Walls

NONE = -1  # no wall
_THINNEST_PX = 1e-9  # what is thinner is not told apart
_JUST_RIGHT_PX = 1e-7  # of a place: there what begins at it is nearer than the rest, or is not
_MOST_PIECES = 10  # for each face; an upper envelope of so many segments has fewer


class Pinhole(NamedTuple):
    """One level camera.

    Attributes:
        width_px: of the picture.
        height_px: likewise.
        focal_px: focal length.
        center_u: principal point.
        center_v: likewise.
        eye_x_m: optical centre.
        eye_y_m: likewise.
        eye_z_m: likewise.
        theta: of the optical axis, counter-clockwise from the world's x axis.
        near_m: what is nearer along the axis is not seen.
    """

    width_px: int
    height_px: int
    focal_px: float
    center_u: float
    center_v: float
    eye_x_m: float
    eye_y_m: float
    eye_z_m: float
    theta: float
    near_m: float


def anywhere(camera: Pinhole) -> Pinhole:
    """A camera whose rows see floors as far off as those of another one do."""
    return camera._replace(eye_x_m=0.0, eye_y_m=0.0, theta=0.0)


class Plan(NamedTuple):
    """What a camera sees of the walls, from left to right: N strips of one face and column each.

    Column j reaches from u = j - 1/2 to j + 1/2.

    Attributes:
        seen: (F, 7) all faces, see `_project`.
        face: (N,) int64 that is seen in a strip, or NONE.
        low: (N,) where in u it begins.
        high: (N,) where it ends.
        first: (W + 1,) int64 each column's first strip, and N.
        middle: (W,) int64 the face that each column's middle sees, or NONE.
        middle_m: (W,) its depth there; infinity for none.
        above: (W,) int64 how many rows from the upper edge on walls leave open, wholly or partly.
        below: (W,) int32 the same from the lower edge on.
    """

    seen: Float
    face: np.ndarray
    low: Float
    high: Float
    first: np.ndarray
    middle: np.ndarray
    middle_m: Float
    above: np.ndarray
    below: np.ndarray


@kernel
def look(camera: Pinhole, walls: Walls) -> Plan:
    """What a camera sees of the walls."""
    # Project faces (F, 7) into the picture: from u, to u, w0, w1, t0, t1, t2: w = w0 + w1 u.
    # t is the place along the face in metres: t = (t0 + t1 u) / w - t2. A face that is not seen,
    # being behind or turned away, is from infinity to minus infinity.
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    f, c = camera.focal_px, camera.center_u
    seen = np.empty((len(walls.width_m), 7))
    for i in range(len(seen)):
        x, y = walls.start_m[i, 0] - camera.eye_x_m, walls.start_m[i, 1] - camera.eye_y_m
        start_z, start_y = cos * x + sin * y, cos * y - sin * x
        ahead = cos * walls.along[i, 0] + sin * walls.along[i, 1]
        left = cos * walls.along[i, 1] - sin * walls.along[i, 0]
        end_z, end_y = start_z + walls.width_m[i] * ahead, start_y + walls.width_m[i] * left
        # distance of the eye before the face; its front lies to the right of the way along it
        before = start_y * ahead - start_z * left
        seen[i, 0], seen[i, 1] = np.inf, -np.inf
        if before <= 0 or max(start_z, end_z) <= camera.near_m:
            continue
        # 0 = Z (y ahead - left) - before, with y = (c - u) / f
        w_0, w_u = (ahead * c / f - left) / before, -ahead / (f * before)
        seen[i, 2], seen[i, 3] = w_0, w_u
        seen[i, 4], seen[i, 5] = ahead + left * c / f, -left / f
        seen[i, 6] = ahead * start_z + left * start_y
        for k, z, y in ((0, start_z, start_y), (1, end_z, end_y)):
            if z > camera.near_m:
                seen[i, k] = c - f * y / z
            else:  # cut where w is that of the near plane
                seen[i, k] = (1 / camera.near_m - w_0) / w_u
    face, low, high, first, middle, middle_m = _strips(seen, camera.width_px)
    above, below = _open_rows(camera, walls.height_m, seen, face, low, high, first)
    return Plan(seen, face, low, high, first, middle, middle_m, above, below)


@kernel
def _strips(
    seen: Float, width_px: int
) -> tuple[np.ndarray, Float, Float, np.ndarray, np.ndarray, Float]:
    """What is seen in each column: `Plan`'s face, low, high, first, middle and its depth.

    A face is the nearest until it ends, until another one begins before it, or until another one
    crosses it, which then is the nearest.
    """
    face = np.empty(width_px + _MOST_PIECES * (len(seen) + 1), dtype=np.int64)
    low, high = np.empty(len(face)), np.empty(len(face))
    first, middle = np.empty(width_px + 1, dtype=np.int64), np.empty(width_px, dtype=np.int64)
    middle_m = np.empty(width_px)
    first[0], column, n = 0, 0, 0
    at, now, last = -0.5, NONE, width_px - 0.5
    while at < last:
        if now == NONE:
            nearest = 0.0
            for i in range(len(seen)):
                w = seen[i, 2] + seen[i, 3] * (at + _JUST_RIGHT_PX)
                if seen[i, 0] <= at < seen[i, 1] and w > nearest:
                    now, nearest = i, w
        stop, w_0, w_u, follower = last, 0.0, 0.0, NONE
        if now != NONE:
            stop, w_0, w_u = min(seen[now, 1], last), seen[now, 2], seen[now, 3]
        for i in range(len(seen)):
            start, more_0, more_u = seen[i, 0], seen[i, 2] - w_0, seen[i, 3] - w_u
            if at < start < stop and more_0 + more_u * (start + _JUST_RIGHT_PX) > 0:
                stop, follower = start, NONE
            elif more_u > 0 and max(at, start) < -more_0 / more_u < min(stop, seen[i, 1]):
                stop, follower = -more_0 / more_u, i
        while at < stop:
            end = min(stop, column + 0.5)
            if end - at >= _THINNEST_PX and n < len(face):
                face[n], low[n], high[n] = now, at, end
                n += 1
            if at <= column < end:
                middle[column], middle_m[column] = now, np.inf
                if now != NONE:
                    middle_m[column] = 1 / (w_0 + w_u * column)
            if end == column + 0.5:
                column += 1
                first[column] = n
            at = end
        now = follower
    return face[:n], low[:n], high[:n], first, middle, middle_m


@kernel
def _open_rows(
    camera: Pinhole,
    height_m: float,
    seen: Float,
    face: np.ndarray,
    low: Float,
    high: Float,
    first: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How many rows of each column walls leave open, see `Plan`."""
    above = np.empty(camera.width_px, dtype=np.int64)
    below = np.empty(camera.width_px, dtype=np.int64)
    horizon = int(np.ceil(camera.center_v))
    for j in range(camera.width_px):
        w = np.inf  # where walls are farthest; nowhere they are infinitely far
        for s in range(first[j], first[j + 1]):
            w_0, w_u = seen[face[s], 2], seen[face[s], 3]
            w = min(w, w_0 + w_u * low[s], w_0 + w_u * high[s]) if face[s] != NONE else 0.0
        top = camera.center_v - (height_m - camera.eye_z_m) * camera.focal_px * w
        bottom = camera.center_v + camera.eye_z_m * camera.focal_px * w
        above[j] = max(0, min(int(max(np.floor(top + 0.5) + 1, 0.0)), horizon))
        below[j] = max(0, camera.height_px - max(int(np.floor(bottom + 0.5)), horizon))
    return above, below


def inverse_depths(plan: Plan, first: int, last: int) -> Float:
    """Of what is seen in the middles of strips (N,) in columns from `first` to before `last`."""
    strips = slice(plan.first[first], plan.first[last])
    face, middle = plan.face[strips], (plan.low[strips] + plan.high[strips]) / 2
    w = plan.seen[face, 2] + plan.seen[face, 3] * middle
    w[face == NONE] = 0.0
    return w
