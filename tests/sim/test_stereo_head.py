from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.geometry.camera import StereoCamera
from sim.floorplan import FloorPlan
from sim.stereo_head import RadiometricNoise, StereoFrame, camera_pose, render_stereo
from sim.world import World
from tests.sim.ray_casting import CAMERA, NO_NOISE, POSE, off_surface_m, ray_cast


@pytest.fixture(scope="module")
def frame(faces: Path) -> StereoFrame:
    with World() as world:
        world.add_painted_faces(faces)
        return render_stereo(world, CAMERA, POSE, NO_NOISE, np.random.default_rng(0))


def test_left_image_is_that_of_an_exact_pinhole(
    room: FloorPlan, faces: Path, frame: StereoFrame
) -> None:
    same = np.all(frame.left_rgb == ray_cast(room, faces, CAMERA.baseline_m / 2), axis=-1)
    assert same.mean() > 0.999


@pytest.mark.parametrize("shift_px", [(0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1)])
def test_a_tenth_of_a_pixel_would_show(
    room: FloorPlan, faces: Path, frame: StereoFrame, shift_px: tuple[float, float]
) -> None:
    shifted = ray_cast(room, faces, CAMERA.baseline_m / 2, shift_px)
    assert np.all(frame.left_rgb == shifted, axis=-1).mean() < 0.98


def test_right_image_is_seen_a_baseline_further_right(
    room: FloorPlan, faces: Path, frame: StereoFrame
) -> None:
    expected = cv2.cvtColor(ray_cast(room, faces, -CAMERA.baseline_m / 2), cv2.COLOR_RGB2GRAY)
    assert np.mean(frame.right == expected) > 0.999


def test_depth_puts_every_pixel_on_a_surface(room: FloorPlan, frame: StereoFrame) -> None:
    assert off_surface_m(room, CAMERA, frame.depth_m).max() < 2e-4


def test_disparity_found_by_matching_agrees_with_depth(frame: StereoFrame) -> None:
    """A slow, plain matcher: whole-window correlation along the row."""
    rng = np.random.default_rng(1)
    errors = []
    for u, v in zip(rng.integers(120, 600, 60), rng.integers(20, 220, 60), strict=True):
        around = frame.depth_m[v - 9 : v + 10, u - 9 : u + 10]
        window = frame.left[v - 9 : v + 10, u - 9 : u + 10]
        if np.ptp(around) > 0.1 or window.std() < 15:
            continue
        row = frame.right[v - 9 : v + 10, u - 109 : u + 10]
        score = cv2.matchTemplate(row, window, cv2.TM_CCOEFF_NORMED)[0]
        expected = CAMERA.focal_px * CAMERA.baseline_m / frame.depth_m[v, u]
        errors.append(100 - int(score.argmax()) - expected)
    assert len(errors) > 20
    assert np.median(np.abs(errors)) < 0.6  # whole pixels err by 0.25 on average
    assert abs(np.median(errors)) < 0.4


def test_nothing_has_no_depth() -> None:
    with World() as world:
        empty = render_stereo(world, CAMERA, POSE, NO_NOISE, np.random.default_rng(0))
    assert np.all(np.isnan(empty.depth_m))


def test_noise_is_independent_in_both_images(faces: Path, frame: StereoFrame) -> None:
    noise = RadiometricNoise(sigma_gray=3.0, sigma_gain=0, sigma_offset_gray=0)
    with World() as world:
        world.add_painted_faces(faces)
        noisy = render_stereo(world, CAMERA, POSE, noise, np.random.default_rng(5))
    left = noisy.left.astype(float) - frame.left
    right = noisy.right.astype(float) - frame.right
    rounding_variance = 1 / 12
    for difference in (left, right):
        assert abs(difference.mean()) < 0.03
        assert difference.std() == pytest.approx(np.sqrt(9 + rounding_variance), rel=0.01)
    assert abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 0.01
    np.testing.assert_array_equal(noisy.left_rgb, frame.left_rgb)


def test_camera_of_another_size_and_mount_is_exact_too(room: FloorPlan, faces: Path) -> None:
    camera = StereoCamera(321, 200, 250.0, 0.2, mount_x_m=-0.1, mount_z_m=0.8)
    with World() as world:
        world.add_painted_faces(faces)
        frame = render_stereo(world, camera, POSE, NO_NOISE, np.random.default_rng(0))
    assert off_surface_m(room, camera, frame.depth_m).max() < 2e-4


def test_a_tilted_pair_on_a_turned_robot_looks_along_its_axes() -> None:
    """The pair is rolled, then pitched, then turned with the robot."""
    camera = replace(CAMERA, mount_roll_rad=0.1, mount_pitch_rad=0.2)
    x, y, heading = 1.0, -2.0, 0.7
    found = camera_pose(camera, [x, y, heading], 0.05)
    mounted = Rotation.from_euler("ZYX", [0.0, 0.2, 0.1])
    turned = Rotation.from_euler("Z", heading)
    np.testing.assert_allclose(found[:3, :3], (turned * mounted).as_matrix(), atol=1e-12)
    eye = camera.p_robot_eye(0.0) + mounted.apply([0.0, 0.05, 0.0])
    np.testing.assert_allclose(found[:3, 3], turned.apply(eye) + np.array([x, y, 0.0]), atol=1e-12)
    assert found[2, 0] < 0  # it looks down
