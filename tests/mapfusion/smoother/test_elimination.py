"""Either order of elimination against a slow dense twin."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares

from mapfusion.geometry.joint_covariance import KnownErrors, reduce_rank
from mapfusion.geometry.numerics import Float, inverses
from mapfusion.geometry.se2 import between, rotation, wrap
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.elimination import (
    Solution,
    _eliminate_landmarks_first,
    _eliminate_poses_first,
    shared_errors,
    solve_points,
)
from mapfusion.smoother.normal_equations import (
    Estimate,
    InformationShares,
    NormalEquations,
    Weights,
    initial_landmarks,
    normal_equations,
    odometry_information,
)
from mapfusion.smoother.problem import OrderedObservations, order_observations
from tests.mapfusion.smoother.white_noise_logs import (
    NOISE,
    dead_reckoned,
    white_noise_log,
    with_tracks,
)

STRAY_M = 0.05
Eliminate = Callable[[OrderedObservations, NormalEquations], Solution]


def common_part(obs: OrderedObservations, equations: NormalEquations, solution: Solution) -> Float:
    """(R, 3L) Y of what landmarks share, dense."""
    errors = shared_errors(obs, equations, solution)
    return errors.spread(np.eye(len(errors))).T


def dense_residuals(log: RobotLog, obs: OrderedObservations, weights: Weights, x: Float) -> Float:
    """All residuals over their sigmas, written down one by one; unknowns as in `dense_unknowns`."""
    n, dimensions = 3 * (len(log) - 1), obs.n_dimensions
    n_points, n_strays = dimensions * obs.n_landmarks, np.count_nonzero(obs.has_offset)
    path = np.concatenate([np.zeros((1, 3)), x[:n].reshape(-1, 3)])
    points = x[n : n + n_points].reshape(-1, dimensions)
    offsets = np.zeros((len(obs.has_offset), dimensions))
    offsets[obs.has_offset] = x[n + n_points :].reshape(n_strays, dimensions)
    found = [(offsets * np.sqrt(weights.offset[:, None]))[obs.has_offset].ravel() / STRAY_M]
    for k in range(1, len(log)):
        d = between(path[k - 1], path[k]) - log.odometry[k]
        d[2] = wrap(d[2])
        variance = NOISE.standard_deviations(log.odometry[k]) ** 2 + [1e-8, 1e-8, 1e-10]
        found.append(d / np.sqrt(variance))
    rows = zip(obs.row, obs.landmark, obs.track, weights.observation, strict=True)
    for row, landmark, track, weight in rows:
        pose = path[log.iteration[row]]
        at = points[landmark] + offsets[track]
        at[:2] = rotation(pose[2]).T @ (at[:2] - pose[:2])
        error = at - log.observations.position_m[row, :dimensions]
        covariance = log.observations.covariance_m2[row, :dimensions, :dimensions]
        found.append(np.linalg.solve(np.linalg.cholesky(covariance / weight), error))
    return np.concatenate(found)


def dense_unknowns(obs: OrderedObservations, at: Estimate) -> Float:
    """Poses but for the first, landmarks, and offsets of the tracks that stray."""
    d = obs.n_dimensions
    parts = (at.path[1:], at.point_m[:, :d], at.offset_m[obs.has_offset, :d])
    return np.concatenate([part.ravel() for part in parts])


def some_twice(log: RobotLog) -> RobotLog:
    """Every third observation once more in its frame, by another track and somewhere else."""
    again = np.arange(0, len(log.iteration), 3)
    row = np.sort(np.concatenate([np.arange(len(log.iteration)), again]))
    obs, second = log.observations[row], np.diff(row, prepend=-1) == 0
    position = obs.position_m + 0.02 * second[:, None] * [1.0, 1.0, not log.planar]
    track = obs.track
    if track is not None:
        track = np.where(second & (track >= 0), track.max() + 1, track).astype(np.int32)
    obs = replace(obs, position_m=position, track=track)
    return replace(log, iteration=log.iteration[row], observations=obs)


class Problem(NamedTuple):
    """Least squares at given weights, and what a slow dense solver finds: it is the same whatever
    is eliminated first.

    Attributes:
        log: what was seen, some of it twice in a frame.
        obs: the same by landmark.
        weights: of observations and offsets.
        unknowns: (U,) as in `dense_unknowns`.
        covariance: (U, U) theirs.
    """

    log: RobotLog
    obs: OrderedObservations
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
    obs = order_observations(log, log.observations.label, 3, with_offsets=True)
    assert np.any(obs.has_offset) == tracks
    n_tracks = len(obs.has_offset)
    weights = Weights(rng.uniform(0.3, 1, len(obs)), rng.uniform(0.3, 1, n_tracks) * obs.has_offset)
    start = Estimate(known.path, initial_landmarks(obs, known.path), np.zeros((n_tracks, 3)))
    twin = least_squares(
        lambda x: dense_residuals(log, obs, weights, x),
        dense_unknowns(obs, start),
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    return Problem(log, obs, weights, twin.x, np.linalg.inv(twin.jac.T @ twin.jac))


@pytest.mark.parametrize("eliminate", [_eliminate_landmarks_first, _eliminate_poses_first])
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("tracks", [False, True])
def test_equals_the_dense_twin(eliminate: Eliminate, planar: bool, tracks: bool) -> None:
    """Estimate and joint covariance."""
    log, obs, weights, unknowns, covariance = solved_densely(planar, tracks)
    d, n = obs.n_dimensions, 3 * (len(log) - 1)
    path, information = dead_reckoned(log), odometry_information(log.odometry, NOISE)
    at = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    for _ in range(12):
        equations = normal_equations(obs, at, weights, STRAY_M**-2, log.odometry, information)
        solution = eliminate(obs, equations)
        at = Estimate(*(old + new for old, new in zip(at, solution.step, strict=True)))
    np.testing.assert_allclose(dense_unknowns(obs, at), unknowns, atol=1e-6)
    assert solution.squared_step < 1e-12
    joint = dense_covariance(common_part(obs, equations, solution), solution.own_m2, d)
    own = covariance[n:, n:][: len(joint), : len(joint)]
    np.testing.assert_allclose(joint, own, rtol=1e-3, atol=1e-4 * joint.max())


def dense_covariance(common: Float, own_m2: Float, d: int) -> Float:
    """(dL, dL) joint covariance of landmarks in d dimensions."""
    joint, each = common.T @ common, np.arange(len(own_m2))
    joint.reshape(len(own_m2), 3, len(own_m2), 3)[each, :, each, :] += own_m2
    point_by_landmark = (3 * each[:, None] + np.arange(d)).ravel()
    return joint[np.ix_(point_by_landmark, point_by_landmark)]


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("tracks", [False, True])
def test_errors_of_the_path_are_those_of_their_large_matrix(planar: bool, tracks: bool) -> None:
    """Products with Y agree with the joint covariance of the landmarks."""
    log, obs, weights, _, _ = solved_densely(planar, tracks)
    information = odometry_information(log.odometry, NOISE)
    path = dead_reckoned(log)
    at = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    equations = normal_equations(obs, at, weights, STRAY_M**-2, log.odometry, information)
    solution = _eliminate_landmarks_first(obs, equations)
    errors = shared_errors(obs, equations, solution)
    Y = common_part(obs, equations, solution)
    n = 3 * (len(log) - 1)
    assert len(errors) == len(Y) == n
    gram = Y @ Y.T
    columns = np.random.default_rng(0).standard_normal((n, 4))
    scale = np.abs(gram).max()
    np.testing.assert_allclose(errors.gram(columns), gram @ columns, atol=1e-5 * scale)
    again = errors.gathered(errors.spread(columns))
    np.testing.assert_allclose(again, gram @ columns, rtol=0, atol=1e-9 * scale)
    rows = np.array([2, 0, n - 1])
    np.testing.assert_allclose(errors.rows_by_all(rows), gram[:, rows], atol=1e-5 * scale)
    squares = KnownErrors(Y).squares()
    np.testing.assert_allclose(errors.squares(), squares, rtol=0, atol=1e-9 * squares.max())
    by_both = [reduce_rank(solution.own_m2, known, rank=6) for known in (errors, KnownErrors(Y))]
    for one, other in zip(*((each.own_m2, each.marginal_m2) for each in by_both), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-6 * squares.max())


@pytest.mark.parametrize("planar", [False, True])
def test_points_on_a_path_that_stays_equal_the_dense_twin(planar: bool) -> None:
    log, obs, weights, _, _ = solved_densely(planar, tracks=True)
    path, d = dead_reckoned(log), obs.n_dimensions
    at = Estimate(path, initial_landmarks(obs, path), np.full((len(obs.has_offset), 3), 0.01))
    at.offset_m[~obs.has_offset] = at.offset_m[:, d:] = 0.0
    step, known = solve_points(obs, at, weights, STRAY_M**-2)
    n, x = 3 * (len(log) - 1), dense_unknowns(obs, at)

    def residuals(points: Float) -> Float:
        return dense_residuals(log, obs, weights, np.concatenate([x[:n], points]))

    twin = least_squares(residuals, x[n:], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    moved = Estimate(path, at.point_m + step.point_m, at.offset_m + step.offset_m)
    np.testing.assert_allclose(dense_unknowns(obs, moved)[n:], twin.x, atol=1e-8)
    assert not step.path.any()
    covariance = np.linalg.inv(twin.jac.T @ twin.jac)
    n_points, has_offset = d * obs.n_landmarks, np.flatnonzero(obs.has_offset)
    for k, track in enumerate(has_offset):
        own = d * obs.landmark_of_track[track] + np.arange(d)
        its = n_points + d * k + np.arange(d)
        of_offset = covariance[np.ix_(its, its)]
        both = covariance[np.ix_(own, own)] + of_offset
        both = both + covariance[np.ix_(own, its)] + covariance[np.ix_(its, own)]
        for found, dense in ((known.offset_m2, of_offset), (known.track_m2, both)):
            np.testing.assert_allclose(found[track, :d, :d], dense, rtol=1e-4, atol=1e-9)


def test_shares_are_of_the_matrix_alone() -> None:
    """As if all weights were less, but for the gradient."""
    log, obs, weights, _, _ = solved_densely(planar=False, tracks=True)
    path, information = dead_reckoned(log), odometry_information(log.odometry, NOISE)
    at = Estimate(path, initial_landmarks(obs, path), np.full((len(obs.has_offset), 3), 0.01))
    given = STRAY_M**-2, log.odometry, information
    less = Weights(0.8 * weights.observation, 0.6 * weights.offset)
    shared = normal_equations(obs, at, weights, *given, InformationShares(0.8, 0.6))
    whole = normal_equations(obs, at, weights, *given)
    scaled = normal_equations(obs, at, less, *given)
    for name in ("pose_block", "link", "coupling"):
        np.testing.assert_allclose(getattr(shared, name), getattr(scaled, name), rtol=1e-12)
    for name in ("track_block", "offset_information"):
        found, expected = getattr(shared.points, name), getattr(scaled.points, name)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    scale = np.abs(whole.pose_gradient).max()
    np.testing.assert_allclose(shared.pose_gradient, whole.pose_gradient, atol=1e-12 * scale)
    for name in ("track_gradient", "offset_gradient"):
        found, expected = getattr(shared.points, name), getattr(whole.points, name)
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_blocks_are_inverted() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.standard_normal((3, 3)) * 10.0 ** rng.uniform(-1, 1, 3)
        (inverse,) = inverses((root @ root.T)[None])
        expected = np.linalg.inv(root @ root.T)
        np.testing.assert_allclose(inverse, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    roots = rng.standard_normal((7, 3, 3))
    blocks = roots @ np.swapaxes(roots, 1, 2) + np.eye(3)
    for d in (2, 3):
        expected = np.linalg.inv(blocks[:, :d, :d])
        np.testing.assert_allclose(inverses(blocks[:, :d, :d]), expected, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        inverses(np.stack([np.eye(3), -np.eye(3)]))
    for singular in (np.diag([1.0, 0.0, 1.0]), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)):
        with pytest.raises(np.linalg.LinAlgError):
            inverses(singular[None])
