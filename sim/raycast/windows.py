"""Where the other robots are in a picture: their places before the camera, and their windows."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float
from sim.raycast.plan import Pinhole, Plan, inverse_depths
from sim.raycast.solids import Solids


class Body(NamedTuple):
    """A robot before a camera.

    Attributes:
        eye_m: (3,) the camera's optical centre in the robot's frame.
        axes: (3, 3) the camera's axes there: ahead, left, up.
        outside_m: (P,) how far the eye is before each face's plane.
        windows: (S, 4) first and last row, first and last column that each solid may show in.
        shown: (N,) the solids that may show.
        is_cut: (S,) whether a solid reaches the lens.
        farthest_m: no part is farther ahead.
        outline_px: (M, 4) where edges that bound solids' pictures begin and end: u, v, u and v; in
            its solid's window, whose first pixel has its middle at (0, 0).
        first_edge: (S + 1,) int64, where each solid's begin among them, and M.
    """

    eye_m: Float
    axes: Float
    outside_m: Float
    windows: np.ndarray
    shown: np.ndarray
    is_cut: np.ndarray
    farthest_m: float
    outline_px: Float
    first_edge: np.ndarray

    def bounds(self) -> tuple[int, int, int, int]:
        """Rows and columns that it may show in: the first ones, and those after the last."""
        top, bottom, left, right = self.windows[self.shown].T
        return int(top.min()), int(bottom.max()) + 1, int(left.min()), int(right.max()) + 1

    def outline(self, i: int) -> Float:
        """Edges (E, 4) around a solid's picture, see above."""
        return self.outline_px[self.first_edge[i] : self.first_edge[i + 1]]


def place(camera: Pinhole, solids: Solids, pose: Float) -> Body:
    """A robot at a pose (3,) before a camera."""
    eye, axes = in_robot(camera, pose)
    outside = solids.planes[:, :3] @ eye - solids.planes[:, 3]
    x, y, up = (solids.corners_m - eye).T
    ahead, left = axes[0, 0] * x + axes[0, 1] * y, axes[1, 0] * x + axes[1, 1] * y
    begins, behind = solids.first_corner[:-1], ahead <= camera.near_m
    uv = _project(camera, np.where(behind, camera.near_m, ahead), left, up)
    low, high = uv, uv
    if behind.any():
        low, high = np.where(behind[:, None], [[[np.inf]], [[-np.inf]]], uv)
    low, high = np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)
    if behind.any():  # the plane through the lens meets edges
        meets = behind[solids.edges[:, 0]] != behind[solids.edges[:, 1]]
        begin, end = solids.edges[meets].T
        t = (ahead[begin] - camera.near_m) / (ahead[begin] - ahead[end])
        met_left, met_up = (at[begin] + t * (at[end] - at[begin]) for at in (left, up))
        met = _project(camera, np.full(len(t), camera.near_m), met_left, met_up)
        of = np.searchsorted(solids.first_corner, begin, side="right") - 1
        np.minimum.at(low, of, met)
        np.maximum.at(high, of, met)
    windows = _windows(camera, low, high)
    is_cut = np.logical_or.reduceat(behind, begins)
    top, bottom, first, last = windows.T
    shown = np.flatnonzero((top <= bottom) & (first <= last))
    # edges where a face that the eye sees meets one that it does not, that face to the left
    sees = outside[solids.sides] > 0
    bounding = np.flatnonzero(sees[:, 0] != sees[:, 1])
    ends = np.where(sees[bounding, :1], solids.edges[bounding], solids.edges[bounding, ::-1])
    first_edge = np.searchsorted(bounding, solids.first_edge)
    corner = np.repeat(windows[:, [2, 0, 2, 0]], np.diff(first_edge), axis=0)
    outline = uv[ends].reshape(-1, 4) - corner
    farthest_m = float(ahead.max())
    return Body(eye, axes, outside, windows, shown, is_cut, farthest_m, outline, first_edge)


def in_robot(camera: Pinhole, pose: Float) -> tuple[Float, Float]:
    """The eye (3,) in a robot's frame, and the camera's axes (3, 3) there: ahead, left, up."""
    theta = float(pose[2])
    cos, sin = math.cos(theta), math.sin(theta)
    x, y = camera.eye_x_m - pose[0], camera.eye_y_m - pose[1]
    eye = np.array([cos * x + sin * y, cos * y - sin * x, camera.eye_z_m])
    cos, sin = math.cos(camera.theta - theta), math.sin(camera.theta - theta)
    return eye, np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def by_distance(camera: Pinhole, poses: Float) -> Float:
    """The poses (R, 3) from the nearest to the farthest."""
    if len(poses) < 2:
        return poses
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


def is_hidden(camera: Pinhole, plan: Plan, reach_m: float, pose: Float) -> bool:
    """Whether walls hide all that could be within reach of a robot at a pose (3,)."""
    cos, sin = math.cos(camera.theta), math.sin(camera.theta)
    x, y = float(pose[0]) - camera.eye_x_m, float(pose[1]) - camera.eye_y_m
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    nearest, farthest, left, right = (
        ahead - reach_m,
        ahead + reach_m,
        aside + reach_m,
        aside - reach_m,
    )
    if nearest <= camera.near_m:
        return False
    u_left = camera.center_u - camera.focal_px * left / (nearest if left > 0 else farthest)
    u_right = camera.center_u - camera.focal_px * right / (nearest if right < 0 else farthest)
    first, last = (
        max(math.floor(u_left + 0.5), 0),
        min(math.floor(u_right + 0.5) + 1, camera.width_px),
    )
    return first >= last or bool(nearest * inverse_depths(plan, first, last).min() >= 1)


def _project(camera: Pinhole, ahead: Float, left: Float, up: Float) -> Float:
    """Pixels (N, 2) of points before the lens."""
    u = camera.center_u - camera.focal_px * left / ahead
    return np.stack([u, camera.center_v - camera.focal_px * up / ahead], axis=-1)


def _windows(camera: Pinhole, low_px: Float, high_px: Float) -> np.ndarray:
    """Windows (S, 4) from the least and largest u and v (S, 2) of all points of each solid."""
    size = np.array([camera.width_px, camera.height_px])
    first = np.minimum(np.maximum(np.floor(low_px + 0.5), 0), size)
    last = np.maximum(np.minimum(np.floor(high_px + 0.5), size - 1), -1)
    return np.stack([first[:, 1], last[:, 1], first[:, 0], last[:, 0]], axis=-1).astype(np.int64)
