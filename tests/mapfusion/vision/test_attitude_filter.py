"""Tests of `mapfusion.vision.attitude_filter`."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.camera import StereoCamera
from mapfusion.geometry import se3
from mapfusion.robot_log import Observations
from mapfusion.vision.attitude_filter import (
    LOST_M,
    AttitudeEstimator,
    AttitudeFilter,
    AttitudeMeasurement,
    Gyroscope,
)
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
    found = gyroscope.fuse(turned, STEP_S, motion_of(T, C))
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
        found = gyroscope.fuse(counted, STEP_S, None if blind else motion)
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


INCLINOMETER = np.array([0.0052, 0.0052, 0.0])
TURN_SIGMA, STEP_SIGMA = 0.0004, 0.002


def swaying_bodies(rng: np.random.Generator, n: int) -> np.ndarray:
    """Poses (n, 4, 4) along a winding way, pitching and rolling by 3 degrees."""
    turned = np.cumsum(rng.normal(0, 0.1, n))
    way = np.stack([0.1 * np.arange(n), np.zeros(n), turned], -1)
    return se3.in_space(way, rng.normal(0, 0.05, (n, 2)))


def measured_motion(rng: np.random.Generator, before: np.ndarray, after: np.ndarray) -> RigidMotion:
    T = se3.between(before, after)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(0, TURN_SIGMA, 3)).as_matrix() @ T[:3, :3]
    T[:3, 3] += rng.normal(0, STEP_SIGMA, 3)
    return RigidMotion(T, np.diag([STEP_SIGMA**2] * 3 + [TURN_SIGMA**2] * 3), 9)


def test_exact_turns_carry_an_exact_attitude() -> None:
    bodies = swaying_bodies(np.random.default_rng(0), 30)
    bodies[:, 2, 3] = np.linspace(0, 1, 30)
    kept = AttitudeFilter()
    first = np.array([*se3.roll_pitch(bodies[0, :3, :3]), 0.0])
    kept.measure(AttitudeMeasurement(first, np.zeros(3)))
    for before, after in itertools.pairwise(bodies):
        kept.move(RigidMotion(se3.between(before, after), np.zeros((6, 6)), 9))
        expected = [*se3.roll_pitch(after[:3, :3]), after[2, 3]]
        np.testing.assert_allclose(kept.value, expected, atol=1e-12)
    np.testing.assert_allclose(kept.covariance, 0, atol=1e-20)


def test_errors_stay_in_the_world_when_the_body_turns() -> None:
    """Uncertain in roll, and turned by a quarter: uncertain in pitch."""
    kept = AttitudeFilter()
    kept.measure(AttitudeMeasurement(np.zeros(3), np.array([0.01, 0.001, 0.0])))
    quarter = se3.from_planar(np.array([0.0, 0.0, np.pi / 2]))
    kept.move(RigidMotion(quarter, np.zeros((6, 6)), 9))
    np.testing.assert_allclose(kept.sigma, [0.001, 0.01, 0.0], rtol=1e-3, atol=1e-12)
    # half a metre ahead of a body whose pitch is uncertain, its height is too
    kept.move(RigidMotion(se3.from_planar(np.array([0.5, 0.0, 0.0])), np.zeros((6, 6)), 9))
    np.testing.assert_allclose(kept.sigma[2], 0.005, rtol=1e-3)


def test_what_a_tilt_moves_is_expected_there() -> None:
    rng = np.random.default_rng(5)
    before, after = rng.normal(0, 0.05, (2, 2))
    levelling = AttitudeEstimator()
    levelling.add(None, AttitudeMeasurement(np.array([*before, 0.0]), np.full(3, 1e-9)))
    turn = levelling.expected_turn(AttitudeMeasurement(np.array([*after, 0.0]), INCLINOMETER))
    ray = rng.normal(size=3)
    assert turn is not None
    np.testing.assert_allclose(
        turn @ se3.tilt(*before).T @ ray, se3.tilt(*after).T @ ray, atol=1e-9
    )


def test_errors_are_as_large_as_stated_and_smaller_than_measured() -> None:
    rng = np.random.default_rng(1)
    errors, sigmas, carried = [], [], []
    for _ in range(60):
        bodies = swaying_bodies(rng, 25)
        true = np.c_[se3.roll_pitch(bodies[:, :3, :3]), np.zeros(25)]
        levelling = AttitudeEstimator()
        for k, body in enumerate(bodies):
            motion = measured_motion(rng, bodies[k - 1], body) if k else None
            told = np.array([*(true[k, :2] + rng.normal(0, INCLINOMETER[:2])), np.nan])
            if k == 0:
                told[2] = 0.0  # the height is known where the map begins, and carried on
            levelling.add(motion, AttitudeMeasurement(told, INCLINOMETER))
        errors.append(levelling.attitude.value - true)
        sigmas.append(levelling.attitude.sigma)
        carried.append(levelling.attitude.carried)
    last, sigma = np.array(errors)[:, -1], np.array(sigmas)[:, -1]
    assert np.mean((last / sigma) ** 2, axis=0) == pytest.approx([1, 1, 1], abs=0.45)
    assert np.all(sigma[:, :2] < 0.35 * INCLINOMETER[:2])
    # what is left of an error one frame later, by regression
    before, after = np.array(errors)[:, 9:-1], np.array(errors)[:, 10:]
    left = np.sum(before * after, axis=(0, 1)) / np.sum(before**2, axis=(0, 1))
    told = np.mean(np.array(carried)[:, 10:], axis=(0, 1))
    assert left[:2].mean() == pytest.approx(told[0], abs=0.05)
    assert told[0] < 0.97
    assert told[1] == 1.0


def test_without_links_what_is_measured_counts_alone() -> None:
    rng = np.random.default_rng(2)
    levelling = AttitudeEstimator()
    for told in rng.normal(0, 0.05, (5, 2)):
        levelling.add(None, AttitudeMeasurement(np.array([*told, 0.0]), INCLINOMETER))
        np.testing.assert_allclose(levelling.attitude.value[-1, :2], told, atol=1e-5)
        np.testing.assert_allclose(levelling.attitude.sigma[-1], INCLINOMETER, rtol=1e-4)


def test_a_mount_changes_nothing() -> None:
    """A camera that is turned on its robot, and points and motions in its own frame."""
    rng = np.random.default_rng(3)
    mount = se3.pose(Rotation.from_euler("ZYX", [0.3, 0.1, -0.2]).as_matrix(), [0.3, 0.1, 0.5])
    bodies = swaying_bodies(rng, 6)
    own, by_camera = AttitudeEstimator(), AttitudeEstimator(mount)
    p_camera = rng.uniform([1, -1, -1], [4, 1, 1], (7, 3))
    p_body = p_camera @ mount[:3, :3].T + mount[:3, 3]
    for k, body in enumerate(bodies):
        told = AttitudeMeasurement(np.array([*se3.roll_pitch(body[:3, :3]), 0.0]), INCLINOMETER)
        turn, seen_turn = own.expected_turn(told), by_camera.expected_turn(told)
        motion = measured_motion(rng, bodies[k - 1], body) if k else None
        seen = None if motion is None else motion.of_body(se3.inverse(mount))
        own.add(motion, told)
        by_camera.add(seen, told)
        points = [
            levelling.to_level_frame(Observations(p, np.tile(1e-4 * np.eye(3), (7, 1, 1))))
            for levelling, p in ((own, p_body), (by_camera, p_camera))
        ]
        np.testing.assert_allclose(points[1].position_m, points[0].position_m, atol=1e-12)
        np.testing.assert_allclose(points[1].covariance_m2, points[0].covariance_m2, atol=1e-14)
        assert (turn is None) == (seen_turn is None) == (k == 0)
        if turn is not None and seen_turn is not None:
            R = mount[:3, :3]
            np.testing.assert_allclose(R @ seen_turn @ R.T, turn, atol=1e-12)


def test_far_points_are_expected_where_a_tilt_moves_them() -> None:
    camera = StereoCamera(mount_pitch_rad=0.1, mount_roll_rad=-0.05)
    rng = np.random.default_rng(4)
    before, after = se3.tilt(*rng.normal(0, 0.05, (2, 2)).T)
    p_world = rng.uniform([1e6, -3e5, -2e5], [2e6, 3e5, 2e5], (30, 3))
    uv_before, uv_after = (camera.project(p_world @ R)[:, :2] for R in (before, after))
    np.testing.assert_allclose(
        camera.rotate_pixels(uv_before, after.T @ before), uv_after, atol=1e-3
    )


def moved_from(value: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return the value to which a motion takes the filter from another value."""
    kept = AttitudeFilter(value=value)
    kept.move(RigidMotion(T, np.zeros((6, 6)), 9))
    return kept.value


def test_a_step_carries_errors_as_it_carries_the_attitude() -> None:
    """The covariance follows from numerical derivatives of the value at a level body."""
    rng = np.random.default_rng(6)
    T = se3.pose(Rotation.from_euler("ZYX", [0.8, 0.1, -0.15]).as_matrix(), [0.5, -0.3, 0.1])
    before, of_motion = (root @ root.T for root in (rng.normal(size=(n, n)) for n in (3, 6)))
    kept = AttitudeFilter(covariance=before.copy())
    kept.move(RigidMotion(T, of_motion, 9))
    h = 1e-6

    def by_turn(axis: np.ndarray) -> np.ndarray:
        turned = se3.pose(Rotation.from_rotvec(axis).as_matrix() @ T[:3, :3], T[:3, 3])
        return moved_from(np.zeros(3), turned)

    by_value = [moved_from(e, T) - moved_from(-e, T) for e in h * np.eye(3)]
    turns = [by_turn(e) - by_turn(-e) for e in h * np.eye(3)]
    J_value, J_turn = np.array(by_value).T / (2 * h), np.array(turns).T / (2 * h)
    J_motion = np.concatenate([np.zeros((3, 3)), J_turn], axis=1)
    J_motion[2, :3] = [0.0, 0.0, 1.0]  # of a level body, what it rises by
    expected = J_value @ before @ J_value.T + J_motion @ of_motion @ J_motion.T
    scale = np.sqrt(np.diag(expected))
    # roll and pitch are taken for turns about the level axes: to first order in the tilt
    np.testing.assert_allclose(
        kept.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.06
    )
    rise = before[2, 2] + 2 * before[2, :2] @ [T[1, 3], -T[0, 3]] + of_motion[2, 2]
    rise += [T[1, 3], -T[0, 3]] @ before[:2, :2] @ [T[1, 3], -T[0, 3]]
    assert kept.covariance[2, 2] == pytest.approx(rise)


def test_a_lost_step_leaves_the_height_but_for_what_it_may_have_climbed() -> None:
    kept = AttitudeFilter()
    kept.measure(AttitudeMeasurement(np.array([0.1, -0.1, 2.0]), np.array([0.01, 0.01, 0.05])))
    before = kept.covariance[2, 2]
    kept.move(None)
    assert kept.covariance[2, 2] == pytest.approx(before + LOST_M**2)
    assert kept.covariance[0, 0] == kept.covariance[1, 1] == pytest.approx(1.0)
    assert kept.carried.tolist() == [0.0, 0.0, 1.0]
    assert kept.value[2] == pytest.approx(2.0, abs=1e-4)


def test_the_first_frame_s_plane_is_the_map_s() -> None:
    kept = AttitudeFilter()
    kept.measure(AttitudeMeasurement(np.zeros(3), INCLINOMETER + 0.01))
    assert not kept.fresh.any()


@pytest.mark.parametrize("known", [[0, 2], [1, 2], [2], [0, 1, 2]])
def test_what_is_measured_adds_its_information(known: list[int]) -> None:
    """P'^-1 = P^-1 + H' R^-1 H, where H picks what was measured and R has its deviations."""
    root = np.random.default_rng(7).normal(size=(3, 3))
    sigma, value = np.array([0.1, 0.5, 2.0]), np.full(3, np.nan)
    value[known] = np.array([0.3, -0.2, 1.0])[known]
    kept = AttitudeFilter(covariance=root @ root.T)
    information = np.linalg.inv(kept.covariance)
    information[known, known] += 1 / sigma[known] ** 2
    kept.measure(AttitudeMeasurement(value, sigma))
    np.testing.assert_allclose(kept.covariance, np.linalg.inv(information), atol=1e-12)
    vector = np.zeros(3)
    vector[known] = value[known] / sigma[known] ** 2
    np.testing.assert_allclose(kept.value, np.linalg.solve(information, vector), atol=1e-12)


def two_frames(shared_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Return sigmas and carried shares of a body that stands still, measured well, then badly."""
    levelling = AttitudeEstimator(shared_rad=shared_rad)
    still = RigidMotion(np.eye(4), 1e-8 * np.eye(6), 9)
    for k, sigma in enumerate((0.01, 0.03)):
        measured = AttitudeMeasurement(np.zeros(3), np.array([sigma, sigma, 0.01]))
        levelling.add(still if k else None, measured)
    return levelling.attitude.sigma, levelling.attitude.carried


def test_what_all_measurements_err_by_alike_is_carried_whole() -> None:
    """The shared error adds its variance to every element of the frames' covariance."""
    shared_rad = 0.02
    (own, carried), (sigma, found) = two_frames(0.0), two_frames(shared_rad)
    together = np.array([[1.0, carried[1, 0]], [carried[1, 0], 0.0]]) * own[0, 0] ** 2
    together[1, 1] = own[1, 0] ** 2
    together += shared_rad**2
    np.testing.assert_allclose(sigma[:, 0] ** 2, np.diag(together), rtol=1e-12)
    assert found[1, 0] == pytest.approx(together[0, 1] / together[0, 0])
    assert carried[1, 0] < found[1, 0] < 1
    np.testing.assert_array_equal(found[:, 1], carried[:, 1])


def test_the_share_of_a_tilt_that_is_carried_is_the_mean_of_both_angles() -> None:
    """Roll is measured anew and carries nothing; pitch is not measured and carries all."""
    levelling = AttitudeEstimator()
    levelling.add(None, AttitudeMeasurement(np.zeros(3), np.full(3, 0.01)))
    still = RigidMotion(np.eye(4), 1e-12 * np.eye(6), 9)
    roll_alone = AttitudeMeasurement(np.array([0.0, np.nan, np.nan]), np.array([1e-6, 1.0, 1.0]))
    levelling.add(still, roll_alone)
    np.testing.assert_allclose(levelling.attitude.carried[1], [0.5, 1.0], atol=1e-6)
