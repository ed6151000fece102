"""Calibration against logs whose constants and noise are known, and against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.errors import InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import Observations, RobotLog
from mapfusion.smoother.elimination import pose_point_blocks
from mapfusion.smoother.noise_estimation import (
    NOISE_PARAMETERS,
    MotionPosterior,
    NoiseStatistics,
    disturbance_variances,
    motion_posterior,
    noise_statistics,
    relative_errors,
    sum_statistics,
    update_noise,
)
from mapfusion.smoother.normal_equations import (
    Estimate,
    disturbance_jacobians,
    initial_landmarks,
    odometry_information,
)
from mapfusion.smoother.odometry_calibration import (
    HALF_TRACK_M,
    Calibration,
    OdometryError,
    calibrate,
    increment_jacobians,
)
from mapfusion.smoother.optimizer import Problem, optimize
from mapfusion.smoother.problem import order_observations
from mapfusion.smoother.smooth import SmootherParameters
from tests.mapfusion.smoother.white_noise_logs import dead_reckoned, white_noise_log

TRUE = np.array([0.01, -0.12, 0.1, -0.04, 0.2])
NOISE = MotionNoise(0.04, 0.05, 0.08, 0, 0, lateral_m_per_sqrt_m=0.04, lateral_slip_m_per_rad=0)
RANGE_M, OBSERVED_M = 6.0, 0.03


def planar_log(rng: np.random.Generator, n_frames: int = 400) -> RobotLog:
    """A robot that wanders among landmarks all around, whose odometry errs as `TRUE` says."""
    point = rng.uniform(-6, 6, (15, 2))
    odometry = np.zeros((n_frames, 3))
    odometry[1:, 0] = rng.choice([0.0, 0.1, 0.2], n_frames - 1)
    odometry[1:, 2] = rng.choice([-0.4, -0.1, 0.0, 0.1, 0.4], n_frames - 1)
    moved = OdometryError.of(TRUE).corrected(odometry)
    path, rows = np.zeros((n_frames, 3)), []
    for k in range(n_frames):
        if k:
            sigma = NOISE.standard_deviations(moved[k])
            path[k] = compose(path[k - 1], moved[k] + sigma * rng.standard_normal(3))
        local = (point - path[k, :2]) @ rotation(path[k, 2])
        for label in rng.permutation(np.flatnonzero(np.hypot(*local.T) < RANGE_M))[:3]:
            rows.append((k, label, *(local[label] + OBSERVED_M * rng.standard_normal(2))))
    obs = np.array(rows)
    position = np.column_stack([obs[:, 2:], np.zeros(len(obs))])
    covariance = np.tile(OBSERVED_M**2 * np.eye(3), (len(obs), 1, 1))
    observations = Observations(position, covariance, None, obs[:, 1].astype(np.int32))
    time_s = np.arange(n_frames, dtype=np.float64)
    return RobotLog("R1", True, time_s, odometry, obs[:, 0].astype(np.int64), observations)


def calibrated(*logs: RobotLog) -> Calibration:
    labels = [log.observations.label for log in logs]
    assert all(label is not None for label in labels)
    return calibrate(logs, labels, [None] * len(logs), SmootherParameters(stray_m=0))  # type: ignore[arg-type]


def test_constants_and_levels_are_found_within_their_errors() -> None:
    """Pooled over robots and seeds: squared errors in sigmas have the mean of a chi-square."""
    z, levels = list[Float](), list[Float]()
    for seed in range(4):
        found = calibrated(*(planar_log(np.random.default_rng([seed, k]), 250) for k in range(2)))
        z += [(each.error.constants - TRUE) / each.standard_errors for each in found.robots]
        true = [getattr(NOISE, name) for name in NOISE_PARAMETERS]
        got = np.array([getattr(found.motion, name) for name in NOISE_PARAMETERS])
        levels.append(np.log(got / true) / found.relative_errors)
        assert all(np.all(each.standard_errors < 0.05) for each in found.robots)
    assert 0.4 < np.mean(np.square(z)) < 1.8  # 40 values: 99.9 %
    assert 0.2 < np.mean(np.square(levels)) < 2.8  # 12 values


def test_a_robot_s_calibration_does_not_change_while_it_stands() -> None:
    """A log that goes on standing still tells the same of its odometry."""
    log = planar_log(np.random.default_rng(3), 120)
    idle = np.zeros((30, 3))
    longer = replace(
        log, time_s=np.arange(150) * 1.0, odometry=np.concatenate([log.odometry, idle])
    )
    a, b = calibrated(log), calibrated(longer)
    for one, other in zip(a.robots, b.robots, strict=True):
        off = np.abs(one.error.constants - other.error.constants) / one.standard_errors
        assert np.all(off < 0.3)


def test_a_correction_undoes_its_error() -> None:
    odometry = np.random.default_rng(0).normal(0, 0.2, (6, 3))
    odometry[:, 2] = 0.0
    given = OdometryError(distance=0.25, bias_rad_per_m=0.5).corrected(odometry)
    np.testing.assert_allclose(given[:, :2], 1.25 * odometry[:, :2])
    np.testing.assert_allclose(given[:, 2], 0.5 * np.hypot(*odometry[:, :2].T))
    turned = np.zeros((3, 3))
    turned[1, 2] = 0.8
    late = OdometryError(turn=-0.25, late_turn=0.25).corrected(turned)
    np.testing.assert_allclose(late[:, 2], [0.0, 0.6, 0.2])


def test_turns_in_place_have_an_error_of_their_own() -> None:
    """All of it on the spot, none from a radius of half a track on, in between what is tighter."""
    radius = np.array([0.0, 0.25, 0.5, 1.0, 4.0]) * HALF_TRACK_M
    for turn in (0.8, -0.8):
        odometry = np.column_stack([radius * abs(turn), np.zeros(5), np.full(5, turn)])
        given = OdometryError(in_place=0.5).corrected(odometry)
        np.testing.assert_allclose(given[:, :2], odometry[:, :2])
        np.testing.assert_allclose(given[:, 2] / turn, [1.5, 1.375, 1.25, 1.0, 1.0])


def spinning_log(rng: np.random.Generator, in_place: float) -> RobotLog:
    """A robot that sees one landmark a frame, and none while it spins: 7 to 10 frames of 20.

    Its wheels count up to 0.9 of 2 pi for a spin of which `in_place` is missing.
    """
    point, n_frames = rng.uniform(-4, 4, (15, 2)), 240
    lap, frame = np.divmod(np.arange(n_frames), 20)
    odometry, spinning = np.zeros((n_frames, 3)), frame >= 10 + lap % 4
    odometry[1:, 0] = np.where(spinning, 0.0, 0.15)[1:]
    odometry[1:, 2] = np.where(spinning, 0.18 * np.pi, rng.choice([-0.3, 0.3], n_frames))[1:]
    moved = OdometryError(in_place=in_place).corrected(odometry)
    path, rows = np.zeros((n_frames, 3)), []
    for k in range(n_frames):
        if k:
            sigma = NOISE.standard_deviations(moved[k])
            path[k] = compose(path[k - 1], moved[k] + sigma * rng.standard_normal(3))
        if not spinning[k]:
            local = (point - path[k, :2]) @ rotation(path[k, 2])
            nearest = np.argmin(np.hypot(*local.T))
            rows.append((k, nearest, *(local[nearest] + OBSERVED_M * rng.standard_normal(2))))
    obs = np.array(rows)
    position = np.column_stack([obs[:, 2:], np.zeros(len(obs))])
    covariance = np.tile(OBSERVED_M**2 * np.eye(3), (len(obs), 1, 1))
    observations = Observations(position, covariance, None, obs[:, 1].astype(np.int32))
    time_s = np.arange(n_frames, dtype=np.float64)
    return RobotLog("R1", True, time_s, odometry, obs[:, 0].astype(np.int64), observations)


@pytest.mark.parametrize(("in_place", "seed"), [(0.4, 0), (-0.4, 2), (-0.5, 0), (-0.5, 1)])
def test_a_robot_that_spins_blind_is_not_taken_for_a_turn_off(in_place: float, seed: int) -> None:
    """A spin and a spin with a turn more look alike, and where steps begin they may end."""
    found = calibrated(spinning_log(np.random.default_rng(seed), in_place)).robots[0]
    assert found.standard_errors[-1] < 0.05
    assert abs(found.error.in_place - in_place) < 4 * found.standard_errors[-1]


@pytest.mark.parametrize(("n_frames", "n_landmarks"), [(30, 12), (15, 60)])
def test_the_posterior_equals_dense_algebra(n_frames: int, n_landmarks: int) -> None:
    """Variances of the disturbances, and the information on the constants, all unknowns at once."""
    log = white_noise_log(np.random.default_rng(2), n_frames, n_landmarks, planar=True).log
    label = log.observations.label
    assert label is not None
    obs = order_observations(log, label, 1, with_offsets=False)
    information = odometry_information(log.odometry, MotionNoise())
    path = dead_reckoned(log)
    start = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    end = optimize(Problem(obs, log.odometry, information, 0.0), start)
    by = increment_jacobians(log.odometry)[1:]
    found = motion_posterior(end, log.odometry, information, by)

    n, (B, K, _) = len(log) - 1, pose_point_blocks(obs, end.equations)
    before, after = disturbance_jacobians(end.estimate.path)
    D = np.zeros((n, 3, n, 3))
    for k in range(n):
        D[k, :, k] = after[k]
        if k:
            D[k, :, k - 1] = before[k]
    D = D.reshape(3 * n, 3 * n)
    H = np.zeros((n, 3, n, 3))
    for k in range(n):
        H[k, :, k] = end.equations.pose_block[k + 1]
        if k:
            H[k, :, k - 1] = end.equations.link[k]
            H[k - 1, :, k] = end.equations.link[k].T
    H = np.block([[H.reshape(3 * n, -1), B], [B.T, K]])
    covariance = D @ np.linalg.inv(H)[: 3 * n, : 3 * n] @ D.T
    assert end.solution.landmarks_first == (n_frames < n_landmarks)
    for variance in (found.variance, disturbance_variances(end)):
        np.testing.assert_allclose(variance.ravel(), np.diag(covariance), rtol=1e-6)
    W, S = information.ravel(), by.reshape(3 * n, -1)
    free = (S.T * W) @ S - (S.T * W) @ covariance @ (W[:, None] * S)
    np.testing.assert_allclose(found.constants_information, free, rtol=1e-6, atol=1e-6)


def test_a_log_that_saw_nothing_is_refused() -> None:
    log = planar_log(np.random.default_rng(0), 20)
    nothing = np.full(len(log.observations), -1)
    with pytest.raises(InputError, match="R1"):
        calibrate([log], [nothing], [dead_reckoned(log)], SmootherParameters())


def test_what_is_told_of_levels_is_the_curvature_of_their_likelihood() -> None:
    """The expected information equals second differences of the expected cost."""
    rng = np.random.default_rng(8)
    odometry = rng.normal(0, [0.2, 0.05, 0.3], (30, 3))
    levels = np.array([getattr(NOISE, name) for name in NOISE_PARAMETERS])

    def variances(logs: Float) -> Float:
        way, walk, turn = np.exp(logs)
        motion = MotionNoise(way, walk, turn, 0, 0, lateral_m_per_sqrt_m=way)
        motion = replace(motion, lateral_slip_m_per_rad=0)
        return np.array([motion.standard_deviations(step) ** 2 for step in odometry[1:]])

    true = variances(np.log(levels))

    def cost(logs: Float) -> float:
        v = variances(logs)
        return float(np.sum(np.log(v) + true / v)) / 2

    step, at = 1e-3 * np.eye(3), np.log(levels)
    expected = [
        [
            (cost(at + h + k) - cost(at + h - k) - cost(at - h + k) + cost(at - h - k)) / 4e-6
            for k in step
        ]
        for h in step
    ]
    obs = MotionPosterior(np.zeros((29, 3)), np.zeros((29, 3)), np.zeros((0, 0)), np.zeros(0))
    found = noise_statistics(obs, odometry, 1 / true, NOISE)
    np.testing.assert_allclose(found.information, expected, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose([found.determined[0], found.determined[1:].sum()], [58, 29])


def test_a_round_multiplies_the_squares_of_levels_by_what_was_found_over_what_is_told() -> None:
    """The lateral level follows the one along the way; a level that nothing tells stays."""
    statistics = NoiseStatistics(np.array([20.0, 2.5, 9.0]), np.array([10.0, 10.0, 1.0]), np.eye(3))
    made = update_noise(NOISE, statistics)
    found = [getattr(made, name) for name in (*NOISE_PARAMETERS, "lateral_m_per_sqrt_m")]
    way = NOISE.translation_m_per_sqrt_m * np.sqrt(2)
    expected = [way, NOISE.rotation_rad_per_sqrt_m / 2, NOISE.rotation_rad_per_sqrt_rad, way]
    assert found == pytest.approx(expected)


def test_two_logs_tell_what_both_tell() -> None:
    each = [NoiseStatistics(np.full(3, n), np.full(3, 2 * n), n * np.eye(3)) for n in (3.0, 5.0)]
    both = sum_statistics(each)
    assert (both.squares.tolist(), both.determined.tolist()) == ([8.0] * 3, [16.0] * 3)
    assert relative_errors(both) == pytest.approx(np.full(3, 1 / 3))  # and 1 was known before
