"""Tests of `experiments.pipeline.stages.slam`."""

from pathlib import Path

import numpy as np
import pytest

from experiments.pipeline.stages.slam import (
    _step,
    checked_log,
    evaluated_iterations,
    log_as_filtered,
    write_findings,
)
from mapfusion.datasets.log_consistency import NoiseSource
from mapfusion.fastslam.filter import FastSlamParameters, StepResult
from mapfusion.robot_log import read_log, write_log
from tests.mapfusion.datasets.turned_odometry import drive, turned


def test_spread_is_that_of_the_weighted_particles() -> None:
    """Three of four parts lie at x = 1, one at x = 5: variance 3, whatever the weights' scale."""
    cloud = np.array([[1.0, 2.0, 0.3], [5.0, 2.0, 0.1], [40.0, -9.0, 0.0]])
    weights = np.array([0.75, 0.25, 0.0])
    with np.errstate(divide="ignore"):
        log_weights = np.log(weights) - 700.0
    told = _step(StepResult(cloud[0], 1.6, True, 9, cloud, log_weights, -3.0))
    assert told["spread_m"] == pytest.approx(np.sqrt(3.0))
    assert [told[f"online_{name}"] for name in ("x_m", "y_m", "theta_rad")] == [1.0, 2.0, 0.3]
    assert (told["effective_sample_size"], told["resampled"], told["n_landmarks"]) == (1.6, True, 9)


@pytest.mark.parametrize(
    ("n_frames", "expected"), [(44, [20, 40, 43]), (41, [20, 40]), (40, [20, 39]), (1, [0])]
)
def test_the_last_frame_is_evaluated_and_none_beyond(n_frames: int, expected: list[int]) -> None:
    assert evaluated_iterations(n_frames, 20) == expected


def test_the_smoother_reads_the_log_that_was_filtered(tmp_path: Path) -> None:
    """The odometry has a systematic error of its direction and a jump."""
    log = turned(drive(2), -0.5)
    log.odometry[56, 0] += 3.0
    write_log(tmp_path / "log", log)
    recorded = read_log(tmp_path / "log")
    checked = checked_log(recorded, None, FastSlamParameters(), NoiseSource.FROM_LOG)
    kinds = [finding.kind for finding in checked.findings]
    assert kinds == ["direction", "jump", "association"]
    write_findings(tmp_path, checked)
    log, covariance = log_as_filtered(tmp_path / "log", tmp_path)
    np.testing.assert_array_equal(log.odometry, checked.log.odometry)
    assert np.abs(log.odometry - recorded.odometry).max() > 2.9
    assert covariance is not None
    assert checked.odometry_covariance is not None
    np.testing.assert_array_equal(covariance, checked.odometry_covariance)
