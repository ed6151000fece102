"""The robot's motion from that of its camera: exact, with the covariance of its errors."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.attitude import Attitude
from mapfusion.geometry import se3
from mapfusion.geometry.camera import StereoCamera
from mapfusion.geometry.se2 import between
from mapfusion.vision.visual_odometry import RigidMotion, visual_odometry

CAMERA = StereoCamera()
MOUNT = se3.pose(Rotation.from_euler("ZYX", [0.2, 0.1, -0.05]).as_matrix(), [0.4, 0.1, 1.2])
MOVED = np.array([[0.5, 0.02, 0.1], [0.3, -0.01, -0.2]])  # of the robot


def of_camera(T_robot: np.ndarray) -> np.ndarray:
    """The motion that a camera on the mount takes it for, which thinks itself level."""
    taken = se3.pose(np.eye(3), CAMERA.p_robot_left)
    T = MOUNT @ se3.inverse(taken)
    return se3.inverse(T) @ T_robot @ T


def found(motions: list, steps: list[float]):
    return visual_odometry(motions, np.array(steps), CAMERA, MOUNT)


def test_a_tilted_camera_tells_the_robot_s_motion() -> None:
    motions = [RigidMotion(of_camera(T), np.eye(6), 9) for T in se3.from_planar(MOVED)]
    made = found([None, *motions], [0, 1, 1])
    np.testing.assert_allclose(made.increments[1:], MOVED, atol=1e-12)
    assert np.all(made.increments[0] == 0)
    assert not made.guessed.any()


def test_the_covariance_is_the_spread_of_the_errors() -> None:
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    true = of_camera(se3.from_planar(MOVED[0]))
    drawn = (root @ rng.standard_normal((6, 10_000))).T
    T = np.tile(true, (len(drawn), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(drawn[:, 3:]).as_matrix() @ T[:, :3, :3]
    T[:, :3, 3] += drawn[:, :3]
    covariance = root @ root.T
    motions = [None, *(RigidMotion(each, covariance, 9) for each in T)]
    made = found(motions, [1.0] * len(motions))
    spread = np.cov((made.increments[1:] - MOVED[0]).T)
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(
        made.covariance[1] / np.outer(scale, scale), spread / np.outer(scale, scale), atol=0.05
    )


def test_without_links_the_robot_goes_on_as_before() -> None:
    T = RigidMotion(of_camera(se3.from_planar(MOVED[0])), 1e-6 * np.eye(6), 9)
    made = found([None, T, None, None], [1, 1, 1, 3])
    np.testing.assert_allclose(made.increments[2], MOVED[0], atol=1e-12)
    np.testing.assert_allclose(made.increments[3], 3 * MOVED[0], atol=1e-12)
    assert made.guessed.tolist() == [False, False, True, True]
    assert np.all(np.diagonal(made.covariance[2]) >= MOVED[0] ** 2)


def test_a_guess_errs_by_the_largest_step_so_far() -> None:
    """A car that stood still may have begun to move as fast as it was before."""
    fast, slow = (RigidMotion(of_camera(se3.from_planar(step)), 1e-8 * np.eye(6), 9)
                  for step in np.array([[2.0, 0.0, 0.3], [0.0, 0.0, 0.0]]))  # fmt: skip
    made = found([None, None, fast, slow, None], [1, 1, 1, 1, 1])
    sigma = np.sqrt(np.diagonal(made.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[1], [0.1, 0.1, 0.1])
    np.testing.assert_allclose(sigma[4], [2.0, 0.1, 0.3], atol=1e-9)


def test_a_guess_is_of_the_speed_and_errs_with_the_time() -> None:
    """The speed is the last motion over its steps; a guess is the speed times the steps."""
    T = RigidMotion(of_camera(se3.from_planar(MOVED[0])), 1e-6 * np.eye(6), 9)
    made = found([None, T, None], [1, 2, 3])
    speed = MOVED[0] / 2
    np.testing.assert_allclose(made.increments[2], 3 * speed, atol=1e-12)
    sigma = 3 * np.abs(speed) + 3 * np.maximum(np.abs(speed), 0.1)
    np.testing.assert_allclose(made.covariance[2], np.diag(sigma**2), atol=1e-12)


# Roll, pitch and height of the body in three frames, and where it is in the plane.
TILTS = np.array([[0.1, -0.05, 0.0], [-0.2, 0.15, 0.0], [0.05, 0.25, 0.0]])
PATH = np.array([[1.0, 2.0, 0.5], [1.6, 2.3, 0.9], [1.9, 3.0, 2.0]])
SWAYING = Attitude(TILTS, np.zeros((3, 3)), np.zeros((3, 2)))


def test_a_swaying_body_moves_in_the_plane_as_its_level_frame_does() -> None:
    T_world_body = se3.in_space(PATH, TILTS[:, :2])
    motions = [
        RigidMotion(of_camera(se3.inverse(before) @ after), 1e-6 * np.eye(6), 9)
        for before, after in pairwise(T_world_body)
    ]
    made = visual_odometry([None, *motions], np.ones(3), CAMERA, MOUNT, SWAYING)
    np.testing.assert_allclose(made.increments[1:], between(PATH[:-1], PATH[1:]), atol=1e-12)


def test_a_swaying_body_s_covariance_is_that_of_its_increments_by_differences() -> None:
    T_world_body = se3.in_space(PATH, TILTS[:, :2])
    true = se3.inverse(T_world_body[1]) @ T_world_body[2]
    root = np.random.default_rng(1).normal(size=(6, 6))
    mount = se3.pose(np.eye(3), CAMERA.p_robot_left)  # the camera is where it was taken to be

    def told(error: np.ndarray):
        turn = Rotation.from_rotvec(error[3:]).as_matrix()
        T = se3.pose(turn @ true[:3, :3], true[:3, 3] + error[:3])
        attitude = Attitude(TILTS[1:], np.zeros((2, 3)), np.zeros((2, 2)))
        motions = [None, RigidMotion(T, root @ root.T, 9)]
        return visual_odometry(motions, np.ones(2), CAMERA, mount, attitude)

    step = 1e-6 * np.eye(6)
    J = np.array([told(h).increments[1] - told(-h).increments[1] for h in step]).T / 2e-6
    expected, found = J @ root @ root.T @ J.T, told(np.zeros(6)).covariance[1]
    scale = np.sqrt(np.diag(expected))
    # the heading's error is taken for the turn about the upright: to first order in the tilt
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.15
    )
    np.testing.assert_allclose(found[:2, :2], expected[:2, :2], rtol=1e-6, atol=1e-9)
