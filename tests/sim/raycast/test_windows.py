"""Windows of robots that the plane through the lens cuts, against rays through all pixels."""

import numpy as np
import pytest

from sim.p3at import URDF
from sim.raycast.plan import Pinhole
from sim.raycast.robots import depth_of
from sim.raycast.solids import read_solids
from sim.raycast.windows import in_robot, pixel_ray, project_corners, window, within_view
from sim.stereo_head import NEAR_M

# A wide lens low above the floor, which has something of a robot beside it in view.
CAMERA = Pinhole(80, 60, 30.0, 39.5, 29.5, 0.0, 0.0, 0.2, 0.0, NEAR_M)
SOLIDS = read_solids(URDF)


def pixels_hit(i: int, pose: np.ndarray) -> np.ndarray:
    """Rows and columns (N, 2) of the pixels whose middles hit a solid."""
    eye, axes = in_robot(CAMERA, pose)
    hit, ray = np.zeros((CAMERA.height_px, CAMERA.width_px), dtype=bool), np.empty(3)
    for v, u in np.ndindex(*hit.shape):
        pixel_ray(CAMERA, axes, v, u, ray)
        hit[v, u] = depth_of(SOLIDS, i, eye, ray, NEAR_M) < np.inf
    return np.argwhere(hit)


@pytest.mark.parametrize("pose", [(0.1, -0.4, 0.3), (0.0, 0.45, 1.7), (0.35, -0.4, -2.0)])
def test_the_window_holds_all_that_shows_of_what_reaches_the_lens(pose: tuple) -> None:
    at, cut, share = np.array(pose), 0, 1.0
    for i in range(len(SOLIDS.n_corners)):
        corners = project_corners(CAMERA, SOLIDS, i, at)
        hit = pixels_hit(i, at)
        if corners[:, 2].min() <= NEAR_M and len(hit):
            top, bottom, left, right = window(CAMERA, SOLIDS, i, at, corners)
            assert np.all(hit.min(axis=0) >= [top, left])
            assert np.all(hit.max(axis=0) <= [bottom, right])
            cut, size = cut + 1, (bottom - top + 1) * (right - left + 1)
            share = min(share, size / (CAMERA.width_px * CAMERA.height_px))
    assert cut > 0
    assert share < 0.5


def test_what_stands_beside_the_lens_has_no_window() -> None:
    beside = np.array([0.2, -1.5, 0.0])
    ahead = [project_corners(CAMERA, SOLIDS, i, beside) for i in range(len(SOLIDS.n_corners))]
    assert any(c[:, 2].min() <= NEAR_M < c[:, 2].max() for c in ahead)
    narrow = CAMERA._replace(focal_px=80.0)
    for i, corners in enumerate(ahead):
        if corners[:, 2].min() <= NEAR_M:
            top, bottom, left, right = window(narrow, SOLIDS, i, beside, corners)
            assert top > bottom or left > right


def test_robots_that_have_a_window_are_within_view_and_others_mostly_not() -> None:
    rng = np.random.default_rng(3)
    camera = CAMERA._replace(center_u=30.0, eye_x_m=1.0, eye_y_m=-2.0, theta=2.5)
    poses = rng.uniform([-3, -6, -np.pi], [5, 2, np.pi], (300, 3))
    reach_m = float(np.hypot(*SOLIDS.corners_m[..., :2].reshape(-1, 2).T).max())
    within = {tuple(pose) for pose in within_view(camera, reach_m, poses)}
    beside = 0
    for pose in poses:
        shows = False
        for i in range(len(SOLIDS.n_corners)):
            corners = project_corners(camera, SOLIDS, i, pose)
            top, bottom, left, right = window(camera, SOLIDS, i, pose, corners)
            shows |= top <= bottom and left <= right
        assert tuple(pose) in within or not shows
        beside += tuple(pose) in within and not shows
    assert 0 < len(within) < len(poses)
    assert beside < 0.15 * len(within)
