import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapfusion.geometry.camera import StereoCamera

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
    found = CAMERA.turned(CAMERA.project(far)[:, :2], R_robot_before)
    expected = CAMERA.project(np.array([R_robot_before @ p for p in far]))[:, :2]
    np.testing.assert_allclose(found, expected, atol=1e-4)
