"""Systematic errors of the odometry's direction: known errors, sound logs, and the maps."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.datasets.log_consistency import check_log
from mapfusion.datasets.odometry_direction import DirectionError, find_direction_error
from mapfusion.datasets.relative_motion import (
    Motions,
    motions_of_poses,
    observed_spans,
    odometry_over_spans,
    poses_from_increments,
)
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.mapping import run_log
from mapfusion.geometry.se2 import wrap
from tests.mapfusion.datasets.turned_odometry import NOISE, drive, turned


@pytest.mark.parametrize("labels", [True, False])
@pytest.mark.parametrize(("end", "share"), [("start", 0.5), ("end", -0.5)])
def test_steps_integrated_by_euler_are_named_and_turned(
    end: str, share: float, labels: bool
) -> None:
    """The increments of Euler's method with the heading at the start have no sideways part."""
    sound = drive(2, "circle", labels)
    euler = turned(sound, -share)
    found = check_log(euler, NOISE)
    (finding,) = found.findings
    assert finding.kind == "direction"
    assert f"integrated with the heading at the {end} of each step" in finding.text
    corrected = found.direction.corrected(euler.odometry)
    # The bias is 12 mm across; at most a third remains.
    left = np.mean(corrected[1:, 1] - sound.odometry[1:, 1])
    assert abs(left) < 0.004
    np.testing.assert_allclose(
        np.hypot(*corrected[:, :2].T), np.hypot(*sound.odometry[:, :2].T), atol=1e-12
    )


@pytest.mark.parametrize(("seed", "degrees"), [(0, 4.0), (1, -4.0), (2, 20.0)])
def test_a_turned_sensor_is_named(seed: int, degrees: float) -> None:
    """Bends tell a turned sensor from Euler steps."""
    found = check_log(drive(seed, "bends", sensor_rad=np.radians(degrees)), NOISE)
    (finding,) = found.findings
    assert finding.kind == "direction"
    side = "left" if degrees > 0 else "right"
    assert f"degrees further {side} than stated" in finding.text
    assert "integrated" not in finding.text
    assert np.degrees(found.direction.heading_rad) == pytest.approx(-degrees, abs=1.5)


def test_sound_logs_are_left_alone() -> None:
    """At most the stated share of false alarms, of which most are smaller than the noise."""
    for shape in ("circle", "bends"):
        for seed in range(10):
            found = check_log(drive(seed, shape, labels=bool(seed % 2)), NOISE)
            assert found.findings == ()
            assert found.direction == DirectionError()


def test_points_that_hardly_show_the_motion_give_no_error() -> None:
    """Single points err by metres: the fit may end anywhere."""
    sigma_m = 3.0
    for seed in range(12):
        log, rng = drive(seed, "bends"), np.random.default_rng(seed)
        kept = np.flatnonzero(rng.random(len(log.iteration)) < 0.5)
        seen, plane = log.observations[kept], np.array([1.0, 1.0, 0.0])
        moved = seen.position_m + sigma_m * plane * rng.standard_normal((len(kept), 3))
        wide = seen.covariance_m2 + sigma_m**2 * np.diag(plane)
        vague = replace(seen, position_m=moved, covariance_m2=wide)
        log = replace(log, iteration=log.iteration[kept], observations=vague)
        error, text = find_direction_error(log.odometry, observed_spans(log), NOISE)
        assert (error, text) == (DirectionError(), "")


def test_an_error_that_no_mistake_explains_is_not_corrected() -> None:
    """Steps that are turned by more than half of their turn are not those of Euler's method."""
    log = turned(drive(4, "bends"), -1.5)
    assert check_log(log, NOISE).direction == DirectionError()


def test_a_noisier_odometry_explains_the_error() -> None:
    """The angle is smaller than the noise across the motion."""
    log = turned(drive(2), -0.5)
    wide = replace(NOISE, lateral_m_per_sqrt_m=0.03)
    assert check_log(log, NOISE).direction != DirectionError()
    assert check_log(log, wide).direction == DirectionError()


def test_derivative_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    odometry = np.column_stack([rng.normal(0.3, 0.1, (40, 2)), rng.normal(0, 0.2, 40)])
    start = np.arange(0, 32, 8)
    observed = Motions(start, start + 8, *[np.zeros(0)] * 4)
    unit = DirectionError(turn_share=0.7, heading_rad=0.2)
    T, _, B = odometry_over_spans(odometry, 0 * odometry, observed, unit.angles(odometry))
    moved, turns = motions_of_poses(poses_from_increments(odometry), start, start + 8)
    np.testing.assert_allclose(T[:, :2], moved[:, :2], atol=1e-12)
    np.testing.assert_allclose(wrap(T[:, 2] - turns[:, 2]), 0, atol=1e-12)
    by = 1e-6
    ends = [
        DirectionError(sign * by * 0.7, sign * by * 0.2).corrected(odometry) for sign in (1, -1)
    ]
    shifts = [motions_of_poses(poses_from_increments(each), start, start + 8)[0] for each in ends]
    np.testing.assert_allclose(B, (shifts[0] - shifts[1])[:, :2] / (2 * by), atol=1e-8)


def test_the_corrected_log_gives_each_tree_once() -> None:
    """Without labels, biased steps make the filter see trees as new ones."""
    n_landmarks = {}
    euler = turned(drive(2, labels=False), -0.5)
    corrected = check_log(euler, NOISE).direction.corrected(euler.odometry)
    for name, log in (("biased", euler), ("corrected", replace(euler, odometry=corrected))):
        parameters = FastSlamParameters(association=Association.GATE)
        rng = np.random.default_rng(0)
        *_, end = run_log(log, parameters, rng, [len(log) - 1], 3, viewing=False)
        assert end.landmarks is not None
        n_landmarks[name] = len(end.landmarks)
    n_seen = len(np.unique(drive(2).observations.label))
    assert n_landmarks["corrected"] <= n_seen < n_landmarks["biased"]
