"""The smoothed landmarks as a map."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.robot_log import STRAY_M
from mapfusion.smoother.smooth import (
    SmootherParameters,
    smooth,
    smoothed_map,
    with_path_errors,
)
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


def test_the_errors_of_a_filters_map_are_those_of_the_smoothed_map_and_the_difference() -> None:
    rng = np.random.default_rng(2)
    log = white_noise_log(rng, 60, 12, planar=True).log
    assert log.observations.label is not None
    found = smooth(log, log.observations.label, dead_reckoned(log), SmootherParameters())
    smoothed = smoothed_map(log, found)
    assert smoothed.joint is not None
    order = rng.permutation(len(smoothed))
    moved = smoothed.position_m[order] + rng.normal(0, [0.1, 0.1, 0], (len(order), 3))
    tight = 1e-6 * np.tile(np.eye(3), (len(order), 1, 1))
    filtered = replace(smoothed[order], position_m=moved, covariance_m2=tight, joint=None)

    joint = with_path_errors(filtered, smoothed).joint
    assert joint is not None
    assert joint.complete
    difference = moved - smoothed.position_m[order]
    expected = smoothed.joint.marginal_m2[order] + np.einsum("ni,nj->nij", difference, difference)
    np.testing.assert_allclose(joint.marginal_m2, expected, rtol=1e-9, atol=1e-15)
    # differences of all landmarks are one shared error
    cross = joint.common_m[:, -1].reshape(-1)
    np.testing.assert_allclose(np.outer(cross, cross)[:3, 3:6], np.outer(*difference[:2]))

    # a landmark that the smoothed map lacks has the shared errors of the nearest one
    unknown = replace(filtered, source_observation=filtered.source_observation.copy())
    unknown.source_observation[0] = -1
    again = with_path_errors(unknown, smoothed, complete=False).joint
    assert again is not None
    assert not again.complete
    distance_m = np.linalg.norm(moved[1:, :2] - moved[0, :2], axis=1)
    nearest = 1 + int(distance_m.argmin())
    np.testing.assert_array_equal(again.common_m[0], again.common_m[nearest])
    np.testing.assert_array_equal(again.own_m2[0], tight[0])
    np.testing.assert_array_equal(again.common_m[1:], joint.common_m[1:])

    none = replace(filtered, source_observation=np.full(len(order), -1))
    assert with_path_errors(none, smoothed).joint is None
