"""Tests of `mapfusion.fastslam.proposal`: the posterior is the same as with eq. 3."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam, FastSlamParameters
from mapfusion.fastslam.landmark_arrays import LANES, Slots
from mapfusion.fastslam.measurement import MapObservations, observations_in_map
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.particles import ParticleMaps
from mapfusion.fastslam.proposal import Proposal, informed_disturbance, with_odometry_noise
from mapfusion.geometry.se2 import compose, transform_points
from mapfusion.robot_log import Observations
from tests.mapfusion.fastslam.landmark_worlds import drive, observe, unit

MOTION = MotionNoise(0.1, 0.05, 0.1, 0, 0, lateral_m_per_sqrt_m=0.1, lateral_slip_m_per_rad=0.03)
STEP = np.array([0.3, 0.0, 0.2])
POINTS = np.array([[1.5, 0.8, 0.3], [2.0, -0.7, 0.6], [2.5, 0.2, 1.0], [1.2, -0.2, 0.1]])
DESCRIPTOR = unit(np.random.default_rng(9).standard_normal((4, 64)))


def settings_of(proposal: Proposal) -> FastSlamParameters:
    """Return settings of 20 particles with a proposal."""
    return FastSlamParameters(n_particles=20, motion=MOTION, proposal=proposal)


def after_two_frames(proposal: str, n: int, seed: int, sigma_m: float = 0.03, **changes):
    """Landmarks seen from the start, then again after a step."""
    settings = replace(
        settings_of(Proposal(proposal)), n_particles=n, resample_fraction=0.0, **changes
    )
    slam = FastSlam(settings, np.random.default_rng(seed))
    rng = np.random.default_rng(1)
    true_step = compose(STEP, [0.02, -0.01, 0.03])
    for odometry, pose in ((np.zeros(3), np.zeros(3)), (STEP, true_step)):
        frame = observe(pose, POINTS, DESCRIPTOR, np.arange(4), rng, sigma_m=sigma_m)
        result = slam.step(odometry, frame)
    return result


def moments(result) -> tuple[np.ndarray, np.ndarray]:
    weights = np.exp(result.log_weights)
    mean = weights @ result.cloud
    centred = result.cloud - mean
    return mean, (weights[:, None] * centred).T @ centred


@pytest.mark.parametrize("association", ["descriptor", "label"])
def test_stands_for_the_same_posterior_and_evidence_as_eq_3(association) -> None:
    printed = after_two_frames("motion", 4000, 2, association=association)
    informed = after_two_frames("informed", 4000, 3, association=association)
    mean, covariance = moments(printed)
    mean_informed, covariance_informed = moments(informed)
    sigma = np.sqrt(np.diag(covariance))
    # Monte Carlo error of the printed form: sigma / sqrt(effective sample size)
    error = sigma / np.sqrt(printed.effective_sample_size)
    assert printed.effective_sample_size > 50
    assert np.all(np.abs(mean_informed - mean) < 4 * error)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance_informed)), sigma, rtol=0.3)
    assert informed.log_evidence == pytest.approx(
        printed.log_evidence, abs=4 / np.sqrt(printed.effective_sample_size)
    )


def test_keeps_the_particles_that_sharp_observations_leave_few_of() -> None:
    printed = after_two_frames("motion", 200, 4, sigma_m=0.003)
    informed = after_two_frames("informed", 200, 4, sigma_m=0.003)
    assert printed.effective_sample_size < 5
    assert informed.effective_sample_size > 150


def test_a_translation_alone_is_the_kalman_filter_s_answer() -> None:
    """With the heading known all is linear: the closed form holds exactly."""
    sigma, slots, seen, pose = np.array([0.1, 0.05, 0.0]), one_landmark(), one_sighting(), START
    eta, _ = draw(slots, seen, pose, sigma, np.zeros((1, 3)))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    prior = turn @ np.diag(sigma[:2] ** 2) @ turn.T
    Z = full(slots.by_particle.covariance_m2[0, 0]) + full(seen.covariance_m2[0, 0])
    H = np.eye(3)[:, :2]
    K = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + Z)
    shift = K @ (slots.by_particle.mean_m[0, 0] - seen.point_m[0, 0])
    np.testing.assert_allclose(turn @ (sigma[:2] * eta[0, :2]), shift, atol=1e-12)
    posterior = (np.eye(2) - K @ H) @ prior
    spread = np.stack(
        [draw(slots, seen, pose, sigma, row[None])[0][0] - eta[0] for row in np.eye(3)], -1
    )
    cloud = turn @ np.diag(sigma[:2]) @ spread[:2]
    np.testing.assert_allclose(cloud @ cloud.T, posterior, atol=1e-12)


def test_ratio_of_the_densities_averages_to_one() -> None:
    """The mean of p / q over q is the integral of p."""
    rng = np.random.default_rng(5)
    sigma, slots, seen = np.array([0.1, 0.05, 0.05]), one_landmark(0.15), one_sighting()
    log_ratio = [
        draw(slots, seen, START, sigma, rng.standard_normal((1, 3)))[1][0] for _ in range(20_000)
    ]
    ratio = np.exp(log_ratio)
    assert ratio.mean() == pytest.approx(1, abs=4 * ratio.std() / np.sqrt(len(ratio)))
    assert ratio.std() > 0.1, "nothing was learned, so nothing is tested"


def test_a_false_pair_does_not_take_the_pose_along() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform((1, -2, 0), (4, 2, 1), (20, 3))
    pose = np.array([0.02, -0.01, 0.03])
    slots = slots_of(transform_points(pose, points), 1e-4)
    slots.by_particle.mean_m[7, 0, :2] += [0.5, -0.5]
    seen = observations_in_map(
        np.zeros((1, 3)), points, np.tile(1e-4 * np.eye(3), (20, 1, 1)), False
    )
    chosen = np.arange(20)[:, None]
    at, given = np.zeros((1, 3)), (0.0, np.full(3, 0.05), 21.0, False)
    eta, _ = informed_disturbance(slots.by_particle, slots.row, chosen, seen, at, *given, at)
    np.testing.assert_allclose(0.05 * eta[0], pose, atol=0.003)


def many_particles(n: int, n_points: int) -> tuple[Slots, MapObservations, np.ndarray, np.ndarray]:
    """Return landmarks, observations, poses and associations, some without a match."""
    rng = np.random.default_rng(8)
    points = rng.uniform((1, -2, 0), (4, 2, 1), (n_points, 3))
    pose = rng.normal(0, 0.03, (n, 3))
    covariance = np.tile(1e-3 * np.diag([4.0, 1.0, 2.0]), (n_points, 1, 1))
    seen = observations_in_map(pose, points, covariance, False)
    slots = slots_of(points, 1e-4, n)
    slots.by_particle.mean_m[:n_points] += rng.normal(0, 0.02, (n_points, n, 3))
    chosen = np.where(rng.uniform(size=(n_points, n)) < 0.7, np.arange(n_points)[:, None], -1)
    return slots, seen, pose, chosen


@pytest.mark.parametrize("n", [1, LANES - 1, LANES, LANES + 1, 2 * LANES + 5])
def test_a_particle_is_drawn_as_if_it_were_alone(n: int) -> None:
    """However many are taken together: by steps that are written down once more here."""
    slots, seen, pose, chosen = many_particles(n, 9)
    sigma, gate, turn = np.array([0.1, 0.05, 0.08]), 21.0, 0.1
    normal = np.random.default_rng(9).standard_normal((n, 3))
    found, ratio = informed_disturbance(
        slots.by_particle, slots.row, chosen, seen, pose, turn, sigma, gate, False, normal
    )
    for m in range(n):
        eta, before = np.zeros(3), pose[m, 2] - turn
        axes = np.array([[np.cos(before), -np.sin(before)], [np.sin(before), np.cos(before)]])
        for _ in range(3):
            A, pull = np.eye(3), -eta
            angle = sigma[2] * eta[2]
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            for k in np.flatnonzero(chosen[:, m] >= 0):
                W = full(slots.by_particle.covariance_m2[k, m]) + full(seen.covariance_m2[k, m])
                W = np.linalg.inv(W)
                arm = seen.point_m[k, m, :2] - pose[m, :2]
                off = seen.point_m[k, m] - slots.by_particle.mean_m[k, m]
                off[:2] += axes @ (sigma[:2] * eta[:2]) + R @ arm - arm
                J = np.zeros((3, 3))
                J[:2, :2] = axes * sigma[:2]
                J[:2, 2] = sigma[2] * np.array([-(R @ arm)[1], (R @ arm)[0]])
                weight = 1 / (1 + off @ W @ off / gate)
                A += weight * J.T @ W @ J
                pull -= weight * J.T @ W @ off
            eta = eta + np.linalg.solve(A, pull)
        root = np.linalg.cholesky(A)
        eta = eta + np.linalg.solve(root.T, normal[m])
        np.testing.assert_allclose(found[m], eta, atol=1e-9)
        told = 0.5 * (normal[m] @ normal[m] - eta @ eta) - np.log(np.diag(root).prod())
        assert ratio[m] == pytest.approx(told, abs=1e-8)


def test_widened_covariances_are_those_of_disturbed_sightings() -> None:
    rng = np.random.default_rng(7)
    odometry, sigma = np.array([0.2, 0.0, 0.5]), np.array([0.02, 0.05, 0.03])
    before, p_robot = np.array([[1.0, 2.0, 0.7]]), np.array([[3.0, 1.0, 0.5]])
    predicted = compose(before, odometry)
    R = np.diag([0.01, 0.02, 0.03]) ** 2
    seen = observations_in_map(predicted, p_robot, R[None], False)
    wide = with_odometry_noise(seen, predicted, odometry, sigma)
    poses = compose(before, odometry + sigma * rng.standard_normal((200_000, 3)))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = p_robot[0, :2]
    spread = np.cov(poses[:, 0] + cos * x - sin * y, poses[:, 1] + sin * x + cos * y)
    added = full(wide.covariance_m2[0, 0]) - full(seen.covariance_m2[0, 0])
    np.testing.assert_allclose(added[:2, :2], spread, rtol=0.02, atol=2e-5)
    assert not added[2].any()


def test_standing_still_and_blind_frames_are_as_with_eq_3() -> None:
    world = drive(3, n_frames=4)
    nothing = Observations(np.empty((0, 3)), np.empty((0, 3, 3)))
    clouds = []
    for proposal in Proposal:
        slam = FastSlam(settings_of(proposal), np.random.default_rng(0))
        for odometry, frame in (
            (np.zeros(3), world.frames[0]),
            (STEP, nothing),
            (np.zeros(3), world.frames[1]),
        ):
            cloud = slam.step(odometry, frame).cloud
        clouds.append(cloud)
    np.testing.assert_array_equal(*clouds)


START = np.array([[0.5, 0.2, 0.4]])  # a predicted pose, reached without turning


def slots_of(mean_m: np.ndarray, variance_m2: float, n_particles: int = 1) -> Slots:
    """Landmarks (S, 3), the same in all particles, equally certain in all directions."""
    slots, n = ParticleMaps(n_particles, 21.0).slots, len(mean_m)
    slots.row[:n] = np.arange(n)
    slots.by_particle.mean_m[:n] = mean_m[:, None]
    slots.by_particle.covariance_m2[:n] = np.array([1, 0, 0, 1, 0, 1]) * variance_m2
    slots.by_particle.count[:n] = 1
    return slots


def one_landmark(sigma_m: float = 0.04) -> Slots:
    return slots_of(np.array([[2.0, 1.5, 0.5]]), sigma_m**2)


def one_sighting() -> MapObservations:
    R = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, -0.5], [0.0, -0.5, 1.0]]) * 0.01**2
    return observations_in_map(START, np.array([[1.9, 0.55, 0.51]]), R[None], False)


def draw(slots, seen, pose, sigma, standard_normal):
    """With a gate so wide that no pair is doubted."""
    chosen = np.zeros((1, 1), dtype=np.int64)
    return informed_disturbance(
        slots.by_particle, slots.row, chosen, seen, pose, 0.0, sigma, 1e12, False, standard_normal
    )


def full(upper: np.ndarray) -> np.ndarray:
    return upper[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3)
