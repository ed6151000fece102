"""Tests of `mapfusion.fastslam.mapping`."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.errors import InputError
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlam, FastSlamParameters
from mapfusion.fastslam.mapping import association_for, build_map, run_log
from mapfusion.robot_log import Observations, RobotLog
from tests.mapfusion.fastslam.landmark_worlds import drive

SETTINGS = FastSlamParameters(n_particles=10)


def log_of(planar: bool) -> RobotLog:
    world = drive(2, n_frames=12, planar=planar)
    lengths = [len(frame) for frame in world.frames]
    names = ("position_m", "covariance_m2", "descriptor")
    return RobotLog(
        robot="R1",
        planar=planar,
        time_s=0.2 * np.arange(12),
        odometry=np.array(world.odometry),
        iteration=np.repeat(np.arange(12), lengths),
        observations=Observations(
            *(np.concatenate([getattr(frame, name) for frame in world.frames]) for name in names)
        ),
    )


def test_a_log_is_its_frames_one_after_the_other():
    log = log_of(planar=False)
    slam = FastSlam(SETTINGS, np.random.default_rng(1))
    frames = run_log(log, SETTINGS, np.random.default_rng(1), snapshots=[5, 11], min_count=1)
    for frame in frames:
        rows = log.iteration == frame.iteration
        result = slam.step(log.odometry[frame.iteration], log.observations[rows])
        np.testing.assert_array_equal(frame.result.cloud, result.cloud)
        assert (frame.landmarks is not None) == (frame.iteration in (5, 11))
        if frame.landmarks is None:
            assert frame.path is None
            assert frame.associations is None
            continue
        assert frame.landmarks.viewing is not None
        np.testing.assert_array_equal(frame.path, slam.best_path())
        np.testing.assert_array_equal(frame.associations, slam.best_associations())
    assert frame.iteration == 11
    bare = run_log(log, SETTINGS, np.random.default_rng(1), [11], 1, viewing=False)
    *_, last = bare
    assert last.landmarks is not None
    assert last.landmarks.viewing is None
    np.testing.assert_array_equal(last.landmarks.position_m, frame.landmarks.position_m)
    built = build_map(log, SETTINGS, np.random.default_rng(1), min_count=1)
    assert built.name == "R1"
    np.testing.assert_array_equal(built.position_m, slam.best_map(min_count=1).position_m)


@pytest.mark.parametrize("planar", [False, True])
def test_the_log_says_whether_data_are_planar(planar):
    log = log_of(planar)
    assert build_map(log, SETTINGS, np.random.default_rng(0)).planar == planar
    stated = replace(SETTINGS, planar=planar)
    assert build_map(log, stated, np.random.default_rng(0)).planar == planar
    wrong = replace(SETTINGS, planar=not planar)
    with pytest.raises(InputError, match=f"planar: is {not planar}, but the log of R1 holds"):
        build_map(log, wrong, np.random.default_rng(0))


def test_a_log_without_frames_is_refused():
    nothing = Observations(np.empty((0, 3)), np.empty((0, 3, 3)))
    no_rows = np.empty(0, dtype=np.int64)
    log = RobotLog("R1", False, np.empty(0), np.empty((0, 3)), no_rows, nothing)
    with pytest.raises(InputError, match="log R1: holds no frame"):
        build_map(log, SETTINGS, np.random.default_rng(0))


def test_odometry_that_observations_told_and_they_count_half_each() -> None:
    """As motion noise and observations of twice the variance do."""
    log = log_of(planar=False)
    seen = log.observations
    motion = replace(SETTINGS.motion, floor_m=0.01, floor_rad=0.002)
    settings = replace(SETTINGS, motion=motion)
    floor = np.array([0.01, 0.01, 0.002]) ** 2
    sigma = np.array([motion.standard_deviations(step) for step in log.odometry])
    told = np.array([np.diag((own**2 - floor) / 2) for own in sigma])
    sharper = replace(log, observations=replace(seen, covariance_m2=seen.covariance_m2 / 2))
    made = run_log(sharper, settings, np.random.default_rng(1), odometry_covariance=told)
    expected = run_log(log, settings, np.random.default_rng(1))
    for own, other in zip(made, expected, strict=True):
        np.testing.assert_allclose(own.result.cloud, other.result.cloud, atol=1e-9)
        np.testing.assert_allclose(own.result.log_weights, other.result.log_weights, atol=1e-6)
    with pytest.raises(ValueError, match="odometry_covariance: shape"):
        next(iter(run_log(log, SETTINGS, np.random.default_rng(0), odometry_covariance=told[1:])))


@pytest.mark.parametrize(
    ("has", "stated", "expected"),
    [
        ("", "descriptor", "gate"),
        ("label", "descriptor", "label"),
        ("some labels", "descriptor", "gate"),
        ("descriptor", "label", "descriptor"),
        ("label descriptor", "descriptor", "descriptor"),
        ("label", "gate", "gate"),
        ("some labels", "label", "label"),  # refused: the labels of the others are missing
    ],
)
def test_the_log_chooses_an_association_that_it_allows(
    has: str, stated: str, expected: str
) -> None:
    log = log_of(planar=False)
    n = len(log.observations)
    label = np.arange(n, dtype=np.int32) % 5 if "label" in has else None
    if label is not None and "some" in has:
        label[0] = -1
    descriptor = np.ones((n, 64), np.float32) if "descriptor" in has else None
    seen = replace(log.observations, label=label, descriptor=descriptor)
    log = replace(log, observations=seen)
    assert association_for(log, Association(stated)) is Association(expected)
    settings = replace(SETTINGS, association=Association(stated))
    if "some" in has and stated == "label":
        with pytest.raises(InputError, match=r"1 of .* observations have no label"):
            build_map(log, settings, np.random.default_rng(0))
    else:
        allowed = replace(settings, association=Association(expected))
        found, chosen = (
            build_map(log, each, np.random.default_rng(0)) for each in (settings, allowed)
        )
        np.testing.assert_array_equal(found.position_m, chosen.position_m)
