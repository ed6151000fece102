"""Contradictory logs give findings with the cause; sound logs give none."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.datasets.log_consistency import (
    check_log,
    gate_finding,
    outside_gate,
    truth_finding,
    without_jumps,
)
from mapfusion.datasets.motion_agreement import pose_mistakes
from mapfusion.datasets.relative_motion import (
    composed_spans,
    observed_motions,
    odometry_motions,
    poses_from_increments,
)
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.mapping import Frame, run_log
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, inverse, transform_points
from mapfusion.geometry.se3 import from_planar, from_quaternions
from mapfusion.robot_log import Observations, RobotLog, first_frames
from mapfusion.smoother.smooth import SmootherParameters, smooth
from tests.mapfusion.contradicting_logs import (
    JUMPS,
    LANDMARKS,
    MISTAKES,
    circling_log,
    true_poses,
)

NOISE = MotionNoise()
LABELS = FastSlamParameters(n_particles=50, association=Association.LABEL)


@pytest.fixture(scope="module")
def sound() -> RobotLog:
    return circling_log()


def without_names(log: RobotLog) -> RobotLog:
    """Return the log without labels, so that only positions tell which points are the same."""
    return replace(log, observations=replace(log.observations, label=None))


def filtered(log: RobotLog, covariance: Float | None = None) -> Frame:
    last = len(log) - 1
    *_, end = run_log(log, LABELS, np.random.default_rng(0), [last], 3, covariance, viewing=False)
    return end


def error_m(log: RobotLog, covariance: Float | None = None) -> float:
    """Return the RMS error of all landmarks after the best rigid fit."""
    landmarks = filtered(log, covariance).landmarks
    assert landmarks is not None
    assert landmarks.label is not None
    truth = np.column_stack([LANDMARKS[landmarks.label], np.zeros(len(landmarks))])
    fit = fit_rigid(landmarks.position_m, truth, np.arange(len(truth)))
    off = landmarks.position_m - transform_points(np.array(fit), truth)
    return float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(name: str, labelled: bool, sound: RobotLog) -> None:
    change, words = MISTAKES[name]
    log = replace(sound, odometry=change(sound.odometry))
    found = check_log(log if labelled else without_names(log), NOISE)
    assert [each.kind for each in found.findings] == ["odometry"]
    for word in words:
        assert word in found.findings[0].text
    assert not found.jumps


def test_observations_in_millimetres_are_named(sound: RobotLog) -> None:
    """Covariances are in square millimetres or in square metres."""
    seen = sound.observations
    for share in (1e6, 1.0):
        larger = replace(
            seen, position_m=1000 * seen.position_m, covariance_m2=share * seen.covariance_m2
        )
        (finding,) = check_log(replace(sound, observations=larger), NOISE).findings
        assert finding.kind == "odometry"
        assert "the observed ones millimetres" in finding.text


def test_mirrored_and_swapped_observations_without_labels_are_named(sound: RobotLog) -> None:
    bare = without_names(sound)
    seen = bare.observations
    mistakes = {
        "heading has the other sign": [1, -1, 1] * seen.position_m,
        "y points ahead": seen.position_m[:, [1, 0, 2]],
        "are millimetres": 1000 * seen.position_m,
    }
    for words, position in mistakes.items():
        log = replace(bare, observations=replace(seen, position_m=position))
        (finding,) = check_log(log, NOISE).findings
        assert words in finding.text


def test_odometry_of_another_run_is_told(sound: RobotLog) -> None:
    turns = 0.15 * np.sign(np.sin(np.arange(len(sound)) / 3))
    other = np.column_stack([np.full(len(sound), 0.1), np.zeros(len(sound)), turns])
    (finding,) = check_log(replace(sound, odometry=other), NOISE).findings
    assert "another run's" in finding.text


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.015, 0.03])
def test_sound_logs_are_left_as_they_are(noise: float) -> None:
    """The steps are 0.1 m and 0.05 rad."""
    for seed in range(3):
        log = circling_log(40, noise, seed)
        found = check_log(log, NOISE)
        assert not found.findings
        covariance = np.zeros((len(log), 3, 3))
        assert without_jumps(log, found.jumps, covariance) == (log, covariance)
        assert not check_log(without_names(log), NOISE).findings


def test_robots_that_stand_turn_or_go_straight_are_sound() -> None:
    still, ahead = np.zeros((40, 3)), np.tile([0.1, 0, 0], (40, 1))
    turning = np.tile([0, 0, 0.05], (40, 1))
    for steps in (still, ahead, turning, np.concatenate([still[:20], ahead[:20]])):
        log = circling_log(40, 0.002, poses=poses_from_increments(steps))
        for each in (log, without_names(log)):
            assert not check_log(each, NOISE).findings


@pytest.mark.parametrize("name", JUMPS)
def test_single_jumps_count_for_nothing(name: str, sound: RobotLog) -> None:
    """The map of the corrected log is as accurate as that of a sound log."""
    change, frames = JUMPS[name]
    log = replace(sound, odometry=change(sound.odometry))
    found = check_log(log, NOISE)
    assert tuple(jump.frame for jump in found.jumps) == frames
    assert tuple(finding.frame for finding in found.findings) == frames
    for jump, finding in zip(found.jumps, found.findings, strict=True):
        off = jump.observed - [0.1, 0, 0.05]
        assert off @ np.linalg.solve(jump.covariance, off) < 25
        assert f"frame {jump.frame}: odometry" in finding.text
    assert error_m(*without_jumps(log, found.jumps)) < 0.03
    bare = check_log(without_names(log), NOISE)
    assert tuple(jump.frame for jump in bare.jumps) == frames


def test_a_jump_is_told_in_metres(sound: RobotLog) -> None:
    (finding,) = check_log(replace(sound, odometry=JUMPS["3 m"][0](sound.odometry)), NOISE).findings
    assert "odometry moved 3.00 m, the observations 0." in finding.text


def test_the_filter_takes_one_increment_as_unsure_as_it_is(sound: RobotLog) -> None:
    """NaN stands for the noise of the settings."""
    log = first_frames(sound, 20)
    paths = []
    for variance in (None, float("nan"), 1.0):
        covariance = np.full((20, 3, 3), np.nan) if variance else None
        if covariance is not None and variance is not None:
            covariance[10] = variance * np.eye(3)
        paths.append(filtered(log, covariance).slam.best_path())
    np.testing.assert_array_equal(paths[1], paths[0])
    assert np.abs(paths[2] - paths[0]).max() > 1e-6


def test_encoders_with_a_coarse_resolution_are_sound(sound: RobotLog) -> None:
    """Increments are multiples of 0.25 m and 0.1 rad with correct sums."""
    resolution = np.array([0.25, 0.25, 0.1])
    whole = np.round(np.cumsum(circling_log(100, 0.0).odometry, axis=0) / resolution) * resolution
    log = circling_log(100, 0.0)
    coarse = np.concatenate([np.zeros((1, 3)), np.diff(whole, axis=0)])
    assert not check_log(replace(log, odometry=coarse), NOISE).findings


def test_the_smoother_gives_a_jump_no_weight(sound: RobotLog) -> None:
    log = replace(sound, odometry=JUMPS["3 m"][0](sound.odometry))
    mended, covariance = without_jumps(log, check_log(log, NOISE).jumps)
    own = SmootherParameters(stray_m=0.0, odometry_covariance=covariance)
    assert own.has_own_odometry
    information = own.odometry_information(mended)
    assert information[39].max() < 2  # of 10 m and a radian
    np.testing.assert_array_equal(
        np.delete(information, 39, 0),
        np.delete(SmootherParameters().odometry_information(mended), 39, 0),
    )
    label = mended.observations.label
    assert label is not None
    path = smooth(mended, label, true_poses(len(log)), own).estimate.path
    assert np.abs(path - true_poses(len(log)))[:, :2].max() < 0.05


def test_observations_that_jump_are_no_odometry_s_jump(sound: RobotLog) -> None:
    """Confused barcodes shift the observed robot by metres; the odometry is sound."""
    seen, frame = sound.observations, sound.iteration == 30
    position = seen.position_m.copy()
    position[frame, :2] += [4.0, 0.0]
    found = check_log(replace(sound, observations=replace(seen, position_m=position)), NOISE)
    assert not found.findings


def test_share_outside_the_gate(sound: RobotLog) -> None:
    end = filtered(sound)
    assert end.associations is not None
    assert gate_finding(sound, end.associations) is None
    n_outside, n_expected = outside_gate(sound, end.associations)
    labels = sound.observations.label
    assert labels is not None
    assert n_expected == len(labels) - len(np.unique(labels))
    dropped = end.associations.copy()
    dropped[sound.iteration % 3 > 0] = -1
    assert outside_gate(sound, dropped)[0] > 0.6 * n_expected > n_outside
    finding = gate_finding(sound, dropped)
    assert finding is not None
    assert finding.kind == "gate"


def test_motions_in_space_by_tracks() -> None:
    """A robot drives straight ahead and observes points with heights."""
    rng, n = np.random.default_rng(5), 12
    world = np.column_stack([rng.uniform(2, 6, 30), rng.uniform(-3, 3, 30), rng.uniform(0, 2, 30)])
    path = np.column_stack([0.1 * np.arange(n), np.zeros((n, 2))])
    seen = (world[None] - np.column_stack([path[:, :2], np.zeros(n)])[:, None]).reshape(-1, 3)
    made = Observations(
        seen + rng.normal(0, 0.01, seen.shape),
        np.tile(1e-4 * np.eye(3), (len(seen), 1, 1)),
        track=np.tile(np.arange(30, dtype=np.int32), n),
    )
    odometry = np.zeros((n, 3))
    odometry[1:, 0] = 0.1
    log = RobotLog(
        "R1", False, np.linspace(0, n - 1, n), odometry, np.repeat(np.arange(n), 30), made
    )
    np.testing.assert_allclose(observed_motions(log).motion[:, :3], [[0.1, 0, 0]] * 11, atol=0.02)
    assert not check_log(log, NOISE).findings
    in_mm = replace(log, odometry=1000 * odometry)
    assert "millimetres" in check_log(in_mm, NOISE).findings[0].text


TRUTHS = {
    "sound": (lambda T: compose([5.0, 3.0, 1.0], T), None),
    "mirrored": (lambda T: T * [1, -1, -1], "other sign"),
    "millimetres": (lambda T: T * [1000, 1000, 1], "millimetres"),
    "inverted": (inverse, "inverted"),
    "degrees": (lambda T: T * [1, 1, 180 / np.pi], "degrees"),
    "late": (lambda T: np.concatenate([np.tile(T[:1], (12, 1)), T[:-12]]), "12 frames too late"),
}


@pytest.mark.parametrize("name", TRUTHS)
def test_truth_against_odometry(name: str) -> None:
    change, words = TRUTHS[name]
    turn = 0.15 * np.sign(np.sin(np.arange(60) / 4))
    steps = np.column_stack([np.where(np.arange(60) % 20 < 14, 0.1, 0), np.zeros(60), turn])
    path = poses_from_increments(steps)
    log = circling_log(60, poses=path)
    spans = composed_spans(odometry_motions(log, NOISE), len(log))
    truth = change(path)
    truth[5:8] = np.nan  # it has gaps
    finding = truth_finding("the odometry", spans, truth)
    if words is None:
        assert finding is None
    else:
        assert finding is not None
        assert words in finding.text


@pytest.mark.parametrize("late", [-9, 9])
def test_shifts_of_motions_that_repeat_are_named_from_the_smallest_on(late: int) -> None:
    """Turns repeat every 25 frames, so several delays explain the truth."""
    turn = 0.15 * np.sin(2 * np.pi * np.arange(120) / 25)
    path = poses_from_increments(np.column_stack([np.full(120, 0.1), np.zeros(120), turn]))
    log = circling_log(120, poses=path)
    spans = composed_spans(odometry_motions(log, NOISE), len(log))
    truth = path[np.clip(np.arange(120) - late, 0, 119)]
    finding = truth_finding("the odometry", spans, truth)
    assert finding is not None
    assert f"its times look 9 frames too {'late' if late > 0 else 'early'}" in finding.text


def test_two_mistakes_explain_more_than_three() -> None:
    """No combination of odometry mistakes explains observations as range and bearing."""
    log = circling_log(60)
    x, y, _ = log.observations.position_m.T
    polar = np.column_stack([np.hypot(x, y), np.degrees(np.arctan2(y, x)), 0 * x])
    wrong = replace(log, observations=replace(log.observations, position_m=polar))
    (finding,) = check_log(wrong, NOISE).findings
    assert "no common mistake explains it" in finding.text


def test_truth_with_quaternions_in_another_order() -> None:
    path = true_poses(60)
    log = circling_log(60, poses=path)
    spans = composed_spans(odometry_motions(log, NOISE), len(log))
    right = from_planar(path)
    for other in pose_mistakes(right).values():
        if np.allclose(other, right):
            assert truth_finding("the odometry", spans, other) is None
    half = path[:, 2] / 2
    xyzw = np.column_stack([np.zeros((60, 2)), np.sin(half), np.cos(half)])
    wrong = from_quaternions(right[:, :3, 3], np.roll(xyzw, 1, axis=1))
    finding = truth_finding("the odometry", spans, wrong)
    assert finding is not None
    assert "quaternions look like" in finding.text
