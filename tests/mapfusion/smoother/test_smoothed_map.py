"""The smoothed landmarks as a map."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.robot_log import STRAY_M
from mapfusion.smoother.smooth import SmootherParameters, smooth, smoothed_map
from tests.mapfusion.fastslam.landmark_worlds import unit
from tests.mapfusion.smoother.white_noise_logs import dead_reckoned, white_noise_log, with_tracks


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


@pytest.mark.parametrize("tracked", [False, True])
@pytest.mark.parametrize("named_by", ["first", "last"])
def test_landmarks_look_as_the_observations_they_are_named_by(named_by: str, tracked: bool) -> None:
    """The landmarks may be named by any of their rows in the log."""
    rng = np.random.default_rng(1)
    known = white_noise_log(rng, 80, 15)
    log = with_tracks(known, rng, STRAY_M).log if tracked else known.log
    obs = log.observations
    assert obs.label is not None
    look = unit(rng.standard_normal((len(obs), 64))).astype(np.float32)
    log = replace(log, observations=replace(obs, descriptor=look))
    rows = {label: np.flatnonzero(obs.label == label) for label in np.unique(obs.label)}
    name = np.array([rows[label][0 if named_by == "first" else -1] for label in obs.label])
    found = smoothed_map(log, smooth(log, name, dead_reckoned(log), SmootherParameters()))
    assert found.descriptor is not None
    assert found.label is not None
    counts = {own[0 if named_by == "first" else -1]: len(own) for own in rows.values()}
    assert [counts[row] for row in found.source_observation] == found.count.tolist()
    np.testing.assert_array_equal(found.descriptor, look[found.source_observation])
    np.testing.assert_array_equal(found.label, obs.label[found.source_observation])
