"""Tests of `sim.rendering.robots`."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mapfusion.geometry.se2 import transform_points
from sim.p3at import URDF
from sim.rendering.robots import (
    ProjectedRobot,
    cast_rays,
    fill_coverage,
    fill_minimum,
    project_robot,
    read_solids,
    within_view,
)
from sim.rendering.walls import Pinhole
from sim.stereo_head import NEAR_M


def outline(points: np.ndarray) -> np.ndarray:
    """Corners (K, 2) of the convex hull of points (N, 2), in one sense."""
    return points[ConvexHull(points).vertices]


def edges(corners: np.ndarray) -> np.ndarray:
    """Edges (K, 4) from each corner to the next."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def covered(corners: np.ndarray, height: int, width: int) -> np.ndarray:
    found = np.zeros((height, width))
    fill_coverage(np.random.default_rng(0).permutation(edges(corners)) - 0.5, found)
    return found


def is_inside(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    inside = np.ones(u.shape, dtype=bool)
    for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside &= (q[0] - p[0]) * (v - p[1]) - (q[1] - p[1]) * (u - p[0]) >= 0
    return inside


@pytest.mark.parametrize("seed", range(8))
def test_shares_are_those_of_many_points(seed: int) -> None:
    corners = outline(np.random.default_rng(seed).uniform(-3, [14, 11], (6, 2)))
    height, width, fine = 8, 11, 40
    found = covered(corners, height, width)
    v, u = (np.mgrid[: height * fine, : width * fine] + 0.5) / fine
    points = is_inside(corners, u, v).reshape(height, fine, width, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(found, points, atol=0.03)
    whole = covered(corners + 4, height + 8, width + 8)  # nothing of it beside the window
    assert whole.sum() == pytest.approx(ConvexHull(corners).volume, rel=1e-12)
    np.testing.assert_allclose(found, whole[4:-4, 4:-4], atol=1e-12)


def test_an_outline_beside_the_picture_covers_nothing() -> None:
    triangle = np.array([[20.0, 1], [24, 1], [22, 5]])
    for away in ([0, 0], [-40, 0], [-20, 10], [-20, -10]):
        assert covered(triangle + away, 8, 8).sum() == pytest.approx(0, abs=1e-12)


def test_corners_above_each_other_stay() -> None:
    """A box seen face on: three and more corners share a column."""
    box = np.array([[0, 1], [0, 0], [2, 0], [4, 0], [4, 2], [4, 3], [0, 3], [0, 2.0]])
    assert covered(box, 4, 5).sum() == pytest.approx(12)


@pytest.mark.parametrize("seed", range(4))
def test_the_least_function_is_filled_in_where_pixels_middles_are_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = outline(rng.uniform(-3, [14, 11], (6, 2)))
    in_row, per_column = rng.normal(5.0, 1.0, (8, 3)), rng.normal(0.0, 1.0, 3)
    found = np.zeros((8, 11))
    fill_minimum(edges(corners), in_row, per_column, found)
    v, u = np.mgrid[:8, :11]
    least = np.min(in_row[:, None] + per_column * np.arange(11)[:, None], axis=2)
    np.testing.assert_allclose(found, np.where(is_inside(corners, u, v), least, 0.0), atol=1e-12)
    assert np.any(found != 0)


# A wide lens low above the floor, which has something of a robot beside it in view.
CAMERA = Pinhole(80, 60, 30.0, 39.5, 29.5, 0.0, 0.0, 0.2, 0.0, NEAR_M)
SOLIDS = read_solids(URDF)


def depth_of(planes: np.ndarray, eye_m: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Depths (N,) at which rays (N, 3), one metre of depth long, enter a solid; infinity if not."""
    outside, toward = planes[:, :3] @ eye_m - planes[:, 3], rays @ planes[:, :3].T
    at = -outside / toward
    enter = np.where(toward < 0, at, NEAR_M).max(axis=1, initial=NEAR_M)
    leave = np.where(toward > 0, at, np.inf).min(axis=1)
    return np.where(enter < leave, enter, np.inf)


def depths_m(i: int, body: ProjectedRobot) -> np.ndarray:
    """Depths (H, W) of a solid behind pixels' middles, infinity where it is not."""
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px].reshape(2, -1, 1)
    ahead, left, up = body.axes
    to_left, to_up = CAMERA.center_u - u, CAMERA.center_v - v
    rays = ahead + to_left / CAMERA.focal_px * left + to_up / CAMERA.focal_px * up
    planes = SOLIDS.planes[SOLIDS.first_plane[i] : SOLIDS.first_plane[i + 1]]
    return depth_of(planes, body.eye_m, rays).reshape(CAMERA.height_px, CAMERA.width_px)


def ahead_m(camera: Pinhole, i: int, pose: np.ndarray) -> np.ndarray:
    """Return depths (K,) of a solid's corners for a robot at a pose."""
    corners = SOLIDS.corners_m[SOLIDS.first_corner[i] : SOLIDS.first_corner[i + 1]]
    x, y = transform_points(pose, corners)[:, :2].T
    x, y = x - camera.eye_x_m, y - camera.eye_y_m
    return np.cos(camera.theta) * x + np.sin(camera.theta) * y


POSES = [(0.1, -0.4, 0.3), (0.0, 0.45, 1.7), (0.35, -0.4, -2.0)]


@pytest.mark.parametrize("pose", [*POSES, (0.05, 0.0, 0.3), (1.2, 0.3, 0.4)])
def test_depths_are_those_of_rays_through_all_pixels(pose: tuple) -> None:
    """Solids in front of the camera, across the near plane and around the camera."""
    body = project_robot(CAMERA, SOLIDS, np.array(pose))
    seen = np.full((CAMERA.height_px, CAMERA.width_px), np.inf)
    cast_rays(CAMERA, SOLIDS, [body], np.zeros(len(SOLIDS.rgb)), seen)
    true = np.min([depths_m(i, body) for i in range(len(SOLIDS.rgb))], axis=0)
    both = np.isfinite(seen) & np.isfinite(true)
    assert both.sum() > 90
    assert np.mean(np.isfinite(seen) != np.isfinite(true)) < 1e-3
    assert np.mean(np.abs(seen[both] / true[both] - 1) > 1e-9) < 1e-3


@pytest.mark.parametrize("pose", POSES)
def test_the_window_holds_all_that_shows_of_what_reaches_the_lens(pose: tuple) -> None:
    body, cut, share = project_robot(CAMERA, SOLIDS, np.array(pose)), 0, 1.0
    for i in range(len(SOLIDS.rgb)):
        hit = np.argwhere(depths_m(i, body) < np.inf)
        assert body.is_cut[i] == (ahead_m(CAMERA, i, np.array(pose)).min() <= NEAR_M)
        if body.is_cut[i] and len(hit):
            top, bottom, left, right = body.windows[i]
            assert i in body.shown
            assert np.all(hit.min(axis=0) >= [top, left])
            assert np.all(hit.max(axis=0) <= [bottom, right])
            cut, size = cut + 1, (bottom - top + 1) * (right - left + 1)
            share = min(share, size / (CAMERA.width_px * CAMERA.height_px))
    assert cut > 0
    assert share < 0.5


def test_what_stands_beside_the_lens_has_no_window() -> None:
    beside = np.array([0.2, -1.5, 0.0])
    ahead = [ahead_m(CAMERA, i, beside) for i in range(len(SOLIDS.rgb))]
    assert any(m.min() <= NEAR_M < m.max() for m in ahead)
    body = project_robot(CAMERA._replace(focal_px=80.0), SOLIDS, beside)
    assert not np.any(body.is_cut[body.shown])


def test_robots_that_have_a_window_are_within_view_and_others_mostly_not() -> None:
    rng = np.random.default_rng(3)
    camera = CAMERA._replace(center_u=30.0, eye_x_m=1.0, eye_y_m=-2.0, theta=2.5)
    poses = rng.uniform([-3, -6, -np.pi], [5, 2, np.pi], (300, 3))
    within = {tuple(pose) for pose in within_view(camera, SOLIDS.reach_m, poses)}
    beside = 0
    for pose in poses:
        shows = len(project_robot(camera, SOLIDS, pose).shown) > 0
        assert tuple(pose) in within or not shows
        beside += tuple(pose) in within and not shows
    assert 0 < len(within) < len(poses)
    assert beside < 0.15 * len(within)
