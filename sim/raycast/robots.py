"""The other robots in a picture: flat solids, drawn from the nearest to the farthest.

A picture of a convex solid is the convex hull of its corners' pictures, and walls reach from the
floor to the ceiling, so whether a wall hides a solid is decided column by column in plan.
"""

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from sim.raycast.outline import clip, coverage, hull
from sim.raycast.plan import NONE, Pinhole
from sim.raycast.solids import Solids, front_to_back


@njit(cache=True)
def in_robot(camera: Pinhole, pose: Float) -> tuple[Float, Float]:
    """The eye (3,) in a robot's frame, and the camera's axes (3, 3) there: ahead, left, up."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = camera.eye_x_m - pose[0], camera.eye_y_m - pose[1]
    eye, axes = np.empty(3), np.zeros((3, 3))
    eye[0], eye[1], eye[2] = cos * x + sin * y, cos * y - sin * x, camera.eye_z_m
    cos, sin = np.cos(camera.theta - pose[2]), np.sin(camera.theta - pose[2])
    axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1], axes[2, 2] = cos, sin, -sin, cos, 1.0
    return eye, axes


def by_distance(camera: Pinhole, poses: Float) -> Float:
    """The poses (R, 3) from the nearest to the farthest."""
    apart = poses[:, :2] - [camera.eye_x_m, camera.eye_y_m]
    return poses[np.argsort(np.sum(apart**2, axis=1), kind="stable")]


@njit(cache=True)
def pixel_ray(camera: Pinhole, axes: Float, v: int, u: int, ray: Float) -> None:
    """Fill in the ray (3,) through a pixel's middle, one metre of depth long."""
    left, up = (camera.center_u - u) / camera.focal_px, (camera.center_v - v) / camera.focal_px
    for k in range(3):
        ray[k] = axes[0, k] + left * axes[1, k] + up * axes[2, k]


@njit(cache=True)
def project_corners(camera: Pinhole, solids: Solids, i: int, pose: Float) -> Float:
    """A solid's corners (K, 3) in the picture: u, v and depth along the axis in metres."""
    eye, axes = in_robot(camera, pose)
    seen = np.empty((solids.n_corners[i], 3))
    for k in range(len(seen)):
        x, y = solids.corners_m[i, k, 0] - eye[0], solids.corners_m[i, k, 1] - eye[1]
        z, up = axes[0, 0] * x + axes[0, 1] * y, solids.corners_m[i, k, 2] - eye[2]
        left = axes[1, 0] * x + axes[1, 1] * y
        seen[k, 0] = camera.center_u - camera.focal_px * left / z if z > 0 else np.nan
        seen[k, 1] = camera.center_v - camera.focal_px * up / z if z > 0 else np.nan
        seen[k, 2] = z
    return seen


@njit(cache=True)
def window(camera: Pinhole, corners: Float) -> tuple[int, int, int, int]:
    """First and last row and column that a solid may show in; the whole picture if it is near."""
    first, last = extremes(corners)
    if last[2] <= camera.near_m:
        return 0, -1, 0, -1
    if first[2] <= camera.near_m:
        return 0, camera.height_px - 1, 0, camera.width_px - 1
    left, top = max(np.floor(first[0] + 0.5), 0.0), max(np.floor(first[1] + 0.5), 0.0)
    right = min(np.floor(last[0] + 0.5), camera.width_px - 1.0)
    bottom = min(np.floor(last[1] + 0.5), camera.height_px - 1.0)
    return int(top), int(bottom), int(left), int(right)


@njit(cache=True)
def extremes(corners: Float) -> tuple[Float, Float]:
    """The least (3,) and the largest (3,) of corners (K, 3) in each coordinate."""
    first, last = corners[0].copy(), corners[0].copy()
    for k in range(1, len(corners)):
        for axis in range(3):
            first[axis] = min(first[axis], corners[k, axis])
            last[axis] = max(last[axis], corners[k, axis])
    return first, last


@njit(cache=True)
def depth_of(solids: Solids, i: int, eye: Float, ray: Float, near_m: float) -> float:
    """Depth at which a ray (3,), one metre of depth long, enters a solid; infinity if it does not.

    Both in the solid's frame (Kay and Kajiya 1986: the last plane entered before the first left).
    """
    enter, leave = near_m, np.inf
    for k in range(solids.n_planes[i]):
        n = solids.planes[i, k]
        outside = n[0] * eye[0] + n[1] * eye[1] + n[2] * eye[2] - n[3]
        toward = n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2]
        if toward < 0:
            enter = max(enter, -outside / toward)
        elif toward > 0:
            leave = min(leave, -outside / toward)
        elif outside > 0:
            return np.inf
    return enter if enter < leave else np.inf


@njit(cache=True)
def cast(
    camera: Pinhole, solids: Solids, poses: Float, grey: Float, depth_m: np.ndarray,
    picture: np.ndarray,
) -> None:  # fmt: skip
    """Draw robots at poses (R, 3) into pixels whose middles hit them nearer than `depth_m` (H, W).

    Both `depth_m` and `picture` (H, W) are changed; a picture of no size is left alone.
    """
    for r in range(len(poses)):
        eye, axes = in_robot(camera, poses[r])
        for i in range(len(solids.n_corners)):
            corners = project_corners(camera, solids, i, poses[r])
            top, bottom, left, right = window(camera, corners)
            if top > bottom or left > right:
                continue
            wholly_before = extremes(corners)[0][2] > camera.near_m
            outline = hull(corners[:, :2]) if wholly_before else corners[:0]
            nearness = np.empty(right - left + 1)
            for v in range(top, bottom + 1):
                _nearness(camera, solids, i, eye, axes, outline, v, left, nearness)
                for u in range(left, right + 1):
                    w = nearness[u - left]
                    # nothing at all is NaN, which nothing compares with
                    if w > 0 and not w * depth_m[v, u] <= 1:
                        depth_m[v, u] = 1 / w
                        if picture.size:
                            picture[v, u] = grey[i]


@njit(cache=True)
def _nearness(
    camera: Pinhole, solids: Solids, i: int, eye: Float, axes: Float, outline: Float,
    v: int, left: int, nearness: Float,
) -> None:  # fmt: skip
    """Inverse depth of a solid behind the pixels of a row from `left` on; 0 where it is not.

    `outline` is that of its picture; none where it reaches the lens. Inverse depth is linear in the
    picture on each of its planes, and its surface is the farthest of those that face the eye.
    """
    f, up = camera.focal_px, (camera.center_v - v) / camera.focal_px
    nearness[:] = 0.0
    if len(outline) == 0:
        ray = np.empty(3)
        for u in range(len(nearness)):
            pixel_ray(camera, axes, v, left + u, ray)
            nearness[u] = 1 / depth_of(solids, i, eye, ray, camera.near_m)
        return
    begin, end = _between(outline, float(v))
    begin = max(np.ceil(begin) - left, 0.0)
    end = min(np.floor(end) - left, len(nearness) - 1.0)
    if begin > end:
        return
    inside = nearness[int(begin) : int(end) + 1]
    inside[:] = np.inf
    for k in range(solids.n_planes[i]):
        n = solids.planes[i, k]
        outside = n[0] * eye[0] + n[1] * eye[1] + n[2] * eye[2] - n[3]
        if outside <= 0:
            continue
        ahead = -(n[0] * axes[0, 0] + n[1] * axes[0, 1] + n[2] * up) / outside
        aside = -(n[0] * axes[1, 0] + n[1] * axes[1, 1]) / outside
        at_left = ahead + aside * (camera.center_u - left - begin) / f
        for u in range(len(inside)):
            inside[u] = min(inside[u], at_left - aside / f * u)


@njit(cache=True)
def _between(outline: Float, v: float) -> tuple[float, float]:
    """Where a convex outline (K, 2) begins and ends in row v; infinities where it does not."""
    begin, end = np.inf, -np.inf
    for k in range(len(outline)):
        p, q = outline[k], outline[(k + 1) % len(outline)]
        if min(p[1], q[1]) <= v <= max(p[1], q[1]) and p[1] != q[1]:
            u = p[0] + (v - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
            begin, end = min(begin, u), max(end, u)
    return begin, end


@njit(cache=True)
def draw(
    camera: Pinhole, seen: Float, face: np.ndarray, until: Float, count: np.ndarray,
    solids: Solids, poses: Float, grey: Float, picture: np.ndarray,
) -> None:  # fmt: skip
    """Draw robots at poses (R, 3) over a picture (H, W), each pixel by the share they cover.

    Args:
        camera: level.
        seen: from `sim.raycast.plan.project`.
        face: from `sim.raycast.plan.strips`.
        until: likewise.
        count: likewise.
        solids: of one robot.
        poses: of the robots, from the nearest to the farthest.
        grey: (S,) the solids' grey levels.
        picture: (H, W) float32, changed.
    """
    rest = under = np.zeros((0, 0), dtype=np.float32)
    for r in range(len(poses)):
        eye, _ = in_robot(camera, poses[r])
        for i in front_to_back(solids, eye):
            corners = project_corners(camera, solids, i, poses[r])
            top, bottom, left, right = window(camera, corners)
            if top > bottom or left > right:
                continue
            open_share, most = np.zeros(right - left + 1), 0.0
            for j in range(left, right + 1):
                at_m = _depth_in_column(camera, solids, i, poses[r], j)
                open_share[j - left] = _open_share(seen, face, until, count, j, at_m)
                most = max(most, open_share[j - left])
            if most == 0:
                continue
            if rest.size == 0:
                rest, under = np.ones(picture.shape, dtype=np.float32), picture.copy()
            covered = _covered(camera, solids, i, poses[r], corners, top, bottom, left, right)
            for v in range(top, bottom + 1):
                for j in range(left, right + 1):
                    # what is nearer hides the others where it is, and nowhere else in a pixel
                    share = min(covered[v - top, j - left] * open_share[j - left], rest[v, j])
                    rest[v, j] -= share
                    picture[v, j] += share * (grey[i] - under[v, j])


@njit(cache=True)
def _covered(
    camera: Pinhole, solids: Solids, i: int, pose: Float, corners: Float,
    top: int, bottom: int, left: int, right: int,
) -> Float:  # fmt: skip
    """Covered shares of a window's pixels; by their middles where the solid reaches the lens."""
    height, width = bottom - top + 1, right - left + 1
    if extremes(corners)[0][2] > camera.near_m:
        outline = hull(corners[:, :2])
        for k in range(len(outline)):
            outline[k, 0] -= left - 0.5
            outline[k, 1] -= top - 0.5
        polygon = clip(outline, float(width), float(height))
        return coverage(polygon, height, width)
    covered, ray = np.zeros((height, width)), np.empty(3)
    eye, axes = in_robot(camera, pose)
    for v in range(height):
        for u in range(width):
            pixel_ray(camera, axes, top + v, left + u, ray)
            if depth_of(solids, i, eye, ray, camera.near_m) < np.inf:
                covered[v, u] = 1.0
    return covered


@njit(cache=True)
def _depth_in_column(camera: Pinhole, solids: Solids, i: int, pose: Float, j: int) -> float:
    """Depth of a solid's box where column j meets it in plan, or of its corner nearest to that."""
    eye, axes = in_robot(camera, pose)
    y = (camera.center_u - j) / camera.focal_px
    low, high = solids.low_m[i], solids.high_m[i]
    enter, leave = 0.0, np.inf
    for axis in range(2):
        ray = axes[0, axis] + y * axes[1, axis]
        if abs(ray) > 1e-12:
            a, b = (low[axis] - eye[axis]) / ray, (high[axis] - eye[axis]) / ray
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if enter <= leave:
        return (enter + leave) / 2
    best, best_m = np.inf, 0.0
    for k in range(4):
        x = (low[0] if k < 2 else high[0]) - eye[0]
        across = (low[1] if k % 2 else high[1]) - eye[1]
        depth_m = axes[0, 0] * x + axes[0, 1] * across
        off = abs(axes[1, 0] * x + axes[1, 1] * across - y * depth_m) / max(depth_m, camera.near_m)
        if off < best:
            best, best_m = off, depth_m
    return best_m


@njit(cache=True)
def _open_share(
    seen: Float, face: np.ndarray, until: Float, count: np.ndarray, j: int, at_m: float
) -> float:
    """Share of column j in which no wall stands before a depth."""
    share, low = 0.0, j - 0.5
    for s in range(count[j]):
        i, high = face[j, s], until[j, s]
        if i == NONE or at_m * (seen[i, 2] + seen[i, 3] * (low + high) / 2) < 1:
            share += high - low
        low = high
    return share
