"""The point that a track began with stays the same point of the wall as the robot draws near."""

from collections import defaultdict

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.se2 import transform_points
from mapfusion.vision.features import Features
from mapfusion.vision.frontend import FrontEnd
from mapfusion.vision.patch_fit import PATCH_SIDE_PX
from mapfusion.vision.tracks import Tracker, TrackParameters
from tests.mapfusion.vision.rendered_scene import render, wall

CAMERA = StereoCamera(320, 240, 288.0)
START, END = (4.5, 3.0), (4.0, -3.0)


def on_wall(pose: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Where rays through pixels (N, 2) meet the wall's plane."""
    eye = transform_points(pose, CAMERA.p_robot_left[None])[0]
    ray = transform_points(pose, CAMERA.back_project(uv, np.ones(len(uv)))) - eye
    normal = np.array([END[1] - START[1], START[0] - END[0], 0.0])
    depth = ((*START, 0.0) @ normal - eye @ normal) / (ray @ normal)
    return eye + depth[:, None] * ray


def test_the_point_stays_where_the_corner_strays() -> None:
    """Two metres towards a slanted wall, on which the places that tracks and corners show differ."""
    rng = np.random.default_rng(0)
    room = [wall(rng, START, END, texels_per_m=120.0)]
    front_end, tracker = FrontEnd(CAMERA), Tracker(TrackParameters(), CAMERA, 0.1)
    points, corners, depth_error = defaultdict(list), defaultdict(list), []
    for t in range(22):
        pose = np.array([0.09 * t, 0.0, 0.004 * t])
        left, right, _ = render(room, CAMERA, tuple(pose), 1.0, rng)
        features = front_end.extract(left, right)
        tracks = tracker.update(features)
        point, corner = on_wall(pose, tracks.uv_px), on_wall(pose, features.uv_px)
        for i, track in enumerate(tracks.track_id):
            points[track].append(point[i])
            corners[track].append(corner[i])
        far = np.linalg.norm(point - corner, axis=1) > 0.005
        true_disparity = CAMERA.project(transform_points(np.zeros(3), _robot(pose, point)))[:, 2]
        depth_error.append((tracks.disparity_px - true_disparity)[far])
    long = [track for track, seen in points.items() if len(seen) >= 15]
    assert len(long) > 8
    of_point, of_corner = (
        np.median([np.std(seen[track], axis=0).max() for track in long])
        for seen in (points, corners)
    )
    assert of_point < 0.4 * of_corner
    assert of_point < 0.002
    apart = np.concatenate(depth_error)
    assert len(apart) > 20
    assert abs(np.median(apart)) < 0.05


def _robot(pose: np.ndarray, p_world: np.ndarray) -> np.ndarray:
    """World points in the robot frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = (p_world[:, :2] - pose[:2]).T
    return np.column_stack([c * x + s * y, c * y - s * x, p_world[:, 2]])


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
