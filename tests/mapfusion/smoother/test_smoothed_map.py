"""The smoothed landmarks as a map."""

import numpy as np

from mapfusion.smoother.smooth import SmootherParameters, smooth
from mapfusion.smoother.smoothed_map import smoothed_map
from tests.mapfusion.smoother.white_noise_logs import dead_reckoned, white_noise_log


def test_planar_landmarks_have_no_height_and_are_not_unsure_of_it() -> None:
    """Poses outnumber landmarks here, so these are what is eliminated last."""
    log = white_noise_log(np.random.default_rng(0), 60, 12, planar=True).log
    assert log.observations.label is not None
    found = smooth(log, log.observations.label, dead_reckoned(log), SmootherParameters())
    landmarks = smoothed_map(log, found)
    assert landmarks.joint is not None
    assert not landmarks.position_m[:, 2].any()
    assert not landmarks.covariance_m2[:, 2].any()
    assert not landmarks.joint.common_m[..., 2].any()
    assert np.linalg.eigvalsh(landmarks.joint.own_m2[:, :2, :2]).min() > 0
