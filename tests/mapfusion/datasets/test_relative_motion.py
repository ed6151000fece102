"""Observed motions against the true ones, their covariance, and compositions over spans."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.datasets.relative_motion import (
    composed_spans,
    observed_motions,
    odometry_motions,
    poses_from_increments,
    tracked_by_position,
)
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.se2 import between, rotation, wrap
from mapfusion.robot_log import Observations, RobotLog
from tests.mapfusion.contradicting_logs import circling_log

NOISE = MotionNoise()


def test_planar_motions_and_their_covariance() -> None:
    """Errors agree with the covariance, also with a false link in half of the draws."""
    T, sigma = np.array([0.3, -0.1, 0.2]), 0.02
    rng, off = np.random.default_rng(3), []
    points = rng.uniform(-4, 4, (12, 2))
    before = points @ rotation(T[2]).T + T[:2]
    for draw in range(150):
        seen = np.concatenate([before, points]) + rng.normal(0, sigma, (24, 2))
        if draw % 2:
            seen[3] += 1.0
        made = Observations(
            np.column_stack([seen, np.zeros(24)]),
            np.tile(np.diag([sigma**2, sigma**2, 0]), (24, 1, 1)),
            label=np.tile(np.arange(12, dtype=np.int32), 2),
        )
        log = RobotLog(
            "R1", True, np.array([0.0, 1.0]), np.zeros((2, 3)), np.repeat([0, 1], 12), made
        )
        found = observed_motions(log)
        error = found.motion[0, [0, 1, 5]] - T
        own = found.covariance[0][np.ix_([0, 1, 5], [0, 1, 5])]
        off.append(error @ np.linalg.solve(own, error))
    assert np.mean(off) == pytest.approx(3, abs=0.7)  # chi-square of 3 degrees of freedom


@pytest.mark.parametrize("step", [(0.1, 0, 0.05), (0.8, 0, 0.3)], ids=["slow", "fast"])
def test_points_without_names_are_tracked_by_position(step: tuple[float, ...]) -> None:
    """Tracks are nearly the labels, also if the robot moves as far as points are apart."""
    log = circling_log(60, 0.01, poses=poses_from_increments(np.tile(step, (60, 1))))
    seen, starts = log.observations, log.frame_starts()
    tracked = tracked_by_position(replace(log, observations=replace(seen, label=None)))
    counts = np.zeros(3)  # pairs of one label, of one track, and of both
    for frame in range(1, len(log)):
        a, b = (slice(starts[k], starts[k + 1]) for k in (frame - 1, frame))
        of_label, of_track = (
            names[a][:, None] == names[b]
            for names in (seen.label, tracked.observations.track)
            if names is not None
        )
        counts += of_label.sum(), of_track.sum(), (of_label & of_track).sum()
    assert counts[2] > 0.85 * counts[0]
    assert counts[2] > 0.98 * counts[1]


def test_spans_compose_motions() -> None:
    log = circling_log(21, 0.01)
    spans = composed_spans(odometry_motions(log, NOISE), len(log))
    path = poses_from_increments(log.odometry)
    for span in spans:
        expected = between(path[span.start], path[span.end])
        found = span.motion[:, [0, 1, 5]]
        np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-12)
        np.testing.assert_allclose(wrap(found[:, 2] - expected[:, 2]), 0, atol=1e-12)
    assert [int((span.end - span.start)[0]) for span in spans] == [1, 2, 4]
