"""Tests of `mapfusion.team.adoption`."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from mapfusion.align.correspondences import match
from mapfusion.fastslam.filter import PriorMap
from mapfusion.fusion.fusers import AlignedPair, FusedMap
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, transform_points
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.smooth import Smoothed
from mapfusion.team.adoption import (
    ADOPTED,
    TimedMap,
    corrected_path,
    drift_of_map,
    fit_drift,
    prior_of,
)
from tests.mapfusion.team.teams_of_points import NORTH, drive, merging, smoothed_of

EXACT = 1e-9  # smoothness that bends nothing


def interpolated(knots: np.ndarray, drift: Float, frame: np.ndarray) -> Float:
    """Return drift (n, 3, R) in frames, linear between knots, one number after the other."""
    found = np.empty((len(frame), *drift.shape[1:]))
    for i, r in np.ndindex(*drift.shape[1:]):
        found[:, i, r] = np.interp(frame, knots, drift[:, i, r])
    return found


def moved_by(drift: Float, position_m: Float) -> Float:
    """Return the displacements (n, 2, R) by small motions (n, 3, R) of the plane."""
    x, y = position_m[:, 0, None], position_m[:, 1, None]
    return np.stack([drift[:, 0] - y * drift[:, 2], drift[:, 1] + x * drift[:, 2]], axis=1)


class Points(NamedTuple):
    """Points with frames in two segments, and their displacements."""

    position_m: Float
    frame: np.ndarray
    segments: list[np.ndarray]
    drift: Float
    displaced_m: Float


def points(n: int = 300, n_cases: int = 4) -> Points:
    rng = np.random.default_rng(1)
    segments = [np.array([-61, -40, -20, -1]), np.array([0, 15, 30])]
    knots = np.concatenate(segments)
    frame = np.concatenate([rng.integers(-61, 0, n // 2), rng.integers(0, 31, n - n // 2)])
    position_m = rng.uniform(-8, 8, (n, 3))
    drift = rng.normal(0, [[0.05], [0.05], [0.01]], (len(knots), 3, n_cases))
    displaced_m = moved_by(interpolated(knots, drift, frame), position_m)
    return Points(position_m, frame, segments, drift, displaced_m)


def test_drift_that_is_linear_between_knots_is_found() -> None:
    given = points()
    found = fit_drift(given.position_m, given.frame, given.displaced_m, given.segments, EXACT)
    np.testing.assert_allclose(found, given.drift, atol=1e-8)


@pytest.mark.parametrize("smoothness", [EXACT, 100.0])
def test_a_motion_of_all_points_is_added_to_the_drift(smoothness: float) -> None:
    """Only changes of the drift cost: the same motion of all points costs nothing."""
    given, motion = points(), np.array([0.3, -0.2, 0.05])[:, None]
    common = moved_by(np.tile(motion, (300, 1, 4)), given.position_m)
    before, after = (
        fit_drift(given.position_m, given.frame, displaced, given.segments, smoothness)
        for displaced in (given.displaced_m, given.displaced_m + common)
    )
    np.testing.assert_allclose(after - before, np.broadcast_to(motion, before.shape), atol=1e-8)


def test_smoothness_binds_knots_of_one_segment_alone() -> None:
    """Each segment is moved by a motion of its own; no smoothness draws them together."""
    given = points()
    own = np.where(given.frame < 0, 0.2, -0.1)[:, None, None] * np.ones((1, 3, 1))
    displaced_m = moved_by(own, given.position_m)
    found = fit_drift(given.position_m, given.frame, displaced_m, given.segments, 1e6)
    np.testing.assert_allclose(found[:4], 0.2, atol=1e-6)
    np.testing.assert_allclose(found[4:], -0.1, atol=1e-6)


def two_segments(n: int, pure: bool) -> tuple[JointCovariance, Float, np.ndarray]:
    """Return a map of two robots, whose shared errors are drift or anything."""
    rng = np.random.default_rng(2)
    frame, position_m = rng.integers(-80, 60, n), rng.uniform(-8, 8, (n, 3))
    common_m = rng.normal(0, 0.05, (n, 6, 3))
    if pure:  # each robot's drift grows evenly
        time = np.where(frame < 0, frame / 80 + 1, frame / 60)[:, None, None]
        start, slope = (rng.normal(0, [[0.05], [0.05], [0.01]], (2, 3, 6)) for _ in range(2))
        robot = (frame >= 0).astype(int)
        moved = moved_by(start[robot] + time * slope[robot], position_m)
        common_m = np.concatenate([moved, np.zeros((n, 1, 6))], axis=1).transpose(0, 2, 1)
    root = rng.normal(0, 0.02, (n, 3, 3))
    return JointCovariance(root @ root.transpose(0, 2, 1), common_m), position_m, frame


SEGMENTS = [(-80, -1), (0, 59)]


def test_shared_errors_that_are_drift_keep_the_joint_covariance() -> None:
    joint, position_m, frame = two_segments(200, pure=True)
    drift = drift_of_map(joint, position_m, frame, SEGMENTS)
    knots = np.append(drift.knots, 59)
    n = len(knots)
    mean = np.array([np.interp(frame, knots, each) for each in np.eye(n)]).T  # (N, K)
    jacobian = moved_by(np.tile(np.eye(3), (200, 1, 1)), position_m)  # (N, 2, 3)
    stacked = np.einsum("nij,nk->nikj", jacobian, mean).reshape(400, 3 * n)
    found = stacked @ drift.covariance @ stacked.T
    own_m2 = joint.own_m2 + drift.remainder_m2
    expected = joint.dense_m2().reshape(200, 3, 200, 3)[:, :2, :, :2].reshape(400, 400)
    each = np.arange(200)
    found.reshape(200, 2, 200, 2)[each, :, each, :] += own_m2[:, :2, :2]
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    assert np.linalg.norm(drift.remainder_m) < 0.01 * np.linalg.norm(joint.common_m)


def test_displacements_are_drift_plus_a_remainder_that_is_orthogonal_to_it() -> None:
    """The trace of the covariance is kept on average, if not for each point.

    The covariance of a point lacks the products of its drift and its remainder.
    """
    joint, position_m, frame = two_segments(400, pure=False)
    drift = drift_of_map(joint, position_m, frame, SEGMENTS)
    at = interpolated(np.append(drift.knots, 59), drift.by_shared, frame)
    by_drift = np.zeros_like(joint.common_m)
    by_drift[:, :, :2] = moved_by(at, position_m).transpose(0, 2, 1)
    np.testing.assert_allclose(by_drift + drift.remainder_m, joint.common_m, atol=1e-12)
    products = np.sum(by_drift * drift.remainder_m)
    assert abs(products) < 1e-3 * np.sum(by_drift**2)
    stated_m2 = joint.own_m2 + drift.remainder_m2 + by_drift.transpose(0, 2, 1) @ by_drift
    mean_trace = np.trace(stated_m2.mean(axis=0))
    assert mean_trace == pytest.approx(np.trace(joint.marginal_m2.mean(axis=0)), rel=1e-3)


def ahead(path: Float, rng: np.random.Generator, frame: np.ndarray) -> Float:
    """Return points (n, 2) that are seen in frames (n,)."""
    return path[frame, :2] + rng.uniform(-4, 4, (len(frame), 2))


def path_of(n: int) -> Float:
    path = np.zeros((n, 3))
    for k in range(1, n):
        path[k] = compose(path[k - 1], [0.3, 0, 0.06])
    return path


def test_a_path_moves_with_all_landmarks() -> None:
    rng, path, motion = np.random.default_rng(0), path_of(50), np.array([0.3, -0.2, 0.02])
    frame = np.repeat(np.arange(50), 4)
    before_m = ahead(path, rng, frame)
    after_m = transform_points(motion, before_m)
    found = corrected_path(path, frame, before_m, after_m)
    # the motion is linearised: half the square of 0.02 rad, 11 m away
    np.testing.assert_allclose(found, compose(motion, path), atol=0.5 * 0.02**2 * 11)


def test_a_path_moves_where_its_landmarks_moved() -> None:
    """The landmarks of the first half stay, those of the second half move by 0.1 m."""
    rng, path = np.random.default_rng(0), path_of(100)
    frame = np.repeat(np.arange(100), 20)
    before_m = ahead(path, rng, frame)
    after_m = before_m + np.where(frame[:, None] < 50, 0.0, [0.1, 0.0])
    moved = corrected_path(path, frame, before_m, after_m) - path
    assert np.abs(moved[:30]).max() < 0.01
    np.testing.assert_allclose(moved[70:, :2], np.tile([0.1, 0.0], (30, 1)), atol=0.01)


def test_frames_with_few_landmarks_are_corrected_like_those_beside_them() -> None:
    """One landmark of 30 blind frames moved by 1 m, those of the other frames by about 0.1 m."""
    rng, path = np.random.default_rng(0), path_of(70)
    frame = np.concatenate([np.repeat(np.r_[:20, 50:70], 10), [35]])
    before_m = ahead(path, rng, frame)
    after_m = before_m + rng.normal([0.1, 0.0], 0.02, before_m.shape)
    after_m[-1] = before_m[-1] + [1.0, 0.0]
    moved = corrected_path(path, frame, before_m, after_m) - path
    np.testing.assert_allclose(moved[:, :2], np.tile([0.1, 0.0], (70, 1)), atol=0.05)
    assert np.abs(moved[:, 2]).max() < 0.02


class Adoption(NamedTuple):
    """Map and path that a robot goes on with, and the maps and the log of which they were made."""

    prior: PriorMap
    fused: FusedMap
    maps: list[TimedMap]
    smoothed: Smoothed
    log: RobotLog


@cache
def adoption(offset_m2: float = 0.0) -> Adoption:
    """Return what a robot adopts of two others; the maps of all fit each other."""
    starts = {"north": NORTH, "south": (4.0, 3.0, 2.5), "west": (-4.0, 2.0, -2.6)}
    drives = [drive(0, name, start, 35 + 5 * k) for k, (name, start) in enumerate(starts.items())]
    smoothed, maps = zip(*(smoothed_of(each.log) for each in drives), strict=True)
    pairs = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        both = maps[a].landmarks, maps[b].landmarks
        offered, rng = match(*both, merging().matching), np.random.default_rng(0)
        registered = merging().registration.register(*both, offered, rng)
        assert registered.verdict.accepted, (a, b)
        pairs.append(AlignedPair(a, b, registered.applied, offered))
    fused = merge([each.landmarks for each in maps], pairs).fused[0]
    assert fused.members.tolist() == [0, 1, 2]
    prior = prior_of(fused, maps, smoothed[0], drives[0].log, offset_m2)
    return Adoption(prior, fused, list(maps), smoothed[0], drives[0].log)


def test_own_landmarks_keep_their_numbers_and_frames() -> None:
    prior, fused, maps, *_ = adoption()
    row = fused.parents[:, 0]
    own = row != ABSENT
    assert 0 < own.sum() < len(own)
    np.testing.assert_array_equal(prior.source[own], maps[0].landmarks.source_observation[row[own]])
    np.testing.assert_array_equal(prior.last_frame[own], maps[0].last_frame[row[own]])
    assert len(np.unique(prior.source)) == len(prior.source)
    assert np.all(prior.source[~own] >= ADOPTED)
    assert np.all(prior.source[own] < ADOPTED)


def test_frames_of_others_come_before_those_of_the_robot() -> None:
    """South has 40 frames, -40 to -1; west has 45 frames, -85 to -41."""
    prior, fused, maps, *_ = adoption()
    for k, (first, last) in {1: (-40, -1), 2: (-85, -41)}.items():
        row = fused.parents[:, k]
        alone = np.flatnonzero((row != ABSENT) & (np.sum(fused.parents != ABSENT, axis=1) == 1))
        assert len(alone) > 1
        found = prior.last_frame[alone]
        assert found.min() >= first
        assert found.max() <= last
        np.testing.assert_array_equal(found - first, maps[k].last_frame[row[alone]])
    assert {-85, -41, -40, -1, 0} < set(prior.knots.tolist())
    assert np.all(np.diff(prior.knots) > 0)
    assert prior.knots[-1] < len(prior.path) - 1


def test_the_first_pose_and_the_associations_stay() -> None:
    prior, _, _, smoothed, _ = adoption()
    np.testing.assert_array_equal(prior.path[0], smoothed.estimate.path[0])
    np.testing.assert_array_equal(prior.associations, smoothed.landmark)
    assert np.abs(prior.path - smoothed.estimate.path)[1:].max() > 1e-4
    assert len(prior.frame_starts) == len(prior.path) + 1


def test_drift_and_independent_errors_make_up_the_covariance_of_the_fused_map() -> None:
    prior, fused, *_ = adoption()
    knots = np.append(prior.knots, len(prior.path) - 1)
    n, n_knots = len(prior.source), len(knots)
    weight = np.array([np.interp(prior.last_frame, knots, each) for each in np.eye(n_knots)]).T
    jacobian = moved_by(np.tile(np.eye(3), (n, 1, 1)), prior.landmarks.position_m)
    slope = np.einsum("nij,nk->nikj", jacobian, weight).reshape(n, 2, 3 * n_knots)
    by_drift = slope @ prior.drift_covariance @ slope.transpose(0, 2, 1)
    stated = prior.landmarks.covariance_m2[:, :2, :2] + by_drift
    share = np.trace(stated, axis1=1, axis2=2) / np.trace(
        fused.landmarks.covariance_m2[:, :2, :2], axis1=1, axis2=2
    )
    assert np.mean(share) == pytest.approx(1.0, abs=0.03)
    assert share.min() > 0.7
    assert share.max() < 1.6
    assert np.linalg.eigvalsh(prior.drift_covariance).min() > -1e-12
    assert prior.landmarks.joint is None


def test_the_offset_of_a_track_is_added_to_each_landmark() -> None:
    more = adoption(0.01).prior.landmarks.covariance_m2 - adoption().prior.landmarks.covariance_m2
    np.testing.assert_allclose(more, np.broadcast_to(0.01 * np.eye(3), more.shape), atol=1e-12)


def test_shared_errors_that_are_no_drift_become_independent() -> None:
    """Each landmark is displaced at random, so that no motion of the plane explains it."""
    given = adoption()
    assert given.fused.landmarks.joint is not None
    own_m2 = given.fused.landmarks.joint.own_m2
    common_m = np.random.default_rng(2).normal(0, 0.1, (len(own_m2), 4, 3))
    landmarks = replace(given.fused.landmarks, joint=JointCovariance(own_m2, common_m))
    fused = replace(given.fused, landmarks=landmarks)
    prior = prior_of(fused, given.maps, given.smoothed, given.log, 0.0)
    added_m2 = prior.landmarks.covariance_m2 - own_m2
    expected_m2 = np.swapaxes(common_m, 1, 2) @ common_m
    found, wanted = (np.trace(each, axis1=1, axis2=2).sum() for each in (added_m2, expected_m2))
    assert 0.6 < found / wanted <= 1.0  # drift explains a part by chance
