"""Agreement of stated with observed motions: ratio, confidence interval, unsure motions."""

import numpy as np
import pytest

from mapfusion.datasets.motion_agreement import ReportedMotions, agreement, compare
from mapfusion.datasets.relative_motion import (
    observed_motions,
    poses_from_increments,
)
from mapfusion.fastslam.motion import MotionNoise
from tests.mapfusion.contradicting_logs import circling_log

NOISE = MotionNoise()


@pytest.mark.parametrize("share", [0.4, 1.0, 3.0])
def test_the_ratio_of_lengths_is_recovered(share: float) -> None:
    log = circling_log(60, 0.0)
    observed = observed_motions(log, 4)
    poses = poses_from_increments(log.odometry * [share, share, 1])
    found = compare(observed, ReportedMotions(poses, NOISE))
    assert found.shift.ratio == pytest.approx(share, rel=0.06)
    assert found.shift.median == pytest.approx(min(share, 1 / share), rel=0.1)
    assert found.turn.median > 0.9


def test_medians_at_the_limit_pass_as_seldom_as_asked() -> None:
    """The upper end of the interval lies below the true median with the probability asked for."""
    rng, asked, n = np.random.default_rng(0), 0.05, 25
    observed = np.tile([1.0, 0, 0], (n, 1))
    none = np.full(n, 1e-3)
    below = 0
    for _ in range(600):
        stated = observed * (0.7 + rng.normal(0, 0.05, (n, 1)))
        below += agreement(observed, stated, none, none, asked).upper < 0.7
    assert 0.01 < below / 600 < 0.085


def test_few_or_unsure_motions_say_nothing() -> None:
    ahead, back, sigma = np.tile([1.0, 0, 0], (3, 1)), np.tile([-1.0, 0, 0], (3, 1)), np.ones(3)
    assert agreement(ahead, back, sigma / 100, sigma / 100, 0.001).upper == np.inf
    many = np.tile([[1.0, 0, 0]], (50, 1))
    assert agreement(many, -many, np.ones(50), np.ones(50), 0.001).n == 0
    opposed = agreement(many, -many, np.ones(50) / 100, np.ones(50) / 100, 0.001)
    assert opposed.median == pytest.approx(-1)
    assert opposed.upper < -0.9
