"""Tests of `sim.stereo_head`."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest, norm

from mapfusion.camera import StereoCamera
from mapfusion.errors import InputError
from sim.floorplan import FloorPlan
from sim.stereo_head import (
    SAME_SURFACE,
    VALUES,
    RadiometricNoise,
    StereoFrame,
    camera_pose,
    depth_at,
    draw_bits,
    expose,
    normal_values,
    render_stereo,
)
from sim.world import World
from tests.sim.ray_casting import CAMERA, NO_NOISE, POSE, off_surface_m, ray_cast


def in_numpy(depth_m: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
    """Inverse depths weighed by the shares of four pixels, the nearest's where they differ."""
    height, width = depth_m.shape
    uv = np.clip(uv_px, 0, [width - 1, height - 1])
    low = np.minimum(uv.astype(int), [width - 2, height - 2])
    (u, v), (a, b) = low.T, (uv - low).T
    corners = np.stack([depth_m[v + j, u + i] for j in (0, 1) for i in (0, 1)], -1)
    corners = corners.astype(np.float64)
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], -1)
    nearest = corners[np.arange(len(uv)), np.argmax(weights, axis=-1)]
    one_surface = np.ptp(corners, axis=-1) <= SAME_SURFACE * nearest
    return np.where(one_surface, 1 / np.sum(weights / corners, axis=-1), nearest)


def test_depths_equal_those_of_numpy_bit_for_bit() -> None:
    """On surfaces and their edges, beside the background, on pixels and beside the image."""
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(1, 1.04, (30, 40)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.1] = np.nan
    uv_px = rng.uniform(-3, 45, (3000, 2))
    uv_px[:500] = np.rint(uv_px[:500])
    uv_px[500:1000] = np.rint(2 * uv_px[500:1000]) / 2  # as near to several
    expected = in_numpy(depth_m, uv_px)
    assert 0.1 < np.mean(np.isnan(expected)) < 0.3
    assert np.mean(np.isin(expected, depth_m)) > 0.05
    np.testing.assert_array_equal(depth_at(depth_m, uv_px), expected)


def test_the_table_is_the_normal_law() -> None:
    values = normal_values().astype(float)
    assert values.mean() == pytest.approx(0, abs=1e-7)
    assert values.std() == pytest.approx(1, abs=1e-6)
    # the share below each value, half of its own included
    np.testing.assert_allclose(norm.cdf(values), (np.arange(VALUES) + 0.5) / VALUES, atol=1e-4)


@pytest.mark.parametrize("n", [1, 3, 4, 100_001])
def test_bits_are_equally_likely_and_independent(n: int) -> None:
    bits = draw_bits(n, np.random.default_rng(5))
    assert bits.shape == (n,)
    if n > 100_000:
        for digit in range(16):  # binary
            ones = bits >> digit & 1
            assert abs(ones.mean() - 0.5) < 4 * 0.5 / np.sqrt(n)
            assert abs(np.corrcoef(ones[1:], ones[:-1])[0, 1]) < 4 / np.sqrt(n)


def test_noise_follows_the_normal_law_with_its_sigma() -> None:
    noise = RadiometricNoise(sigma_gray=20.0, sigma_gain=0, sigma_offset_gray=0)
    flat = np.full((300, 400), 128, dtype=np.uint8)
    rng = np.random.default_rng(3)
    seen = expose(flat, noise, rng) + rng.uniform(-0.5, 0.5, flat.shape)  # rounding taken back
    assert kstest((seen.ravel() - 128) / 20, "norm").pvalue > 0.001
    off = seen - 128
    for aside in (off[:, 1:] * off[:, :-1], off[1:] * off[:-1]):  # neighbours know nothing
        assert abs(aside.mean() / 400) < 4 / np.sqrt(aside.size)


def test_each_pixel_is_its_level_and_its_deviation_rounded_and_kept_in_a_byte() -> None:
    noise = RadiometricNoise(sigma_gray=9.0, sigma_gain=0.2, sigma_offset_gray=10.0, gain=1.1)
    gray = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
    seen = expose(gray, noise, np.random.default_rng(7))
    rng = np.random.default_rng(7)
    gain, offset = 1.1 * (1 + 0.2 * rng.standard_normal()), 10.0 * rng.standard_normal()
    bits = draw_bits(gray.size, rng).reshape(gray.shape)
    level = gain * gray + offset + 9.0 * normal_values().astype(float)[bits]
    clear = np.abs(level % 1 - 0.5) > 1e-3  # single precision rounds no differently
    np.testing.assert_array_equal(seen[clear], np.rint(level.clip(0, 255))[clear])
    assert clear.mean() > 0.99
    assert {0, 255} <= set(seen.ravel().tolist())


def test_gamma_is_a_power_of_the_light_over_the_full_range() -> None:
    ramp = np.arange(256, dtype=np.uint8)[None]
    for gamma, gain in ((1.0, 1.0), (2.0, 1.0), (0.5, 0.8)):
        noise = RadiometricNoise(0, sigma_gain=0, sigma_offset_gray=0, gain=gain, gamma=gamma)
        seen = expose(ramp, noise, np.random.default_rng(0))[0].astype(float)
        np.testing.assert_allclose(seen, 255 * gain * (ramp[0] / 255) ** gamma, atol=0.501)


def test_gain_and_offset_are_those_of_a_whole_image() -> None:
    noise = RadiometricNoise(sigma_gray=0, sigma_gain=0.05, sigma_offset_gray=4)
    ramp = np.tile(np.arange(60, 200, dtype=np.uint8), (4, 1))
    fits = [
        np.polyfit(ramp[0], expose(ramp, noise, np.random.default_rng(seed))[0], 1)
        for seed in range(400)
    ]
    gain, offset = np.transpose(fits)
    assert gain.mean() == pytest.approx(1, abs=0.01)
    assert gain.std() == pytest.approx(0.05, rel=0.15)
    assert offset.std() == pytest.approx(4, rel=0.15)


def test_a_dark_camera_scales_the_light_and_not_the_noise() -> None:
    dark = RadiometricNoise(sigma_gray=3.0, sigma_gain=0, sigma_offset_gray=0, gain=0.25)
    flat = np.full((200, 300), 160, dtype=np.uint8)
    seen = expose(flat, dark, np.random.default_rng(2)).astype(float)
    assert seen.mean() == pytest.approx(40, abs=0.05)
    assert seen.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)


def test_negative_noise_is_refused() -> None:
    with pytest.raises(InputError, match="gain: is -1"):
        RadiometricNoise(gain=-1)


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
