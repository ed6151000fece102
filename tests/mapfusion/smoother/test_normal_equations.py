"""Squared distances of observations, against the same written down one by one."""

import numpy as np
import pytest

from mapfusion.geometry.se2 import rotation
from mapfusion.smoother.normal_equations import (
    Estimate,
    expected_point_squares,
    initial_landmarks,
    squared_distances,
)
from mapfusion.smoother.problem import order_observations
from tests.mapfusion.smoother.white_noise_logs import white_noise_log, with_tracks


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("about_true_points", [False, True])
def test_squares_are_those_of_the_rotated_residuals(planar: bool, about_true_points: bool) -> None:
    """e' W e in the map frame; about a true point, known to within C, trace(W C) more."""
    rng = np.random.default_rng(3)
    known = with_tracks(white_noise_log(rng, 30, 20, planar), rng, 0.05)
    log, label = known.log, known.log.observations.label
    assert label is not None
    obs = order_observations(log, label, 3, with_offsets=True)
    n_tracks = len(obs.has_offset)
    at = Estimate(
        known.path, initial_landmarks(obs, known.path), rng.normal(0, 0.05, (n_tracks, 3))
    )
    root = rng.normal(0, 0.03, (n_tracks, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2) if about_true_points else None
    found = squared_distances(obs, at)
    if covariance is not None:
        found = found + expected_point_squares(obs, at.path, covariance)
    for i in range(len(obs)):
        t = obs.track[i]
        R = rotation(at.path[obs.frame[i], 2])
        turn = np.eye(3)
        turn[:2, :2] = R
        W = turn @ obs.information[i] @ turn.T
        place = np.append(at.path[obs.frame[i], :2], 0.0)
        e = at.point_m[obs.landmark[i]] + at.offset_m[t] - place - turn @ obs.position_m[i]
        expected = e @ W @ e
        if covariance is not None:
            expected += np.trace(W @ covariance[t])
        assert found[i] == pytest.approx(expected, rel=1e-9)
