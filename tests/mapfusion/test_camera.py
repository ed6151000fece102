"""Tests of `mapfusion.camera`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapfusion.camera import (
    EXACT,
    CalibrationError,
    StereoCamera,
    calibration_from,
    default_calibration_error,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from mapfusion.landmark_map import read_map, write_map
from mapfusion.robot_log import Observations, RobotLog, read_log, write_log
from tests.mapfusion.align.map_pairs import landmarks

LEFT_OPEN = CalibrationError(0.00123456789, 0.003)
OF_ONE_CAMERA = CalibrationError(0.0, 0.01, camera="left and right of June")
POINTS = np.random.default_rng(0).uniform(-20, 20, (9, 3))


def test_points_turn_about_the_maps_beginning_and_spread() -> None:
    small = CalibrationError(1e-6, 1e-6)
    turned = se2.transform_points(np.array([0.0, 0.0, 1e-6]), POINTS)
    np.testing.assert_allclose(small.moves_m(POINTS)[:, 0], turned - POINTS, atol=1e-10)
    larger = POINTS * [1 + 1e-6, 1 + 1e-6, 1.0]
    np.testing.assert_allclose(small.moves_m(POINTS)[:, 1], larger - POINTS, atol=1e-13)


def a_log(calibration: CalibrationError) -> RobotLog:
    seen = Observations(POINTS, np.tile(np.eye(3), (9, 1, 1)))
    return RobotLog("R1", False, np.zeros(1), np.zeros((1, 3)), np.zeros(9, int), seen, calibration)


@pytest.mark.parametrize("calibration", [EXACT, LEFT_OPEN, OF_ONE_CAMERA])
def test_logs_and_maps_keep_it(tmp_path: Path, calibration: CalibrationError) -> None:
    write_log(tmp_path / "R1", a_log(calibration))
    assert read_log(tmp_path / "R1").calibration == calibration
    write_map(tmp_path / "a.parquet", replace(landmarks(POINTS), calibration=calibration))
    assert read_map(tmp_path / "a.parquet").calibration == calibration


def test_files_of_exact_cameras_are_as_they_were(tmp_path: Path) -> None:
    write_log(tmp_path / "R1", a_log(EXACT))
    stored = pq.read_schema(tmp_path / "R1" / "frames.parquet").metadata
    assert not any(b"calibration" in key for key in stored)


@pytest.mark.parametrize("text", ["much", "-1", "nan"])
def test_what_is_no_deviation_is_one_line(text: str) -> None:
    with pytest.raises(InputError, match=r"R1: calibration_heading_rad .*metadata"):
        calibration_from({"calibration_heading_rad": text}, "R1")


def test_a_pixel_is_less_in_a_longer_lens() -> None:
    short, long = (default_calibration_error(StereoCamera(focal_px=f)) for f in (300.0, 3000.0))
    assert short.heading_rad > long.heading_rad > 0.002
    assert short.scale == long.scale


CAMERA = StereoCamera()
in_view = st.lists(
    st.tuples(st.floats(0.5, 30), st.floats(-10, 10), st.floats(-3, 5)), min_size=1, max_size=8
).map(np.array)


def pinhole(camera, p_robot):
    """Both images by similar triangles, the right camera one baseline to the right."""
    uv = []
    for y_camera in (camera.baseline_m / 2, -camera.baseline_m / 2):
        depth, left, up = p_robot - [camera.mount_x_m, y_camera, camera.mount_z_m]
        uv.append(
            (
                (camera.width_px - 1) / 2 - camera.focal_px * left / depth,
                (camera.height_px - 1) / 2 - camera.focal_px * up / depth,
            )
        )
    return uv


@given(in_view)
def test_projection_by_similar_triangles(p_robot):
    for uvd, p in zip(CAMERA.project(p_robot), p_robot, strict=True):
        (u_left, v_left), (u_right, v_right) = pinhole(CAMERA, p)
        assert uvd == pytest.approx((u_left, v_left, u_left - u_right), abs=1e-6)
        assert v_left == v_right


@given(in_view)
def test_triangulation_undoes_projection(p_robot):
    uvd = CAMERA.project(p_robot)
    position, _ = CAMERA.triangulate(uvd[:, :2], uvd[:, 2], 0.5, 0.3)
    np.testing.assert_allclose(position, p_robot, atol=1e-8)
    depth = p_robot[:, 0] - CAMERA.mount_x_m
    np.testing.assert_allclose(CAMERA.back_project(uvd[:, :2], depth), p_robot, atol=1e-8)


@pytest.mark.parametrize("p_robot", [[3.0, 0.0, 0.4], [2.0, 1.0, 1.5], [5.0, -2.5, 0.0]])
def test_covariance_against_monte_carlo(p_robot):
    rng = np.random.default_rng(0)
    uvd = CAMERA.project(np.array([p_robot]))
    sigma_uv, sigma_disparity, n = 0.3, 0.1, 200_000
    noise = rng.normal(0, [sigma_uv, sigma_uv, sigma_disparity], (n, 3))
    noisy = uvd + noise
    position, _ = CAMERA.triangulate(noisy[:, :2], noisy[:, 2], sigma_uv, sigma_disparity)
    _, covariance = CAMERA.triangulate(uvd[:, :2], uvd[:, 2], sigma_uv, sigma_disparity)
    sigma = np.sqrt(np.diag(covariance[0]))
    np.testing.assert_allclose(
        np.cov(position.T) / np.outer(sigma, sigma),
        covariance[0] / np.outer(sigma, sigma),
        atol=0.02,
    )


def test_error_along_the_ray_grows_with_the_square_of_depth():
    p = np.array([[2.15, 0.045, 0.45], [4.15, 0.045, 0.45]])  # on the left camera's axis
    uvd = CAMERA.project(p)
    _, covariance = CAMERA.triangulate(uvd[:, :2], uvd[:, 2], 0.3, 0.1)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert sigma[1, 0] / sigma[0, 0] == pytest.approx(4)
    assert sigma[1, 1:] / sigma[0, 1:] == pytest.approx([2, 2])
    # one pixel of disparity is 0.48 m at 5 m
    far = np.array([[5.15, 0.045, 0.45]])
    uvd = CAMERA.project(far)
    _, covariance = CAMERA.triangulate(uvd[:, :2], uvd[:, 2], 0.3, 1.0)
    assert np.sqrt(covariance[0, 0, 0]) == pytest.approx(0.48, abs=0.005)


def test_disparity_noise_may_differ_from_point_to_point():
    uvd = CAMERA.project(np.array([[3.0, 0.5, 1.0], [3.0, 0.5, 1.0]]))
    _, covariance = CAMERA.triangulate(uvd[:, :2], uvd[:, 2], 0.3, np.array([0.1, 0.4]))
    for i, sigma in enumerate((0.1, 0.4)):
        _, alone = CAMERA.triangulate(uvd[:1, :2], uvd[:1, 2], 0.3, sigma)
        np.testing.assert_allclose(covariance[i], alone[0])


def test_far_points_are_seen_where_a_turn_of_the_robot_leaves_them():
    rng = np.random.default_rng(3)
    far = 1e7 * np.column_stack([np.ones(20), rng.uniform(-0.4, 0.4, (20, 2))])
    R_robot_before = Rotation.from_euler("ZYX", [0.1, -0.06, 0.03]).as_matrix()
    found = CAMERA.rotate_pixels(CAMERA.project(far)[:, :2], R_robot_before)
    expected = CAMERA.project(np.array([R_robot_before @ p for p in far]))[:, :2]
    np.testing.assert_allclose(found, expected, atol=1e-4)
