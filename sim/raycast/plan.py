"""What each pixel column sees of the walls in plan: hidden lines in one dimension, exactly.

A level camera's picture maps an upright wall's line in plan to inverse depth w = 1 / Z, which is
linear in the column's coordinate u (Hartley and Zisserman 2004, projection of lines): with the line
n (p - s) = 0 and a ray Z (1, (c - u) / f), Z n (1, (c - u) / f) = n s. So the nearest wall is the
upper envelope of straight segments over u, and its breaks lie at segments' ends and crossings.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from sim.raycast.scene import Walls

NONE = -1  # no wall
MOST_STRIPS = 12  # of one column; what is thinner than a twelfth of a pixel is not told apart
_THINNEST_PX = 1e-9


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


@kernel
def project(camera: Pinhole, walls: Walls) -> Float:
    """Faces (F, 7) in the picture: from u, to u, w0, w1, t0, t1, t2: w = w0 + w1 u.

    t is the place along the face in metres: t = (t0 + t1 u) / w - t2. A face that is not seen,
    being behind or turned away, has from > to.
    """
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    seen = np.empty((len(walls.width_m), 7))
    for i in range(len(walls.width_m)):
        seen[i, 0], seen[i, 1] = 1.0, 0.0
        x, y = walls.start_m[i, 0] - camera.eye_x_m, walls.start_m[i, 1] - camera.eye_y_m
        start_z, start_y = cos * x + sin * y, cos * y - sin * x
        ahead = cos * walls.along[i, 0] + sin * walls.along[i, 1]
        left = cos * walls.along[i, 1] - sin * walls.along[i, 0]
        end_z, end_y = start_z + walls.width_m[i] * ahead, start_y + walls.width_m[i] * left
        # distance of the eye before the face; its front lies to the right of the way along it
        before = start_y * ahead - start_z * left
        if before <= 0 or max(start_z, end_z) <= camera.near_m:
            continue
        f, c = camera.focal_px, camera.center_u
        seen[i, 0], seen[i, 1] = -np.inf, np.inf
        if start_z > camera.near_m:
            seen[i, 0] = c - f * start_y / start_z
        if end_z > camera.near_m:
            seen[i, 1] = c - f * end_y / end_z
        # 0 = Z (y ahead - left) - before, with y = (c - u) / f
        seen[i, 2] = (ahead * c / f - left) / before
        seen[i, 3] = -ahead / (f * before)
        seen[i, 4] = ahead + left * c / f
        seen[i, 5] = -left / f
        seen[i, 6] = ahead * start_z + left * start_y
        if start_z <= camera.near_m:  # cut where w is that of the near plane
            seen[i, 0] = (1 / camera.near_m - seen[i, 2]) / seen[i, 3]
        if end_z <= camera.near_m:
            seen[i, 1] = (1 / camera.near_m - seen[i, 2]) / seen[i, 3]
    return seen


@kernel
def nearest(seen: Float, at_u: Float) -> np.ndarray:
    """The nearest face (N,) at each of the ascending, evenly spaced coordinates (N,), or NONE."""
    found = np.full(len(at_u), NONE, dtype=np.int64)
    w = np.zeros(len(at_u))
    step = at_u[1] - at_u[0] if len(at_u) > 1 else 1.0
    for i in range(len(seen)):
        if seen[i, 0] > seen[i, 1]:
            continue
        low = max(np.ceil((seen[i, 0] - at_u[0]) / step), 0.0)
        high = min(np.floor((seen[i, 1] - at_u[0]) / step), len(at_u) - 1.0)
        for k in range(int(low), int(high) + 1):
            w_here = seen[i, 2] + seen[i, 3] * at_u[k]
            if w_here > w[k]:
                w[k], found[k] = w_here, i
    return found


@kernel
def strips(camera: Pinhole, seen: Float) -> tuple[np.ndarray, Float, np.ndarray]:
    """What is seen in each pixel column, from left to right.

    Returns:
        Faces (W, MOST_STRIPS), where each strip ends in u (W, MOST_STRIPS), and how many strips
        there are (W,); column j begins at u = j - 1/2. Where no wall is the face is NONE.
    """
    width = camera.width_px
    edges = np.arange(width + 1).astype(np.float64) - 0.5
    at_edge = nearest(seen, edges)
    face = np.empty((width, MOST_STRIPS), dtype=np.int64)
    until = np.empty((width, MOST_STRIPS))
    count = np.ones(width, dtype=np.int64)
    split = np.zeros(width, dtype=np.bool_)
    for j in range(width):
        face[j, 0], until[j, 0] = at_edge[j], j + 0.5
        split[j] = at_edge[j] != at_edge[j + 1]
    for i in range(len(seen)):  # an end between two edges, in front of what is seen there
        for end in range(2):
            u = seen[i, end]
            if seen[i, 0] > seen[i, 1] or not -0.5 < u < width - 0.5:
                continue
            j = int(np.floor(u + 0.5))
            behind = at_edge[j]
            w = seen[i, 2] + seen[i, 3] * u
            if behind == NONE or w >= (seen[behind, 2] + seen[behind, 3] * u) * (1 - 1e-9):
                split[j] = True
    for j in range(width):
        if split[j]:
            count[j] = _envelope(seen, edges[j], edges[j + 1], face[j], until[j])
    return face, until, count


@kernel_part
def _envelope(seen: Float, low: float, high: float, face: np.ndarray, until: Float) -> int:
    """Fill in the faces seen between two coordinates, and where each ends; returns how many."""
    breaks = _breaks(seen, low, high)
    count = 0
    for k in range(len(breaks) - 1):
        at, stop = breaks[k], breaks[k + 1]
        if stop - at < _THINNEST_PX:
            continue
        now = _first(seen, at, stop)
        while at < stop:
            after, follower = _overtaken(seen, now, at, stop)
            if count > 0 and face[count - 1] == now:
                until[count - 1] = after
            elif count < MOST_STRIPS:
                face[count], until[count] = now, after
                count += 1
            else:
                until[count - 1] = after
            at, now = after, follower
    until[count - 1] = high
    return count


@kernel_part
def _breaks(seen: Float, low: float, high: float) -> Float:
    """Where faces begin and end between two coordinates, and these, from left to right."""
    breaks = np.empty(2 * len(seen) + 2)
    breaks[0], breaks[1], n = low, high, 2
    for i in range(len(seen)):
        if seen[i, 0] > seen[i, 1] or seen[i, 1] <= low or seen[i, 0] >= high:
            continue
        for end in range(2):
            u, k = seen[i, end], n
            if low < u < high:
                while breaks[k - 1] > u:  # few: put each where it belongs
                    breaks[k] = breaks[k - 1]
                    k -= 1
                breaks[k] = u
                n += 1
    return breaks[:n]


@kernel_part
def _first(seen: Float, at: float, stop: float) -> int:
    """The nearest face just right of `at`, among those that reach from there to `stop`."""
    u = at + 1e-7 * (stop - at)
    best, best_w = NONE, 0.0
    for i in range(len(seen)):
        if seen[i, 0] <= at and seen[i, 1] >= stop:
            w = seen[i, 2] + seen[i, 3] * u
            if w > best_w:
                best, best_w = i, w
    return best


@kernel_part
def _overtaken(seen: Float, now: int, at: float, stop: float) -> tuple[float, int]:
    """Where another face comes before the face `now`, and which; `stop` and `now` if none does."""
    after, follower = stop, now
    if now == NONE:
        return after, follower
    for i in range(len(seen)):
        if seen[i, 0] <= at and seen[i, 1] >= stop and seen[i, 3] > seen[now, 3]:
            u = (seen[now, 2] - seen[i, 2]) / (seen[i, 3] - seen[now, 3])
            if at + _THINNEST_PX < u < after - _THINNEST_PX:
                after, follower = u, i
    return after, follower
