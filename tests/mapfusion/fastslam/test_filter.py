"""Tests of `mapfusion.fastslam.filter`."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam, FastSlamParameters, PriorMap
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, inverse, rotation_about_z, transform_points, wrap
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import Observations
from tests.mapfusion.fastslam.landmark_worlds import (
    EXACT_MOTION,
    World,
    drive,
    nothing,
    observe,
    parameters,
    unit,
)

ONE_LANDMARK = Observations(
    np.array([[4.0, 0.5, 0.3]]), 1e-4 * np.eye(3)[None], np.eye(1, 64, dtype=np.float32)
)


def test_with_exact_odometry_the_map_is_the_least_squares_solution():
    world = drive(11, odometry_sigma=(0, 0, 0))
    settings = parameters(motion=EXACT_MOTION, association="label", gate_probability=1 - 1e-12)
    slam = FastSlam(settings, np.random.default_rng(0))
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        slam.step(odometry, frame)
    landmarks = slam.best_map(min_count=1)
    assert landmarks.label is not None
    for row, label in enumerate(landmarks.label):
        information, vector, count = np.zeros((3, 3)), np.zeros(3), 0
        for pose, frame, seen in zip(world.path, world.frames, world.seen, strict=True):
            for k in np.flatnonzero(seen == label):
                turn = rotation_about_z(pose[2])
                weight = turn @ np.linalg.inv(frame.covariance_m2[k]) @ turn.T
                information += weight
                vector += weight @ transform_points(pose, frame.position_m[[k]])[0]
                count += 1
        covariance = np.linalg.inv(information)
        assert landmarks.count[row] == count
        np.testing.assert_allclose(landmarks.position_m[row], covariance @ vector, atol=1e-9)
        np.testing.assert_allclose(landmarks.covariance_m2[row], covariance, atol=1e-12)


def test_a_landmark_seen_a_thousand_times_keeps_a_covariance_of_one_thousandth():
    turn = rotation_about_z(0.4)
    R = turn @ np.diag([0.5, 1e-4, 1e-6]) @ turn.T  # a far point: long along the ray
    frame = Observations(
        np.array([[8.0, 1.0, 0.5]]), 0.5 * (R + R.T)[None], label=np.array([1], dtype=np.int32)
    )
    settings = parameters(n_particles=1, motion=EXACT_MOTION, association="label")
    slam = FastSlam(settings, np.random.default_rng(0))
    for _ in range(1000):
        slam.step(np.zeros(3), frame)
    landmarks = slam.best_map(min_count=1)
    assert np.linalg.eigvalsh(landmarks.covariance_m2[0]).min() > 0
    np.testing.assert_allclose(landmarks.covariance_m2[0], R / 1000, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(landmarks.position_m, frame.position_m, atol=1e-12)


def test_weights_of_two_poses_follow_from_the_density_of_the_difference():
    """One landmark, seen twice: the weight is N(difference; 0, 2 R), in closed form."""
    settings = parameters(
        n_particles=50, association="label", resample_fraction=0.0, gate_probability=1 - 1e-12
    )
    slam = FastSlam(settings, np.random.default_rng(4))
    R = np.diag([0.04, 0.01, 0.02])
    point = np.array([[2.0, 0.5, 0.3]])
    frame = Observations(point, R[None], label=np.array([7], dtype=np.int32))
    slam.step(np.zeros(3), frame)
    motion = np.array([0.5, 0.0, 0.2])
    moved = replace(frame, position_m=transform_points(inverse(motion), point))
    result = slam.step(motion, moved)
    log_density = []
    for pose in result.cloud:
        turn = rotation_about_z(pose[2])
        Z = R + turn @ R @ turn.T
        difference = transform_points(pose, moved.position_m)[0] - point[0]
        log_density.append(
            -0.5 * difference @ np.linalg.inv(Z) @ difference
            - 0.5 * np.log(np.linalg.det(2 * np.pi * Z))
        )
    weights = np.exp(log_density - np.max(log_density))
    np.testing.assert_allclose(np.exp(result.log_weights), weights / weights.sum(), rtol=1e-9)
    assert result.log_evidence == pytest.approx(np.log(np.mean(np.exp(log_density))), abs=1e-9)
    assert np.ptp(result.log_weights) > 1


@pytest.mark.parametrize("association", ["descriptor", "gate", "label"])
@pytest.mark.parametrize("planar", [False, True])
def test_millimetres_give_the_same_weights(association, planar):
    world = drive(5, planar=planar)
    scale = 1000.0
    length = np.array([scale, scale, 1.0])
    small = parameters(association=association, planar=planar, gate_probability=0.9)
    large = replace(
        small,
        # Variances are per length: sigma^2 in mm^2 per mm is 1e3 sigma^2, not 1e6.
        motion=MotionNoise(
            small.motion.translation_m_per_sqrt_m * np.sqrt(scale),
            small.motion.rotation_rad_per_sqrt_m / np.sqrt(scale),
            small.motion.rotation_rad_per_sqrt_rad,
            0,
            0,
            lateral_m_per_sqrt_m=small.motion.lateral_m_per_sqrt_m * np.sqrt(scale),
            lateral_slip_m_per_rad=scale * small.motion.lateral_slip_m_per_rad,
        ),
    )
    in_m = FastSlam(small, np.random.default_rng(9))
    in_mm = FastSlam(large, np.random.default_rng(9))
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        frame_mm = replace(
            frame, position_m=scale * frame.position_m, covariance_m2=scale**2 * frame.covariance_m2
        )
        expected = in_m.step(odometry, frame)
        result = in_mm.step(odometry * length, frame_mm)
        np.testing.assert_allclose(result.log_weights, expected.log_weights, atol=1e-6)
        assert result.n_landmarks == expected.n_landmarks
    np.testing.assert_allclose(
        in_mm.best_map(min_count=1).position_m,
        scale * in_m.best_map(min_count=1).position_m,
        rtol=1e-6,
        atol=1e-6,
    )


def test_order_of_observations_does_not_matter():
    world = drive(13)
    rng = np.random.default_rng(0)
    settings = parameters()
    slam, shuffled = (FastSlam(settings, np.random.default_rng(2)) for _ in range(2))
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        expected = slam.step(odometry, frame)
        result = shuffled.step(odometry, frame[rng.permutation(len(frame))])
        np.testing.assert_allclose(result.log_weights, expected.log_weights, atol=1e-9)
    first, second = slam.best_map(min_count=1).position_m, shuffled.best_map(min_count=1).position_m
    np.testing.assert_allclose(
        first[np.argsort(first[:, 0])], second[np.argsort(second[:, 0])], atol=1e-9
    )


def test_localises_better_than_odometry():
    errors, odometry_errors = [], []
    for seed in range(4):
        sigma = np.array([0.02, 0.01, 0.03])
        world = drive(seed, n_frames=60, per_frame=6, odometry_sigma=tuple(sigma))
        motion = MotionNoise(
            0.02 / np.sqrt(0.15),
            0,
            0.03 / np.sqrt(0.1),
            0,
            0,
            lateral_m_per_sqrt_m=0.02 / np.sqrt(0.15),
            lateral_slip_m_per_rad=0,
        )
        settings = parameters(n_particles=100, motion=motion)
        slam = FastSlam(settings, np.random.default_rng(seed))
        reckoned, path = np.zeros(3), []
        for odometry, frame in zip(world.odometry, world.frames, strict=True):
            slam.step(odometry, frame)
            reckoned = compose(reckoned, odometry)
            path.append(reckoned)
        errors.append(slam.best_path()[:, :2] - world.path[:, :2])
        odometry_errors.append(np.array(path)[:, :2] - world.path[:, :2])
    assert np.std(errors) < 0.5 * np.std(odometry_errors)


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_no_particle_is_drawn_before_there_is_a_landmark(proposal):
    # Nothing that is seen later can tell which of the draws was right: each would turn the map.
    slam = FastSlam(parameters(proposal=proposal), np.random.default_rng(0))
    motion, pose = np.array([0.1, 0.02, 0.3]), np.zeros(3)
    for frame in (nothing(), nothing(), ONE_LANDMARK):
        pose = compose(pose, motion)
        np.testing.assert_allclose(slam.step(motion, frame).cloud - pose, 0.0, atol=1e-12)
    cloud = slam.step(motion, nothing()).cloud
    assert len(np.unique(cloud[:, 2])) == len(cloud)


def test_headings_wrap():
    slam = FastSlam(parameters(n_particles=3), np.random.default_rng(0))
    slam.step(np.zeros(3), ONE_LANDMARK)
    for _ in range(40):
        result = slam.step(np.array([0.0, 0.0, 0.5]), nothing())
        assert np.all(np.abs(result.cloud[:, 2]) <= np.pi)
    assert abs(wrap(result.best_pose[2] - 20.0)) < 1.5


def test_a_robot_that_sees_nothing_dead_reckons():
    slam = FastSlam(parameters(motion=EXACT_MOTION), np.random.default_rng(0))
    pose = np.zeros(3)
    for _ in range(10):
        motion = np.array([0.1, 0.02, 0.3])
        pose = compose(pose, motion)
        result = slam.step(motion, nothing())
    np.testing.assert_allclose(result.best_pose, pose, atol=1e-12)
    assert result.n_landmarks == 0
    assert not result.resampled
    assert len(slam.best_map(min_count=1)) == 0
    assert slam.best_path().shape == (10, 3)
    assert slam.best_associations().shape == (0,)


def test_same_seed_same_bits():
    world = drive(17)
    maps = []
    for _ in range(2):
        slam = FastSlam(parameters(), np.random.default_rng(6))
        for odometry, frame in zip(world.odometry, world.frames, strict=True):
            slam.step(odometry, frame)
        maps.append(slam.best_map(min_count=1))
    assert maps[0].position_m.tobytes() == maps[1].position_m.tobytes()
    assert maps[0].covariance_m2.tobytes() == maps[1].covariance_m2.tobytes()


def test_history_changes_no_estimate():
    world = drive(19)
    kept = FastSlam(parameters(), np.random.default_rng(6))
    plain = FastSlam(parameters(), np.random.default_rng(6), keep_history=False)
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        expected = kept.step(odometry, frame)
        result = plain.step(odometry, frame)
        np.testing.assert_array_equal(result.log_weights, expected.log_weights)
    with pytest.raises(ValueError, match="keep_history"):
        plain.best_path()


def test_landmarks_that_no_particle_has_any_more_are_forgotten():
    """A narrow gate makes particles disagree: about 1000 landmarks are started, one map has 220."""
    rng = np.random.default_rng(0)
    settings = parameters(resample_fraction=1.0, gate_probability=0.5, association="gate")
    slam = FastSlam(settings, rng, keep_history=False)
    for _ in range(600):
        position = rng.uniform(-0.5, 0.5, (3, 3))
        frame = Observations(position, np.tile(0.05 * np.eye(3), (3, 1, 1)))
        result = slam.step(np.array([0.3, 0.0, 0.1]), frame)
    assert result.n_landmarks > 150
    assert slam.n_slots < 1.5 * result.n_landmarks


def test_a_long_drive_keeps_each_particles_estimates_of_what_was_seen_lately_alone():
    """One new landmark a frame, each seen in four frames; lines meet within some 300 frames."""
    rng = np.random.default_rng(0)
    motion = MotionNoise(0.02, 0, 0.01, 0, 0, lateral_m_per_sqrt_m=0.02, lateral_slip_m_per_rad=0)
    slam = FastSlam(parameters(n_particles=5, motion=motion, association="gate"), rng)
    ahead, covariance = np.array([1.0, 2.0, 3.0, 4.0]), np.tile(1e-4 * np.eye(3), (4, 1, 1))
    n_rows = []
    for frame in range(1500):
        position = np.stack([ahead, 0.3 * (-1) ** (frame + ahead), np.full(4, 0.5)], -1)
        position += rng.normal(0, 0.01, position.shape)
        slam.step(np.array([1.0, 0, 0]), Observations(position, covariance))
        n_rows.append(slam.n_rows)
    assert slam.n_slots > 1400
    assert max(n_rows[750:]) <= 1.3 * max(n_rows[300:450]) < 300


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"n_particles": 0}, "n_particles"),
        ({"gate_probability": 1.0}, "gate_probability"),
        ({"resample_fraction": 1.5}, "resample_fraction"),
        ({"descriptor_threshold": 0.0}, "descriptor_threshold"),
        ({"noise_floor_m": -1.0}, "noise_floor_m"),
        ({"association": "smell"}, "smell"),
    ],
)
def test_wrong_parameters_are_named(changes, name):
    with pytest.raises(ValueError, match=name):
        FastSlamParameters(**changes)


def test_best_map_leaves_out_what_was_seen_too_rarely():
    world = drive(23)
    slam = FastSlam(parameters(), np.random.default_rng(6))
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        slam.step(odometry, frame)
    everything = slam.best_map(min_count=1)
    least = int(np.median(everything.count)) + 1
    enough = everything.count >= least
    assert 0 < enough.sum() < len(enough)
    fewer = slam.best_map(min_count=least)
    np.testing.assert_array_equal(fewer.position_m, everything.position_m[enough])


def test_a_refused_frame_changes_nothing():
    world = drive(29)
    slam, undisturbed = (FastSlam(parameters(), np.random.default_rng(2)) for _ in range(2))
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        if len(frame):
            with pytest.raises(ValueError, match="descriptor"):
                slam.step(odometry, replace(frame, descriptor=None))
        result, expected = slam.step(odometry, frame), undisturbed.step(odometry, frame)
        np.testing.assert_array_equal(result.cloud, expected.cloud)


def test_wrong_arguments_are_named():
    slam = FastSlam(parameters(), np.random.default_rng(0))
    frame = drive(1).frames[0]
    with pytest.raises(ValueError, match="odometry"):
        slam.step(np.zeros(2), frame)
    with pytest.raises(ValueError, match="odometry"):
        slam.step(np.array([np.nan, 0, 0]), frame)
    with pytest.raises(ValueError, match="descriptor"):
        slam.step(np.zeros(3), replace(frame, descriptor=None))
    with pytest.raises(ValueError, match="covariance_m2"):
        slam.step(np.zeros(3), replace(frame, covariance_m2=0 * frame.covariance_m2))
    by_label = FastSlam(parameters(association="label"), np.random.default_rng(0))
    with pytest.raises(ValueError, match="label"):
        by_label.step(np.zeros(3), replace(frame, label=None))
    with pytest.raises(ValueError, match="label"):
        by_label.step(np.zeros(3), replace(frame, label=np.full(len(frame), -1, dtype=np.int32)))


def test_a_landmark_looks_as_in_the_observation_it_came_from():
    """Descriptors are not averaged: later observations leave them as they are."""
    world = drive(3, n_frames=20)
    slam = FastSlam(parameters(association="label"), np.random.default_rng(0))
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        slam.step(odometry, frame)
    found = slam.best_map(min_count=2)
    look, label = (
        np.concatenate([getattr(frame, name) for frame in world.frames])
        for name in ("descriptor", "label")
    )
    names, first = np.unique(label, return_index=True)
    assert found.descriptor is not None
    assert found.label is not None
    np.testing.assert_array_equal(
        found.source_observation, first[np.searchsorted(names, found.label)]
    )
    np.testing.assert_array_equal(found.descriptor, look[found.source_observation])
    assert found.count.min() >= 2


# Quantiles by probability: 2 and 3 degrees of freedom.
TABLE = {0.95: (5.991, 7.815), 0.99: (9.210, 11.345), 0.9999: (18.421, 21.108)}


@pytest.mark.parametrize("probability", TABLE)
@pytest.mark.parametrize("planar", [True, False, None])
def test_gate_is_the_quantile_of_the_table(probability: float, planar: bool | None) -> None:
    found = FastSlamParameters(gate_probability=probability, planar=planar).gate
    assert found == pytest.approx(TABLE[probability][0 if planar else 1], abs=1e-3)


@pytest.mark.parametrize("planar", [True, False])
def test_the_filter_keeps_to_it(planar: bool) -> None:
    """A landmark and an observation of 0.1 m each differ by 0.14 m, times the bound's root."""
    sigma_m, bound = 0.1, TABLE[0.99][0 if planar else 1]
    settings = parameters(n_particles=2, motion=EXACT_MOTION, gate_probability=0.99, planar=planar)
    descriptor = unit(np.ones((1, 64))).astype(np.float32)
    for share, n_expected in ((0.999, 1), (1.001, 2)):
        slam = FastSlam(settings, np.random.default_rng(0))
        for apart_m in (0.0, share * np.sqrt(2 * bound) * sigma_m):
            point = np.array([[5.0, 2.0 + apart_m, 0.0]])
            slam.step(np.zeros(3), Observations(point, sigma_m**2 * np.eye(3)[None], descriptor))
        assert len(slam.best_map(min_count=1)) == n_expected


FIRST_ADOPTED = 2**30  # number of the first landmark that another robot mapped
N_BEFORE = 20  # frames before a restart


def prior_of(world: World, drift_m: float = 0.0) -> PriorMap:
    """Return the truth with small errors as a map; every second landmark is another robot's.

    The other robot's drift has a standard deviation of `drift_m` and of as much in radians, that of
    the robot has none.
    """
    rng, n = np.random.default_rng(1), len(world.landmarks)
    own = np.arange(n) % 2 == 0
    label = np.arange(n, dtype=np.int32)
    root = 0.01 * rng.standard_normal((n, 3, 3))
    covariance_m2 = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    seen = np.concatenate(world.seen[:N_BEFORE])
    source = np.where(own, [np.flatnonzero(seen == k)[0] for k in label], FIRST_ADOPTED + label)
    last = [max(f for f in range(N_BEFORE) if k in world.seen[f]) for k in label]
    landmarks = LandmarkMap(
        world.landmarks + 0.001 * rng.standard_normal((n, 3)),
        covariance_m2,
        rng.integers(3, 9, n).astype(np.int32),
        source,
        world.descriptor.astype(np.float32),
        label,
    )
    starts = np.cumsum([0, *map(len, world.frames[:N_BEFORE])])
    drift = np.zeros((5, 3, 5, 3))
    for k in (0, 1):
        drift[k, :, 0] = drift[k, :, 1] = drift_m**2 * np.eye(3)
    return PriorMap(
        landmarks,
        source,
        np.where(own, last, -10 - label),
        world.path[:N_BEFORE] + rng.normal(0, 1e-3, (N_BEFORE, 3)),
        np.where(rng.uniform(size=len(seen)) < 0.1, -1, source[seen]),
        starts,
        np.array([-30, -1, 0, 10]),
        drift.reshape(15, 15),
    )


def restarted(world: World, drift_m: float = 0.0, **settings) -> tuple[FastSlam, PriorMap]:
    """Return a filter of the first frames that goes on in another map."""
    slam = FastSlam(parameters(**settings), np.random.default_rng(3))
    for odometry, frame in zip(world.odometry[:N_BEFORE], world.frames, strict=False):
        slam.step(odometry, frame)
    prior = prior_of(world, drift_m)
    slam.restart(prior)
    return slam, prior


def assert_is(found: LandmarkMap, expected: LandmarkMap, source: np.ndarray) -> None:
    order = np.argsort(source)
    np.testing.assert_array_equal(found.source_observation, source[order])
    for name in ("position_m", "covariance_m2", "count", "label", "descriptor"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name)[order])


@pytest.mark.parametrize("association", ["descriptor", "gate", "label"])
def test_a_restarted_filter_has_the_given_map_path_and_associations(association):
    slam, prior = restarted(drive(3), association=association, resample_fraction=0.0)
    assert_is(slam.best_map(min_count=1), prior.landmarks, prior.source)
    assert slam.n_slots == 12
    np.testing.assert_array_equal(slam.best_path(), prior.path)
    np.testing.assert_array_equal(slam.best_associations(), prior.associations)
    last = prior.associations[prior.frame_starts[-2] :]
    np.testing.assert_array_equal(slam.last_associations(), last)
    motion = np.array([0.2, 0.0, 0.1])
    result = slam.step(motion, nothing(), np.zeros(3))
    np.testing.assert_array_equal(result.cloud, np.tile(compose(prior.path[-1], motion), (15, 1)))
    np.testing.assert_array_equal(result.log_weights, np.full(15, -np.log(15)))


@pytest.mark.parametrize("association", ["descriptor", "gate", "label"])
def test_after_a_restart_observations_go_to_the_given_landmarks(association):
    world = drive(3)
    slam, prior = restarted(world, association=association, proposal="informed")
    rows, n_before = np.arange(6), len(prior.associations)
    pose = compose(world.path[N_BEFORE - 1], [0.15, 0, 0.1])
    rng = np.random.default_rng(8)
    frame = observe(pose, world.landmarks[rows], world.descriptor[rows], rows, rng)
    result = slam.step(np.array([0.15, 0, 0.1]), frame)
    assert result.n_landmarks == slam.n_slots == 12
    np.testing.assert_array_equal(slam.last_associations(), prior.source[:6])
    np.testing.assert_array_equal(slam.best_associations()[n_before:], prior.source[:6])
    found = slam.best_map(min_count=1)
    assert found.label is not None
    found = found[np.argsort(found.label)]
    np.testing.assert_array_equal(found.count, prior.landmarks.count + (np.arange(12) < 6))
    np.testing.assert_array_equal(found.position_m[6:], prior.landmarks.position_m[6:])


def test_a_label_that_is_not_in_the_given_map_starts_a_landmark():
    world = drive(3)
    slam = FastSlam(parameters(association="label"), np.random.default_rng(3))
    for odometry, frame in zip(world.odometry[:N_BEFORE], world.frames, strict=False):
        slam.step(odometry, frame)
    prior = prior_of(world)
    rest = np.arange(1, 12)
    source, last_frame = prior.source[rest], prior.last_frame[rest]
    landmarks = prior.landmarks[rest]
    slam.restart(replace(prior, landmarks=landmarks, source=source, last_frame=last_frame))
    assert len(slam.best_map(min_count=1)) == 11
    n, rows = len(prior.associations), np.arange(2)
    rng = np.random.default_rng(8)
    pose = world.path[N_BEFORE - 1]
    frame = observe(pose, world.landmarks[rows], world.descriptor[rows], rows, rng)
    slam.step(np.zeros(3), frame)
    np.testing.assert_array_equal(slam.last_associations(), [n, prior.source[1]])
    assert slam.best_map(min_count=1).source_observation.tolist().count(n) == 1


def test_path_and_associations_go_on_for_long_after_a_restart():
    """More steps than the interval of the prunings, 256, with many resamplings."""
    world = drive(3, n_frames=N_BEFORE + 700)
    slam, prior = restarted(world, n_particles=6, association="label")
    clouds, n_resampled = [], 0
    for odometry, frame in zip(world.odometry[N_BEFORE:], world.frames[N_BEFORE:], strict=True):
        result = slam.step(odometry, frame)
        clouds.append(result.cloud.copy())
        n_resampled += result.resampled
    assert n_resampled > 20
    path, associations = slam.best_path(), slam.best_associations()
    np.testing.assert_array_equal(path[:N_BEFORE], prior.path)
    np.testing.assert_array_equal(associations[: len(prior.associations)], prior.associations)
    assert len(path) == len(world.path)
    for pose, cloud in zip(path[N_BEFORE:], clouds, strict=True):
        assert np.any(np.all(pose == cloud, axis=1))
    seen = np.concatenate(world.seen[N_BEFORE:])
    later = associations[len(prior.associations) :]
    assert np.mean(later == prior.source[seen]) > 0.95
    assert np.abs(path - world.path)[:, :2].max() < 0.3


def by_drift(position_m: Float, covariance: Float) -> Float:
    """Return the covariances (n, 3, 3) of points by one drift (3, 3) of the plane."""
    jacobian = np.array([[[1, 0, -y], [0, 1, x], [0, 0, 0]] for x, y, _ in position_m])
    return jacobian @ covariance @ jacobian.transpose(0, 2, 1)


def test_covariances_with_drift_are_those_of_landmark_and_drift():
    """The other robot drifts by 0.05; a frame between two knots has half of its drift."""
    slam, prior = restarted(drive(3), drift_m=0.05)
    found, plain = slam.best_map(1, with_drift=True), slam.best_map(1)
    theirs = found.source_observation >= FIRST_ADOPTED
    drift = by_drift(found.position_m, 0.05**2 * np.eye(3)) * theirs[:, None, None]
    np.testing.assert_allclose(found.covariance_m2, plain.covariance_m2 + drift, atol=1e-12)
    np.testing.assert_array_equal(found.position_m, plain.position_m)
    assert theirs.sum() == 6

    middle = replace(prior, last_frame=np.full(12, -1), knots=np.array([-2, 0, 5, 10]))
    covariance = np.zeros((5, 3, 5, 3))
    covariance[0, :, 0] = np.diag([0.04, 0.01, 0.0])
    covariance[1, :, 1] = np.diag([0.0, 0.03, 0.02])
    slam.restart(replace(middle, drift_covariance=covariance.reshape(15, 15)))
    found = slam.best_map(1, with_drift=True)
    drift = by_drift(found.position_m, np.diag([0.01, 0.01, 0.005]))
    np.testing.assert_allclose(found.covariance_m2, plain.covariance_m2 + drift, atol=1e-12)


def test_a_loop_to_the_other_robot_makes_all_its_landmarks_certain():
    """Three of its six landmarks are seen; all were displaced by the same motion."""
    world, motion = drive(3), np.array([0.06, -0.05, 0.03])
    settings = {"proposal": "informed", "association": "label", "close_loops": True}
    slam, prior = restarted(world, drift_m=0.05, **settings)
    theirs = prior.source >= FIRST_ADOPTED
    position_m = prior.landmarks.position_m.copy()
    position_m[theirs] = transform_points(motion, position_m[theirs])
    displaced = replace(prior.landmarks, position_m=position_m)
    slam.restart(replace(prior, landmarks=displaced))
    before = slam.best_map(1, with_drift=True)
    rng, step = np.random.default_rng(8), np.array([0.15, 0, 0.1])
    pose, rows = world.path[N_BEFORE - 1], np.array([0, 1, 2, 3, 4, 5, 6])
    for _ in range(3):
        pose = compose(pose, step)
        looks = world.descriptor[rows]
        slam.step(step, observe(pose, world.landmarks[rows], looks, rows, rng, sigma_m=0.005))
    after = slam.best_map(1, with_drift=True)
    assert after.label is not None
    unseen = np.isin(after.label, [7, 9, 11])
    np.testing.assert_array_equal(after.count[unseen], before.count[unseen])
    own_m2 = slam.best_map(1).covariance_m2
    trace = [np.trace(each.covariance_m2 - own_m2, axis1=1, axis2=2) for each in (before, after)]
    assert np.all(trace[1][unseen] < 0.2 * trace[0][unseen])
    off_m = [
        np.linalg.norm((each.position_m - world.landmarks[each.label])[unseen, :2], axis=1)
        for each in (before, after)
    ]
    assert np.all(off_m[1] < 0.4 * off_m[0])
    assert off_m[0].min() > 0.04


def test_covariances_with_drift_count_the_offset_of_a_track_once():
    """A landmark is its point plus an offset; after its track the filter has added two offsets."""
    stray_m, R = 0.2, 1e-4 * np.eye(3)
    settings = parameters(n_particles=2, motion=EXACT_MOTION, association="label", stray_m=stray_m)
    slam, point = FastSlam(settings, np.random.default_rng(0)), np.array([[2.0, 0, 0], [3, 1, 0]])
    label, track = np.arange(2, dtype=np.int32), np.array([5, 6], dtype=np.int32)
    both = Observations(point, np.tile(R, (2, 1, 1)), label=label, track=track)
    slam.step(np.zeros(3), both)
    slam.step(np.zeros(3), both[:1])  # the second track has ended
    plain, found = slam.best_map(1), slam.best_map(1, with_drift=True)
    variance = np.array([0.5e-4, 1e-4])
    expected = variance[:, None, None] * np.eye(3)
    np.testing.assert_allclose(
        plain.covariance_m2, expected + [[[0]], [[2 * stray_m**2]]] * np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(found.covariance_m2, expected + stray_m**2 * np.eye(3), atol=1e-12)


def test_without_a_history_there_are_no_last_associations():
    slam = FastSlam(parameters(), np.random.default_rng(0), keep_history=False)
    slam.step(np.zeros(3), ONE_LANDMARK)
    with pytest.raises(ValueError, match="keep_history"):
        slam.last_associations()
