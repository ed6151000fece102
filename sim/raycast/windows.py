"""Where the other robots are in a picture: their places before the camera, and their windows."""

import math

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from sim.raycast.plan import Pinhole
from sim.raycast.solids import Solids


@kernel
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
    x, y = poses[:, 0] - camera.eye_x_m, poses[:, 1] - camera.eye_y_m
    return poses[np.argsort(x * x + y * y, kind="stable")]


def within_view(camera: Pinhole, reach_m: float, poses: Float) -> Float:
    """Those of the poses (R, 3) at which robots may show, were there no walls.

    No part of them is farther than `reach_m` from where they stand, in plan. What shows lies
    between two lines from the eye, ahead of it.
    """
    cos, sin = math.cos(camera.theta), math.sin(camera.theta)
    x, y = poses[:, 0] - camera.eye_x_m, poses[:, 1] - camera.eye_y_m
    ahead, aside = cos * x + sin * y, np.abs(cos * y - sin * x)
    # half a pixel from the last one's middle is its edge, the other half is to spare
    widest = max(camera.center_u, camera.width_px - 1 - camera.center_u) + 1
    beside = aside - ahead * (widest / camera.focal_px)
    return poses[(ahead > -reach_m) & (beside <= reach_m * math.hypot(1, widest / camera.focal_px))]


@kernel
def pixel_ray(camera: Pinhole, axes: Float, v: int, u: int, ray: Float) -> None:
    """Fill in the ray (3,) through a pixel's middle, one metre of depth long."""
    left, up = (camera.center_u - u) / camera.focal_px, (camera.center_v - v) / camera.focal_px
    for k in range(3):
        ray[k] = axes[0, k] + left * axes[1, k] + up * axes[2, k]


@kernel
def _in_camera(camera: Pinhole, solids: Solids, i: int, pose: Float) -> Float:
    """A solid's corners (K, 3) ahead, to the left and above the eye, metres."""
    eye, axes = in_robot(camera, pose)
    placed = np.empty((solids.n_corners[i], 3))
    for k in range(len(placed)):
        x, y = solids.corners_m[i, k, 0] - eye[0], solids.corners_m[i, k, 1] - eye[1]
        placed[k, 0] = axes[0, 0] * x + axes[0, 1] * y
        placed[k, 1] = axes[1, 0] * x + axes[1, 1] * y
        placed[k, 2] = solids.corners_m[i, k, 2] - eye[2]
    return placed


@kernel
def _project(camera: Pinhole, ahead: float, left: float, up: float, seen: Float) -> None:
    """Fill in u, v and depth (3,) of a point."""
    seen[0] = camera.center_u - camera.focal_px * left / ahead if ahead > 0 else np.nan
    seen[1] = camera.center_v - camera.focal_px * up / ahead if ahead > 0 else np.nan
    seen[2] = ahead


@kernel
def project_corners(camera: Pinhole, solids: Solids, i: int, pose: Float) -> Float:
    """A solid's corners (K, 3) in the picture: u, v and depth along the axis in metres."""
    seen = _in_camera(camera, solids, i, pose)
    for k in range(len(seen)):
        _project(camera, seen[k, 0], seen[k, 1], seen[k, 2], seen[k])
    return seen


@kernel_part
def _project_before_lens(camera: Pinhole, solids: Solids, i: int, pose: Float) -> Float:
    """The same (M, 3) of what is left of a solid that the plane through the lens cuts.

    Its corners before the plane, and where the plane meets the lines from them to the others: the
    edges that it cuts are among those, and all of them lie in the solid.
    """
    placed, near = _in_camera(camera, solids, i, pose), camera.near_m
    seen, m = np.empty((len(placed) * (len(placed) + 1), 3)), 0
    for p in placed:
        if p[0] <= near:
            continue
        _project(camera, p[0], p[1], p[2], seen[m])
        m += 1
        for q in placed:
            if q[0] <= near:
                t = (p[0] - near) / (p[0] - q[0])
                left, up = p[1] + t * (q[1] - p[1]), p[2] + t * (q[2] - p[2])
                _project(camera, near, left, up, seen[m])
                m += 1
    return seen[:m]


@kernel
def window(
    camera: Pinhole, solids: Solids, i: int, pose: Float, corners: Float
) -> tuple[int, int, int, int]:
    """First and last row and column that a solid may show in; `corners` are its projected ones."""
    first, last = extremes(corners)
    if last[2] <= camera.near_m:
        return 0, -1, 0, -1
    if first[2] <= camera.near_m:
        first, last = extremes(_project_before_lens(camera, solids, i, pose))
    left, top = max(np.floor(first[0] + 0.5), 0.0), max(np.floor(first[1] + 0.5), 0.0)
    right = min(np.floor(last[0] + 0.5), camera.width_px - 1.0)
    bottom = min(np.floor(last[1] + 0.5), camera.height_px - 1.0)
    return int(top), int(bottom), int(left), int(right)


@kernel_part
def all_windows(camera: Pinhole, solids: Solids, poses: Float) -> tuple[int, int, int, int]:
    """First and last row and column that any robot may show in."""
    above, below, first, last = camera.height_px, -1, camera.width_px, -1
    for r in range(len(poses)):
        for i in range(len(solids.n_corners)):
            corners = project_corners(camera, solids, i, poses[r])
            top, bottom, left, right = window(camera, solids, i, poses[r], corners)
            if top <= bottom and left <= right:
                above, below = min(above, top), max(below, bottom)
                first, last = min(first, left), max(last, right)
    return above, below, first, last


@kernel
def extremes(corners: Float) -> tuple[Float, Float]:
    """The least (3,) and the largest (3,) of corners (K, 3) in each coordinate."""
    first, last = corners[0].copy(), corners[0].copy()
    for k in range(1, len(corners)):
        for axis in range(3):
            first[axis] = min(first[axis], corners[k, axis])
            last[axis] = max(last[axis], corners[k, axis])
    return first, last
