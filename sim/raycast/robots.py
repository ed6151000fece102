"""The other robots in a picture: flat solids, drawn from the nearest to the farthest.

A picture of a convex solid is the convex hull of its corners' pictures, and walls reach from the
floor to the ceiling, so whether a wall hides a solid is decided column by column in plan.
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from sim.raycast.outline import clip, coverage, hull
from sim.raycast.plan import NONE, Pinhole
from sim.raycast.solids import Solids, front_to_back
from sim.raycast.windows import (
    all_windows,
    extremes,
    in_robot,
    pixel_ray,
    project_corners,
    window,
)


@kernel
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


@kernel
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
            top, bottom, left, right = window(camera, solids, i, poses[r], corners)
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


@kernel_part
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


@kernel_part
def _between(outline: Float, v: float) -> tuple[float, float]:
    """Where a convex outline (K, 2) begins and ends in row v; infinities where it does not."""
    begin, end = np.inf, -np.inf
    for k in range(len(outline)):
        p, q = outline[k], outline[(k + 1) % len(outline)]
        if min(p[1], q[1]) <= v <= max(p[1], q[1]) and p[1] != q[1]:
            u = p[0] + (v - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
            begin, end = min(begin, u), max(end, u)
    return begin, end


@kernel
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
        picture: (H, W) uint8, changed.
    """
    above, below, first, last = all_windows(camera, solids, poses)
    if above > below or first > last:
        return
    under = picture[above : below + 1, first : last + 1].astype(np.float32)
    shown = under.copy()
    rest = np.ones(under.shape, dtype=np.float32)
    for r in range(len(poses)):
        eye, _ = in_robot(camera, poses[r])
        for i in front_to_back(solids, eye):
            corners = project_corners(camera, solids, i, poses[r])
            top, bottom, left, right = window(camera, solids, i, poses[r], corners)
            if top > bottom or left > right:
                continue
            open_share, most = np.zeros(right - left + 1), 0.0
            for j in range(left, right + 1):
                at_m = _depth_in_column(camera, solids, i, poses[r], j)
                open_share[j - left] = _open_share(seen, face, until, count, j, at_m)
                most = max(most, open_share[j - left])
            if most == 0:
                continue
            covered = _covered(camera, solids, i, poses[r], corners, top, bottom, left, right)
            for v in range(top, bottom + 1):
                for j in range(left, right + 1):
                    # what is nearer hides the others where it is, and nowhere else in a pixel
                    left_over = rest[v - above, j - first]
                    share = min(covered[v - top, j - left] * open_share[j - left], left_over)
                    rest[v - above, j - first] -= share
                    shown[v - above, j - first] += share * (grey[i] - under[v - above, j - first])
    for v in range(above, below + 1):
        for j in range(first, last + 1):
            picture[v, j] = np.uint8(shown[v - above, j - first] + 0.5)


@kernel_part
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


@kernel_part
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


@kernel_part
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
