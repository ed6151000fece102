"""Tests of `sim.rendering.walls`."""

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from sim.floorplan import FloorPlan, Wall
from sim.rendering.scene import Walls, make_scene
from sim.rendering.walls import NO_WALL, Pinhole, find_visible_walls
from tests.sim.rendering.scenes import pinhole

CAMERA = StereoCamera(160, 120, 144.0)
PLAN = FloorPlan(
    (
        Wall(np.array([[0, 0], [9, 0], [9, 5], [0, 5], [0, 0]])),
        Wall(np.array([[3, 0], [3, 3.6]])),
        Wall(np.array([[6, 5], [6, 2.6], [7.5, 2.6]])),
        Wall(np.array([[4, 2], [5, 2.5]]), thickness_m=0.02),
        Wall(np.array([[1.2, 2], [1.6, 2], [1.6, 2.4], [1.2, 2.4], [1.2, 2]])),
    )
)


@pytest.fixture(scope="module")
def walls() -> Walls:
    corners = np.stack([face.corners_m for face in PLAN.faces()])
    return make_scene(corners, lambda _: np.zeros((4, 4), dtype=np.uint8)).walls


def places(n: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    at = rng.uniform([0.3, 0.3], [8.7, 4.7], (n, 2))
    at = at[PLAN.clearance_m(at) > 0.3]
    return np.column_stack([at, rng.uniform(-np.pi, np.pi, len(at))])


def cast(walls: Walls, camera: Pinhole, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest faces (N,) and depths (N,) by crossing each ray with each wall's line."""
    y = (camera.center_u - u) / camera.focal_px
    cos, sin = np.cos(camera.theta), np.sin(camera.theta)
    ray = np.stack([cos - y * sin, sin + y * cos], -1)[:, None]
    to_start = walls.start_m - [camera.eye_x_m, camera.eye_y_m]
    cross = ray[..., 0] * walls.along[:, 1] - ray[..., 1] * walls.along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (to_start[:, 0] * walls.along[:, 1] - to_start[:, 1] * walls.along[:, 0]) / cross
        t = (to_start[:, 0] * ray[..., 1] - to_start[:, 1] * ray[..., 0]) / cross
        z = np.where((z > camera.near_m) & (t >= 0) & (t <= walls.width_m) & (cross < 0), z, np.inf)
    return np.where(np.isfinite(z.min(axis=1)), z.argmin(axis=1), NO_WALL), z.min(axis=1)


def test_columns_middles_see_the_nearest_wall_at_its_depth(walls: Walls) -> None:
    u = np.arange(float(CAMERA.width_px))
    for pose in places(60):
        camera = pinhole(CAMERA, pose)
        plan = find_visible_walls(camera, walls)
        true_face, true_m = cast(walls, camera, u)
        np.testing.assert_array_equal(plan.middle, true_face)
        np.testing.assert_allclose(plan.middle_m, true_m, rtol=1e-9)


def test_strips_are_what_rays_through_their_middles_meet(walls: Walls) -> None:
    several = 0
    for pose in places(60):
        camera = pinhole(CAMERA, pose)
        plan = find_visible_walls(camera, walls)
        begin, end = plan.low, plan.high
        edges = np.arange(CAMERA.width_px + 1) - 0.5
        np.testing.assert_allclose(begin[plan.first[:-1]], edges[:-1], atol=1e-8)
        np.testing.assert_allclose(end[plan.first[1:] - 1], edges[1:], atol=1e-8)
        np.testing.assert_allclose(end[:-1], begin[1:], atol=1e-8)
        for share in (1e-3, 0.3, 0.5, 0.9, 1 - 1e-3):
            thick = end - begin > 1e-6
            true_face, _ = cast(walls, camera, (begin + share * (end - begin))[thick])
            np.testing.assert_array_equal(plan.face[thick], true_face)
        several += np.sum(np.diff(plan.first) > 1)
    assert several > 30  # corners, edges, and walls that run into each other


def test_where_no_wall_is_none_is_seen() -> None:
    corners = np.array([[[2, 0.5, 0], [2, -0.5, 0], [2, -0.5, 2.5], [2, 0.5, 2.5]]], dtype=float)
    walls = make_scene(corners, lambda _: np.zeros((4, 4), dtype=np.uint8)).walls
    camera = pinhole(StereoCamera(160, 120, 80.5, mount_x_m=0.0), np.zeros(3))
    plan = find_visible_walls(camera, walls)
    assert np.sum((plan.high - plan.low)[plan.face == 0]) == pytest.approx(80.5 / 2, abs=1e-9)
    turned = pinhole(CAMERA, np.array([4.0, 0.0, np.pi]))  # behind it: seen from its front only
    plan = find_visible_walls(turned, walls)
    assert np.all(plan.face == NO_WALL)
    assert np.all(np.isinf(plan.middle_m))
