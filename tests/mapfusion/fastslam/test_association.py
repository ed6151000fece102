"""Tests of `mapfusion.fastslam.association`."""

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam
from mapfusion.robot_log import Observations
from tests.mapfusion.fastslam.landmark_worlds import EXACT_MOTION, parameters, unit


@pytest.mark.parametrize("association", ["descriptor", "gate"])
def test_one_landmark_takes_one_observation_a_frame(association):
    point = np.array([[1.0, 0.0, 0.5], [1.0, 0.01, 0.5]])
    descriptor = unit(np.ones((2, 64))).astype(np.float32)
    both = Observations(point, np.tile(1e-2 * np.eye(3), (2, 1, 1)), descriptor)
    settings = parameters(motion=EXACT_MOTION, association=association)
    slam = FastSlam(settings, np.random.default_rng(0))
    slam.step(np.zeros(3), both[:1])
    slam.step(np.zeros(3), both)
    assert slam.best_map(min_count=1).count.tolist() == [2, 1]
    assert slam.best_associations().tolist() == [0, 0, 2]


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1)])
@pytest.mark.parametrize("sigmas_m", [(0.3, 0.01), (0.01, 0.3)])
def test_the_gate_reaches_as_far_as_the_uncertainties_do(direction, sigmas_m):
    """Just inside and just outside the gate, with the landmark or the observation uncertain."""
    descriptor = unit(np.ones((1, 64))).astype(np.float32)
    settings = parameters(n_particles=2, motion=EXACT_MOTION)
    reach_m = np.sqrt(settings.gate * (sigmas_m[0] ** 2 + sigmas_m[1] ** 2))
    for share, n_expected in ((0.999, 1), (1.001, 2)):
        slam = FastSlam(settings, np.random.default_rng(0))
        point = np.array([[5.0, 2.0, 1.0]])
        for sigma_m in sigmas_m:
            slam.step(np.zeros(3), Observations(point, sigma_m**2 * np.eye(3)[None], descriptor))
            point = point + share * reach_m * np.array([*direction, 0])
        assert len(slam.best_map(min_count=1)) == n_expected


def test_descriptors_farther_apart_than_the_threshold_are_different_landmarks():
    first, other = np.eye(64)[:2]
    settings = parameters(n_particles=2, motion=EXACT_MOTION, descriptor_threshold=0.5)
    for apart, n_expected in ((0.499, 1), (0.501, 2)):
        angle = 2 * np.arcsin(apart / 2)
        slam = FastSlam(settings, np.random.default_rng(0))
        for vector in (first, np.cos(angle) * first + np.sin(angle) * other):
            descriptor = vector[None].astype(np.float32)
            frame = Observations(np.ones((1, 3)), 0.01 * np.eye(3)[None], descriptor)
            slam.step(np.zeros(3), frame)
        assert len(slam.best_map(min_count=1)) == n_expected


def test_the_nearest_descriptor_wins_over_the_nearest_place():
    descriptor = np.eye(64)[:2]
    R = np.tile(0.01 * np.eye(3), (2, 1, 1))
    settings = parameters(n_particles=2, motion=EXACT_MOTION, descriptor_threshold=1.5)
    slam = FastSlam(settings, np.random.default_rng(0))
    places = np.array([[1.0, 0.0, 0.0], [1.2, 0.0, 0.0]])
    slam.step(np.zeros(3), Observations(places, R, descriptor.astype(np.float32)))
    # Seen where the first stands, with the looks of the second.
    slam.step(np.zeros(3), Observations(places[:1], R[:1], descriptor[1:].astype(np.float32)))
    assert slam.best_associations().tolist() == [0, 1, 1]


@pytest.mark.parametrize("association", ["descriptor", "gate"])
def test_a_landmark_that_creeps_is_followed(association):
    """Each observation lies inside the gate, on the same side: the sum of 2 / n has no bound."""
    sigma_m, n_frames = 0.01, 300
    descriptor = unit(np.ones((1, 64))).astype(np.float32)
    settings = parameters(n_particles=1, motion=EXACT_MOTION, association=association)
    slam = FastSlam(settings, np.random.default_rng(0))
    expected_x = 1.0
    for n in range(n_frames):
        point = np.array([[expected_x + 2 * sigma_m * (n > 0), 0.0, 0.0]])
        slam.step(np.zeros(3), Observations(point, sigma_m**2 * np.eye(3)[None], descriptor))
        expected_x += (point[0, 0] - expected_x) / (n + 1)
    landmarks = slam.best_map(min_count=1)
    assert landmarks.count.tolist() == [n_frames]
    np.testing.assert_allclose(landmarks.position_m, [[expected_x, 0, 0]])


def test_a_new_label_twice_in_a_frame_starts_one_landmark():
    point = np.array([[1.0, 0.0, 0.0], [1.1, 0.0, 0.0]])
    label = np.array([4, 4], dtype=np.int32)
    slam = FastSlam(parameters(association="label"), np.random.default_rng(0))
    slam.step(np.zeros(3), Observations(point, np.tile(np.eye(3), (2, 1, 1)), label=label))
    assert slam.best_map(min_count=1).position_m.tolist() == [[1.0, 0.0, 0.0]]
    assert slam.best_associations().tolist() == [0, -1]


def test_a_known_label_outside_the_gate_is_dropped():
    label = np.array([3], dtype=np.int32)
    R = 1e-4 * np.eye(3)[None]
    slam = FastSlam(parameters(motion=EXACT_MOTION, association="label"), np.random.default_rng(0))
    slam.step(np.zeros(3), Observations(np.array([[1.0, 0, 0]]), R, label=label))
    slam.step(np.zeros(3), Observations(np.array([[1.5, 0, 0]]), R, label=label))
    landmarks = slam.best_map(min_count=1)
    assert landmarks.position_m.tolist() == [[1.0, 0.0, 0.0]]
    assert slam.best_associations().tolist() == [0, -1]
