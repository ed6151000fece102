"""The point that a track began with stays the same point of the wall as the robot draws near."""

from collections import defaultdict

import numpy as np
import pytest

from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.se2 import transform_points
from mapfusion.vision.features import PATCH_SIDE_PX, Features
from mapfusion.vision.front_end import FrontEnd
from mapfusion.vision.tracking import Tracker, TrackParameters, bend_of
from tests.mapfusion.vision.rendered_scene import render, wall
from tests.mapfusion.vision.shifted_pictures import Picture

CAMERA = StereoCamera(320, 240, 288.0)
START, END = (4.5, 3.0), (4.0, -3.0)
BESIDE = (((8.0, -1.5), (0.5, -1.5)), ((0.5, 1.5), (8.0, 1.5)))  # on the right, and on the left


def on_wall(
    pose: np.ndarray,
    uv: np.ndarray,
    start: tuple[float, float] = START,
    end: tuple[float, float] = END,
) -> np.ndarray:
    """Where rays through pixels (N, 2) meet the wall's plane."""
    eye = transform_points(pose, CAMERA.p_robot_left[None])[0]
    ray = transform_points(pose, CAMERA.back_project(uv, np.ones(len(uv)))) - eye
    normal = np.array([end[1] - start[1], start[0] - end[0], 0.0])
    depth = ((*start, 0.0) @ normal - eye @ normal) / (ray @ normal)
    return eye + depth[:, None] * ray


def test_the_point_stays_where_the_corner_strays() -> None:
    """Two metres towards a slanted wall, where each view's rays meet it."""
    rng = np.random.default_rng(0)
    room = [wall(rng, START, END, texels_per_m=120.0)]
    front_end, tracker = FrontEnd(CAMERA), Tracker(TrackParameters(), CAMERA, 0.1)
    points, corners = defaultdict(list), defaultdict(list)
    for t in range(11):
        pose = np.array([0.18 * t, 0.0, 0.008 * t])
        left, right, _ = render(room, CAMERA, tuple(pose), 1.0, rng)
        features = front_end.extract(left, right)
        tracks = tracker.update(features)
        point, corner = on_wall(pose, tracks.uv_px), on_wall(pose, features.uv_px)
        for i, track in enumerate(tracks.track_id):
            points[track].append(point[i])
            corners[track].append(corner[i])
    long = [track for track, seen in points.items() if len(seen) >= 10]
    assert len(long) > 8
    of_point, of_corner = (
        np.median([np.std(seen[track], axis=0).max() for track in long])
        for seen in (points, corners)
    )
    assert of_point < 0.4 * of_corner
    assert of_point < 0.002


@pytest.mark.parametrize("ends", BESIDE)
def test_points_of_walls_beside_the_way_do_not_slide(ends: tuple[tuple[float, float], ...]) -> None:
    """Fitted by an affine map they come 0.3 mm a frame towards the robot, all of them."""
    slides = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        room = [wall(rng, *ends, texels_per_m=60.0)]
        front_end, tracker = FrontEnd(CAMERA), Tracker(TrackParameters(), CAMERA, 0.1)
        points = defaultdict(list)
        for t in range(9):
            pose = np.array([0.12 * t, 0.0, 0.0])
            left, right, _ = render(room, CAMERA, tuple(pose), 1.0, rng)
            tracks = tracker.update(front_end.extract(left, right))
            for track, point in zip(
                tracks.track_id, on_wall(pose, tracks.uv_px, *ends), strict=True
            ):
                points[track].append(point)
        slides += [np.diff(np.array(seen)[:, 0]) for seen in points.values() if len(seen) > 2]
    slide = np.concatenate(slides)
    slide = slide[np.abs(slide) < 0.02]  # else it is another point
    error = slide.std() / np.sqrt(len(slide))
    assert error < 0.00005
    assert abs(slide.mean()) < 3 * error


@pytest.mark.parametrize("seed", range(5))
def test_a_window_bends_as_the_homography_of_its_plane(seed: int) -> None:
    """Points of a plane projected before and after driving; of the map at the point h is known."""
    rng, f = np.random.default_rng(seed), 400.0
    uv, d, slope = rng.uniform(-150, 150, 2), rng.uniform(5, 20), rng.uniform(-0.3, 0.3, 2)
    base, step = 0.12, np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.05, 0.05), 0.6])

    def later(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where what lies at uv + x, (N, 2), lies later, and with which disparity."""
        disparity = d + x @ slope
        depth = f * base / disparity
        ray = np.column_stack([(uv + x) / f, np.ones(len(x))])
        point = depth[:, None] * ray - step
        return f * point[:, :2] / point[:, 2:], f * base / point[:, 2]

    place, now = later(np.zeros((1, 2)))
    small = 1e-4 * np.concatenate([np.eye(2), -np.eye(2)])
    moved = later(small)[0]
    A = ((moved[:2] - moved[2:]) / 2e-4).T
    (h,) = bend_of(np.array([[d, *slope]]), now)
    x = rng.uniform(-8, 8, (20, 2))
    np.testing.assert_allclose(later(x)[0], place + x @ A.T / (1 + x @ h)[:, None], atol=1e-4)
    assert np.abs(x @ h).max() > 0.01


def test_the_disparity_is_that_of_the_point_and_not_of_the_corner() -> None:
    """The picture has moved by more than the corner that was found in it."""
    half, shift = PATCH_SIDE_PX // 2, np.array([1.5, -0.5])
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    tracker, picture = Tracker(TrackParameters(), CAMERA, 0.1), Picture(2)
    corner, slope = np.array([[100.0, 90.0]]), np.array([[0.1, -0.3]])
    for moved in (np.zeros(2), shift):
        patch = np.rint(np.clip(picture(u - moved[0], v - moved[1]), 0, 255)).astype(np.uint8)
        unit = np.eye(1, 64, dtype=np.float32)
        tracks = tracker.update(
            Features(corner, np.array([10.0]), np.array([0.1]), unit, slope, patch[None])
        )
    np.testing.assert_allclose(tracks.uv_px, corner + shift, atol=0.02)
    np.testing.assert_allclose(tracks.disparity_px, 10.0 + slope[0] @ shift, atol=0.01)


@pytest.mark.parametrize("patches", [True, False])
def test_what_looks_different_begins_a_new_track(patches: bool) -> None:
    """A link by descriptor between two places that look nothing alike; without patches it holds."""
    rng = np.random.default_rng(1)
    descriptor = np.eye(2, 64, dtype=np.float32)
    uv, disparity = np.array([[100.0, 100.0], [200.0, 100.0]]), np.full(2, 10.0)
    patch = rng.integers(0, 255, (2, PATCH_SIDE_PX, PATCH_SIDE_PX)).astype(np.uint8)
    tracker = Tracker(TrackParameters(), CAMERA, 0.1)
    shown = [patch, np.stack([patch[0], patch[0]])]
    for each in shown:
        features = Features(
            uv, disparity, np.full(2, 0.1), descriptor, patch=each if patches else None
        )
        tracks = tracker.update(features)
    assert tracks.length.tolist() == ([2, 1] if patches else [2, 2])
    np.testing.assert_allclose(tracks.uv_px, uv, atol=1e-6)
