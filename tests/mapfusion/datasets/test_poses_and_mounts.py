"""Interpolation of poses, camera mounts and body frames."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from mapfusion.camera import StereoCamera
from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL
from mapfusion.datasets.levelling import (
    MountSettings,
    level_mount,
    level_observations,
    robot_in_body,
)
from mapfusion.datasets.text_files import TimedPoses
from mapfusion.geometry import se3
from mapfusion.robot_log import Observations

TIMES_NS = np.array([0, 10, 20, 60]) * 100_000_000


def poses(rng: np.random.Generator, n: int) -> np.ndarray:
    return se3.pose(Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3)))


def test_between_two_poses_the_turn_is_steady() -> None:
    T = poses(np.random.default_rng(0), 4)
    at = np.array([1, 4, 13, 30]) * 100_000_000
    found = TimedPoses(TIMES_NS, T).at(at, 10.0)
    steady = Slerp(TIMES_NS, Rotation.from_matrix(T[:, :3, :3]))(at)
    np.testing.assert_allclose(found[:, :3, :3], steady.as_matrix(), atol=1e-12)
    for k in range(3):
        straight = np.interp(at, TIMES_NS, T[:, k, 3])
        np.testing.assert_allclose(found[:, k, 3], straight, atol=1e-12)


def test_a_pose_at_the_time_itself_is_taken_as_it_is() -> None:
    T = poses(np.random.default_rng(1), 4)
    found = TimedPoses(TIMES_NS, T).at(TIMES_NS + np.array([0, 900, -900, 1000]), 0.1)
    np.testing.assert_array_equal(found, T)


def test_nothing_is_guessed_outside_and_in_gaps() -> None:
    T = poses(np.random.default_rng(2), 4)
    at = np.array([-1, 5, 15, 30, 61]) * 100_000_000
    known = np.isfinite(TimedPoses(TIMES_NS, T).at(at, 1.0)[:, 0, 0])
    assert known.tolist() == [False, True, True, False, False]
    alone = TimedPoses(TIMES_NS[:1], T[:1]).at(np.array([0, 1_000_000]), 1.0)
    assert np.isfinite(alone[:, 0, 0]).tolist() == [True, False]


def test_times_that_run_back_are_refused() -> None:
    with pytest.raises(ValueError, match="time_ns: must increase"):
        TimedPoses(TIMES_NS[::-1].copy(), poses(np.random.default_rng(0), 4))


@pytest.mark.parametrize("seed", range(6))
def test_the_robot_looks_where_its_camera_does(seed: int) -> None:
    """The mount is recovered for any order of the body axes and a small camera rotation."""
    rng = np.random.default_rng(seed)
    axes = np.rint(Rotation.create_group("O").as_matrix())[rng.integers(24)]
    off = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)).as_matrix()
    T_robot_left = se3.pose(off, rng.normal(size=3))
    optical = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T_body_camera = se3.pose(axes, np.zeros(3)) @ T_robot_left @ optical
    T_body_robot, found = robot_in_body(T_body_camera)
    np.testing.assert_allclose(T_body_robot[:3, :3], axes, atol=1e-15)
    np.testing.assert_allclose(found, T_robot_left, atol=1e-12)


def test_settings_replace_parts_of_a_mount() -> None:
    recorded = se3.pose(Rotation.from_euler("ZYX", [0.1, 0.2, 0.3]).as_matrix(), [1, 2, 3])
    np.testing.assert_array_equal(MountSettings().applied(recorded), recorded)
    T = MountSettings(z_m=0.5, pitch_rad=-0.1).applied(recorded)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 0.5])
    turned = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
    np.testing.assert_allclose(turned, [0.1, -0.1, 0.3], atol=1e-12)


def test_a_level_camera_keeps_its_observations() -> None:
    camera, rng = StereoCamera(), np.random.default_rng(0)
    seen = Observations(rng.normal(size=(5, 3)), np.tile(np.eye(3), (5, 1, 1)))
    T = level_mount(camera.baseline_m, camera.mount_x_m, camera.mount_z_m)
    assert level_observations(seen, camera, T) is seen


def test_what_is_fixed_to_a_body_moves_with_it() -> None:
    """A point of the other body is transformed by the pose of the first body."""
    rng = np.random.default_rng(3)
    T, T_body_other, point = poses(rng, 4), poses(rng, 1)[0], np.array([*rng.normal(size=3), 1.0])
    moved = TimedPoses(TIMES_NS, T).moved(T_body_other)
    np.testing.assert_allclose(moved.T @ point, T @ (T_body_other @ point), atol=1e-12)
    np.testing.assert_array_equal(moved.time_ns, TIMES_NS)
