"""Either order of elimination against a slow dense twin."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares

from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, between, rotation, wrap
from mapfusion.smoother.elimination import Solution, _landmarks_first, _poses_first, common_part
from mapfusion.smoother.normal_equations import (
    Estimate,
    NormalEquations,
    Weights,
    normal_equations,
    odometry_information,
)
from mapfusion.smoother.residuals import first_points
from mapfusion.smoother.sightings import Sightings, sightings_of
from tests.mapfusion.smoother.white_noise_logs import (
    NOISE,
    dead_reckoned,
    white_noise_log,
    with_tracks,
)

STRAY_M = 0.05
Eliminate = Callable[[Sightings, NormalEquations], Solution]


def dense_residuals(log: RobotLog, seen: Sightings, weights: Weights, x: Float) -> Float:
    """All residuals over their sigmas, written down one by one; unknowns as in `dense_unknowns`."""
    n, dimensions = 3 * (len(log) - 1), seen.n_dimensions
    n_points, n_strays = dimensions * seen.n_landmarks, np.count_nonzero(seen.strays)
    path = np.concatenate([np.zeros((1, 3)), x[:n].reshape(-1, 3)])
    points = x[n : n + n_points].reshape(-1, dimensions)
    offsets = np.zeros((len(seen.strays), dimensions))
    offsets[seen.strays] = x[n + n_points :].reshape(n_strays, dimensions)
    found = [(offsets * np.sqrt(weights.offset[:, None]))[seen.strays].ravel() / STRAY_M]
    for k in range(1, len(log)):
        d = between(path[k - 1], path[k]) - log.odometry[k]
        d[2] = wrap(d[2])
        variance = NOISE.standard_deviations(log.odometry[k]) ** 2 + [1e-8, 1e-8, 1e-10]
        found.append(d / np.sqrt(variance))
    rows = zip(seen.row, seen.landmark, seen.track, weights.observation, strict=True)
    for row, landmark, track, weight in rows:
        pose = path[log.iteration[row]]
        at = points[landmark] + offsets[track]
        at[:2] = rotation(pose[2]).T @ (at[:2] - pose[:2])
        error = at - log.observations.position_m[row, :dimensions]
        covariance = log.observations.covariance_m2[row, :dimensions, :dimensions]
        found.append(np.linalg.solve(np.linalg.cholesky(covariance / weight), error))
    return np.concatenate(found)


def dense_unknowns(seen: Sightings, at: Estimate) -> Float:
    """Poses but for the first, landmarks, and offsets of the tracks that stray."""
    d = seen.n_dimensions
    parts = (at.path[1:], at.point_m[:, :d], at.offset_m[seen.strays, :d])
    return np.concatenate([part.ravel() for part in parts])


def some_twice(log: RobotLog) -> RobotLog:
    """Every third observation once more in its frame, by another track and somewhere else."""
    again = np.arange(0, len(log.iteration), 3)
    row = np.sort(np.concatenate([np.arange(len(log.iteration)), again]))
    seen, second = log.observations[row], np.diff(row, prepend=-1) == 0
    position = seen.position_m + 0.02 * second[:, None] * [1.0, 1.0, not log.planar]
    track = seen.track
    if track is not None:
        track = np.where(second & (track >= 0), track.max() + 1, track).astype(np.int32)
    seen = replace(seen, position_m=position, track=track)
    return replace(log, iteration=log.iteration[row], observations=seen)


class Problem(NamedTuple):
    """Least squares at given weights, and what a slow dense solver finds: it is the same whatever
    is eliminated first.

    Attributes:
        log: what was seen, some of it twice in a frame.
        seen: the same by landmark.
        weights: of observations and offsets.
        unknowns: (U,) as in `dense_unknowns`.
        covariance: (U, U) theirs.
    """

    log: RobotLog
    seen: Sightings
    weights: Weights
    unknowns: Float
    covariance: Float


@functools.cache
def solved_densely(planar: bool, tracks: bool) -> Problem:
    """From the true unknowns, all offsets zero."""
    rng = np.random.default_rng(3)
    known = white_noise_log(rng, 12, 16, planar)
    log = some_twice(with_tracks(known, rng, STRAY_M).log if tracks else known.log)
    assert log.observations.label is not None
    seen = sightings_of(log, log.observations.label, 3, stray=True)
    assert np.any(seen.strays) == tracks
    n_tracks = len(seen.strays)
    weights = Weights(rng.uniform(0.3, 1, len(seen)), rng.uniform(0.3, 1, n_tracks) * seen.strays)
    start = Estimate(known.path, first_points(seen, known.path), np.zeros((n_tracks, 3)))
    twin = least_squares(
        lambda x: dense_residuals(log, seen, weights, x),
        dense_unknowns(seen, start),
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    return Problem(log, seen, weights, twin.x, np.linalg.inv(twin.jac.T @ twin.jac))


@pytest.mark.parametrize("eliminate", [_landmarks_first, _poses_first])
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("tracks", [False, True])
def test_equals_the_dense_twin(eliminate: Eliminate, planar: bool, tracks: bool) -> None:
    """Estimate and joint covariance."""
    log, seen, weights, unknowns, covariance = solved_densely(planar, tracks)
    d, n = seen.n_dimensions, 3 * (len(log) - 1)
    path, information = dead_reckoned(log), odometry_information(log.odometry, NOISE)
    at = Estimate(path, first_points(seen, path), np.zeros((len(seen.strays), 3)))
    for _ in range(12):
        equations = normal_equations(seen, at, weights, STRAY_M**-2, log.odometry, information)
        solution = eliminate(seen, equations)
        at = Estimate(*(old + new for old, new in zip(at, solution.step, strict=True)))
    np.testing.assert_allclose(dense_unknowns(seen, at), unknowns, atol=1e-6)
    assert solution.moved < 1e-12
    joint = dense_covariance(common_part(seen, equations, solution), solution.own_m2, d)
    own = covariance[n:, n:][: len(joint), : len(joint)]
    np.testing.assert_allclose(joint, own, rtol=1e-3, atol=1e-4 * joint.max())


def dense_covariance(common: Float, own_m2: Float, d: int) -> Float:
    """(dL, dL) joint covariance of landmarks in d dimensions."""
    joint, each = common.T @ common, np.arange(len(own_m2))
    joint.reshape(len(own_m2), 3, len(own_m2), 3)[each, :, each, :] += own_m2
    kept = (3 * each[:, None] + np.arange(d)).ravel()
    return joint[np.ix_(kept, kept)]
