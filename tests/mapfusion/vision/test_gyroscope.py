"""Gyroscopes beside pictures: the information form, a bias that is learnt, frames without links."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.geometry import se3
from mapfusion.vision.attitude_filter import Gyroscope
from mapfusion.vision.visual_odometry import RigidMotion

STEP_S = 0.05
NOISE_RAD = 1e-3 * np.sqrt(STEP_S)  # of one step, as is stated


def motion_of(T: np.ndarray, covariance: np.ndarray) -> RigidMotion:
    return RigidMotion(T, covariance, 30)


def test_it_is_the_sum_of_what_both_know() -> None:
    """Precisions add, each motion pulls by its own: least squares over both, to first order."""
    rng = np.random.default_rng(0)
    root = 1e-4 * rng.normal(size=(6, 6))
    C = root @ root.T
    gyroscope = Gyroscope(np.zeros(3), 1e-6 * np.eye(3))
    T = se3.pose(Rotation.from_rotvec([0.02, -0.1, 0.05]).as_matrix(), [0.1, 0.0, 0.02])
    more = np.array([2e-4, -1e-4, 3e-4])
    turned = (Rotation.from_rotvec(more) * Rotation.from_matrix(T[:3, :3])).as_rotvec()
    own = (2e-4**2 * STEP_S + 1e-6) * STEP_S**2 * np.eye(3) + NOISE_RAD**2 * np.eye(3)
    found = gyroscope.joined(turned, STEP_S, motion_of(T, C))
    precision = np.linalg.inv(C)
    precision[3:, 3:] += np.linalg.inv(own)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-3, atol=1e-15)
    step = np.linalg.solve(precision, np.concatenate([np.zeros(3), np.linalg.solve(own, more)]))
    np.testing.assert_allclose(found.T_before_after[:3, 3] - T[:3, 3], step[:3], atol=1e-9)
    turn = Rotation.from_matrix(found.T_before_after[:3, :3] @ T[:3, :3].T).as_rotvec()
    np.testing.assert_allclose(turn, step[3:], atol=1e-9)


def driven(seed: int, n: int, lost: slice) -> tuple[Gyroscope, np.ndarray, np.ndarray, np.ndarray]:
    """Gyroscope, true bias, and errors of the turns (n, 3) with what is stated of them."""
    rng = np.random.default_rng(seed)
    bias = rng.normal(0, 0.05, 3)
    gyroscope, errors, sigmas = Gyroscope(), np.zeros((n, 3)), np.zeros((n, 3))
    C = np.diag([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4]) ** 2
    for k in range(n):
        true = Rotation.from_rotvec(rng.normal(0, 0.03, 3))
        counted = true.as_rotvec() + STEP_S * bias + rng.normal(0, NOISE_RAD, 3)
        seen = Rotation.from_rotvec(rng.normal(0, 5e-4, 3)) * true
        motion = motion_of(se3.pose(seen.as_matrix(), rng.normal(0, 1e-3, 3)), C)
        blind = k in range(*lost.indices(n))
        found = gyroscope.joined(counted, STEP_S, None if blind else motion)
        made = Rotation.from_matrix(found.T_before_after[:3, :3])
        errors[k] = (made * true.inv()).as_rotvec()
        sigmas[k] = np.sqrt(np.diag(found.covariance)[3:])
    return gyroscope, bias, errors, sigmas


def test_the_bias_is_learnt_as_well_as_stated() -> None:
    squares = []
    for seed in range(40):
        gyroscope, bias, errors, sigmas = driven(seed, 120, slice(0))
        assert np.sqrt(np.diag(gyroscope.covariance)).max() < 3e-3
        squares += [(gyroscope.bias - bias) ** 2 / np.diag(gyroscope.covariance)]
        squares += [np.mean((errors / sigmas) ** 2, axis=0)]
    bias_square, turn_square = np.mean(squares[::2]), np.mean(squares[1::2])
    assert bias_square == pytest.approx(1.0, abs=0.45)
    assert turn_square == pytest.approx(1.0, abs=0.1)


def test_where_pictures_tell_nothing_it_goes_on_as_well_as_stated() -> None:
    found = [driven(seed, 100, slice(60, 100)) for seed in range(20)]
    squares = [np.mean((errors[60:] / sigmas[60:]) ** 2) for _, _, errors, sigmas in found]
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)
    assert max(np.abs(errors[60:]).max() for _, _, errors, _ in found) < 3e-3
