"""Comparison of the filter with a slow reference that copies whole particles."""

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam
from mapfusion.fastslam.resampling import MEMORY
from mapfusion.geometry.se2 import between
from tests.mapfusion.fastslam.copying_filter import CopyingFilter
from tests.mapfusion.fastslam.landmark_worlds import drive, nothing, observe, parameters


def assert_same(slam: FastSlam, result, twin: CopyingFilter, planar: bool) -> None:
    np.testing.assert_allclose(np.exp(result.log_weights), twin.weights, rtol=1e-6, atol=1e-12)
    # the twin differentiates numerically
    tolerance = 1e-7 if slam.parameters.proposal == "informed" else 0
    np.testing.assert_allclose(result.cloud, twin.cloud, rtol=0, atol=tolerance)
    landmarks, expected = slam.best_map(min_count=1), twin.best_landmarks()
    n = 2 if planar else 3
    assert len(landmarks) == result.n_landmarks == len(expected)
    assert landmarks.source_observation.tolist() == [m.source for m in expected]
    assert landmarks.count.tolist() == [m.count for m in expected]
    np.testing.assert_allclose(slam.best_path(), twin.best.path, rtol=0, atol=tolerance)
    assert slam.best_associations().tolist() == twin.best.associations
    if not expected:
        return
    np.testing.assert_allclose(
        landmarks.position_m[:, :n], [m.mean for m in expected], rtol=1e-9, atol=1e-9 + tolerance
    )
    np.testing.assert_allclose(
        landmarks.covariance_m2[:, :n, :n],
        [m.covariance for m in expected],
        rtol=1e-9,
        atol=1e-9 + tolerance,
    )
    np.testing.assert_array_equal(landmarks.descriptor, [m.descriptor for m in expected])
    np.testing.assert_array_equal(landmarks.label, [m.label for m in expected])


@pytest.mark.parametrize("association", ["descriptor", "label", "gate"])
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("resample_fraction", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_equals_the_filter_that_copies(association, planar, resample_fraction, proposal):
    # A tight gate makes particles disagree about what they see.
    world = drive(7, planar=planar, n_landmarks=8, n_frames=20, per_frame=4)
    settings = parameters(
        n_particles=8,
        proposal=proposal,
        association=association,
        planar=planar,
        resample_fraction=resample_fraction,
        gate_probability=0.9,
        descriptor_threshold=0.6,
        noise_floor_m=0.005,
    )
    slam = FastSlam(settings, np.random.default_rng(5))
    twin = CopyingFilter(settings, np.random.default_rng(5))
    n_resampled, n_sizes = 0, set()
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        result = slam.step(odometry, frame)
        twin.step(odometry, frame)
        assert_same(slam, result, twin, planar)
        n_resampled += result.resampled
        n_sizes.update(len(p.landmarks) for p in twin.particles)
    assert n_resampled == {0.0: 0, 1.0: len(world.frames)}.get(resample_fraction, n_resampled)
    if association != "label":
        assert max(n_sizes) > len(world.landmarks), "no particle ever started a second landmark"


def test_equals_the_filter_that_copies_longer_than_the_genealogy_remembers():
    # A landmark seen at the start, then not for several rounds of refreshing, then again.
    world = drive(3, n_landmarks=4, per_frame=4, n_frames=2)
    settings = parameters(n_particles=4, association="label", resample_fraction=1.0)
    slam = FastSlam(settings, np.random.default_rng(1))
    twin = CopyingFilter(settings, np.random.default_rng(1))
    pose = world.path[-1]
    rng = np.random.default_rng(2)
    for odometry, frame in zip(world.odometry, world.frames, strict=True):
        slam.step(odometry, frame)
        twin.step(odometry, frame)
    for _ in range(3 * MEMORY + 17):
        slam.step(np.zeros(3), nothing())
        twin.step(np.zeros(3), nothing())
    assert slam.n_rows == 4, "nothing told the particles apart"
    frame = observe(pose, world.landmarks, world.descriptor, np.arange(4), rng)
    result = slam.step(np.zeros(3), frame)
    twin.step(np.zeros(3), frame)
    assert_same(slam, result, twin, planar=False)


def test_equals_the_filter_that_copies_when_all_descend_from_one_particle():
    """Two landmarks are out of view while the other two decide the resampling."""
    world = drive(3, n_landmarks=4, per_frame=4, n_frames=2)
    settings = parameters(n_particles=4, association="label", resample_fraction=1.0)
    slam = FastSlam(settings, np.random.default_rng(1))
    twin = CopyingFilter(settings, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    views = [np.arange(4), np.arange(4), *[np.array([2, 3])] * MEMORY, np.arange(4)]
    pose, n_rows = world.path[0], []
    for frame, view in enumerate(views):
        odometry = between(pose, world.path[frame % 2])
        pose = world.path[frame % 2]
        seen = observe(pose, world.landmarks[view], world.descriptor[view], view, rng)
        result = slam.step(odometry, seen)
        twin.step(odometry, seen)
        n_rows.append(slam.n_rows)
    assert n_rows[1] == 4
    assert n_rows[-2] == 2 < n_rows[-1], "those out of view were kept once, and came back"
    assert_same(slam, result, twin, planar=False)
