"""Residuals and normal equations of a log, linearised about path, landmarks and tracks.

An observation z of landmark l on track t from pose x = (p, theta) is of the point l + b_t, and has
the residual e = R (R^T (l + b_t - p) - z) in the map frame, so that de/dl = de/db_t = I and
de/dx = J = [-I, lever]. The lever arm is that of the estimated point. The lever arm of the observed
point has the same error as z and would bias rotations. With the information W in the map frame and
P_t of the offset b_t, the equations of a step are

    pose_block dx + link dx' + sum coupling (dl + db_t) = -pose_gradient,     coupling = J' W
    sum over tracks of (coupling' dx + track_block (dl + db_t)) = -sum track_gradient
    coupling' dx + track_block (dl + db_t) + P_t db_t = -(track_gradient + P_t b_t)

with track_block = sum W and track_gradient = sum W e over the observations of a track.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.geometry.se2 import between, rotation, wrap
from mapfusion.smoother.problem import OrderedObservations

# Standard deviation of the odometry of a robot that stands still: far below the errors of any
# sensor, and far above the rounding errors of a system of a thousand poses.
_STILL = np.array([1e-4, 1e-4, 1e-5])  # m, m, rad


class Estimate(NamedTuple):
    """Path (T, 3), landmarks (L, 3) and tracks' offsets (B, 3), in the frame of the first pose."""

    path: Float
    point_m: Float
    offset_m: Float


class Weights(NamedTuple):
    """Robust weights: factors on the information.

    Attributes:
        observation: weight of each observation, shape (N,).
        offset: weight of each track's offset, shape (B,).
    """

    observation: Float
    offset: Float


class InformationShares(NamedTuple):
    """Expected shares of the weighted information of observations and of offsets."""

    observation: float
    offset: float


FULL_INFORMATION = InformationShares(1.0, 1.0)


class PointEquations(NamedTuple):
    """Equations of B tracks for a known path.

    Attributes:
        track_block: shape (B, 3, 3).
        track_gradient: shape (B, 3).
        offset_information: P_t along each axis, shape (B,).
        offset_gradient: P_t b_t, shape (B, 3).
    """

    track_block: Float
    track_gradient: Float
    offset_information: Float
    offset_gradient: Float


class NormalEquations(NamedTuple):
    """Blocks of the equations of T poses, L landmarks and B tracks.

    Attributes:
        pose_block: shape (T, 3, 3).
        link: each pose's block with the pose before it, shape (T - 1, 3, 3).
        pose_gradient: shape (T, 3).
        coupling: block of pose and landmark of each observation, shape (N, 3, 3).
        points: equations of the tracks.
    """

    pose_block: Float
    link: Float
    pose_gradient: Float
    coupling: Float
    points: PointEquations


def odometry_information(odometry: Float, noise: MotionNoise) -> Float:
    """Return the inverse variances (T - 1, 3) of the increments (T, 3) after the first."""
    sigma = np.array([noise.standard_deviations(each) for each in odometry[1:]]).reshape(-1, 3)
    return bounded_information(sigma)


def bounded_information(sigma: Float) -> Float:
    """Return bounded inverse variances (N, 3) of motions with standard deviations (N, 3)."""
    return 1.0 / (sigma**2 + _STILL**2)


def scaled_information(information: Float, scales: Float) -> Float:
    """Return the information (N, 3) of motions whose variances are multiplied by `scales` (3,).

    It has the bound of `bounded_information`, which is not scaled.
    """
    return np.minimum(information / scales, _STILL**-2)


def smallest_scales(information: Float) -> Float:
    """Return the noise scales (3,) below which the information (N, 3) is at its bound.

    They are 1 without any information.
    """
    min_information = np.min(np.where(information > 0, information, np.inf), axis=0, initial=np.inf)
    return np.where(np.isfinite(min_information), min_information * _STILL**2, 1.0)


def heading_cos_sin(path: Float) -> Float:
    """Return cosine and sine of each heading, shape (T, 2)."""
    return np.stack([np.cos(path[:, 2]), np.sin(path[:, 2])], axis=1)


def disturbances(path: Float, odometry: Float) -> Float:
    """Return the disturbances d of eq. 3, x_k = x_(k-1) + (u_k + d), shape (T - 1, 3)."""
    disturbance = between(path[:-1], path[1:]) - odometry[1:]
    disturbance[:, 2] = wrap(disturbance[:, 2])
    return disturbance


def disturbance_jacobians(path: Float) -> tuple[Float, Float]:
    """Return the Jacobians (T - 1, 3, 3) of each disturbance by the pose before and after it."""
    n = len(path) - 1
    to_robot = np.swapaxes(rotation(path[:-1, 2]), 1, 2)
    translation = path[1:, :2] - path[:-1, :2]
    jacobian_before, jacobian_after = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    jacobian_after[:, :2, :2], jacobian_after[:, 2, 2] = to_robot, 1.0
    jacobian_before[:, :2, :2], jacobian_before[:, 2, 2] = -to_robot, -1.0
    jacobian_before[:, :2, 2] = np.einsum(
        "nij,nj->ni", to_robot, np.stack([translation[:, 1], -translation[:, 0]], 1)
    )
    return jacobian_before, jacobian_after


def normal_equations(
    obs: OrderedObservations,
    at: Estimate,
    weights: Weights,
    offset_prior: float,
    odometry: Float,
    information: Float,
    shares: InformationShares = FULL_INFORMATION,
) -> NormalEquations:
    """Return the equations of the next step.

    Args:
        obs: the observations.
        at: the estimate.
        weights: weights of observations and offsets.
        offset_prior: information of an offset along each axis, in 1/m^2.
        odometry: increments, shape (T, 3).
        information: information of the increments, shape (T - 1, 3).
        shares: shares of observations and offsets in the matrix; the gradient is not scaled.
    """
    n_poses = len(at.path)
    equations = NormalEquations(
        np.zeros((n_poses, 3, 3)),
        np.zeros((n_poses - 1, 3, 3)),
        np.zeros((n_poses, 3)),
        np.empty((len(obs), 3, 3)),
        _no_observations(at, weights, offset_prior, shares),
    )
    poses = equations.pose_block, equations.pose_gradient, equations.coupling
    _add_observations(
        _observed_points(obs, at), weights.observation, shares.observation, equations.points, *poses
    )
    # odometry
    d = disturbances(at.path, odometry)
    jacobian_before, jacobian_after = disturbance_jacobians(at.path)
    for J, poses in ((jacobian_before, slice(0, n_poses - 1)), (jacobian_after, slice(1, n_poses))):
        weighted = np.swapaxes(J, 1, 2) * information[:, None, :]
        equations.pose_block[poses] += weighted @ J
        equations.pose_gradient[poses] += np.einsum("nij,nj->ni", weighted, d)
    equations.link[:] = (
        np.swapaxes(jacobian_after, 1, 2) * information[:, None, :]
    ) @ jacobian_before
    return equations


def point_equations(
    obs: OrderedObservations, at: Estimate, weights: Weights, offset_prior: float
) -> PointEquations:
    """Return the equations of the points for a fixed path; arguments as in `normal_equations`."""
    equations = _no_observations(at, weights, offset_prior, FULL_INFORMATION)
    nothing = np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 3, 3))
    _add_observations(_observed_points(obs, at), weights.observation, 1.0, equations, *nothing)
    return equations


def _no_observations(
    at: Estimate, weights: Weights, offset_prior: float, shares: InformationShares
) -> PointEquations:
    n, of_offset = len(at.offset_m), weights.offset * offset_prior
    nothing = np.zeros((n, 3, 3)), np.zeros((n, 3))
    return PointEquations(*nothing, shares.offset * of_offset, of_offset[:, None] * at.offset_m)


class _ObservedPoints(NamedTuple):
    """Arrays of observations and of what they observe, for kernels.

    Attributes:
        frame: frame of each observation, shape (N,).
        track: track of each observation, shape (N,).
        position_m: observed positions in the robot frame, shape (N, 3).
        information: inverses of their covariances, shape (N, 3, 3).
        path: path, shape (T, 3).
        turn: cosine and sine of each heading, shape (T, 2).
        point_m: point of each track, shape (B, 3).
    """

    frame: np.ndarray
    track: np.ndarray
    position_m: Float
    information: Float
    path: Float
    turn: Float
    point_m: Float


def _observed_points(obs: OrderedObservations, at: Estimate) -> _ObservedPoints:
    point_m = at.point_m[obs.landmark_of_track] + at.offset_m
    stated = obs.frame, obs.track, obs.position_m, obs.information
    return _ObservedPoints(*stated, at.path, heading_cos_sin(at.path), point_m)


@kernel
def _add_observations(
    seen: _ObservedPoints,
    weight: Float,
    share: float,
    points: PointEquations,
    pose_block: Float,
    pose_gradient: Float,
    coupling: Float,
) -> None:
    """Add the observations to the equations of points and poses.

    Args:
        seen: the observations.
        weight: weight of each observation, shape (N,).
        share: share of the information in the matrix.
        points: equations of the points.
        pose_block: shape (T, 3, 3).
        pose_gradient: shape (T, 3).
        coupling: shape (N, 3, 3); empty to leave out the poses.
    """
    block, gradient = points.track_block, points.track_gradient
    for i in range(len(weight)):
        k, t, w, information = seen.frame[i], seen.track[i], weight[i], seen.information[i]
        c, s = seen.turn[k, 0], seen.turn[k, 1]
        u, v = seen.position_m[i, 0], seen.position_m[i, 1]
        # residual, and weighted information in the map frame
        x, y = seen.point_m[t, 0] - seen.path[k, 0], seen.point_m[t, 1] - seen.path[k, 1]
        ex, ey = x - (c * u - s * v), y - (s * u + c * v)
        ez = seen.point_m[t, 2] - seen.position_m[i, 2]
        along, across, mixed = information[0, 0], information[1, 1], information[0, 1]
        xx = w * (c * c * along - 2 * c * s * mixed + s * s * across)
        yy = w * (s * s * along + 2 * c * s * mixed + c * c * across)
        xy = w * (c * s * (along - across) + (c * c - s * s) * mixed)
        xz = w * (c * information[0, 2] - s * information[1, 2])
        yz = w * (s * information[0, 2] + c * information[1, 2])
        zz = w * information[2, 2]
        rows = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        gx = xx * ex + xy * ey + xz * ez
        gy = xy * ex + yy * ey + yz * ez
        gradient[t, 0] += gx
        gradient[t, 1] += gy
        gradient[t, 2] += xz * ex + yz * ey + zz * ez
        for r in range(3):
            for q in range(3):
                block[t, r, q] += share * rows[r][q]
        if len(coupling) == 0:
            continue
        # (y, -x) is the lever arm, the last column of de/dx
        pose_gradient[k, 0] -= gx
        pose_gradient[k, 1] -= gy
        pose_gradient[k, 2] += y * gx - x * gy
        for q in range(3):
            coupling[i, 0, q] = -share * rows[0][q]
            coupling[i, 1, q] = -share * rows[1][q]
            coupling[i, 2, q] = share * (y * rows[0][q] - x * rows[1][q])
        for r in range(3):
            pose_block[k, r, 0] -= coupling[i, r, 0]
            pose_block[k, r, 1] -= coupling[i, r, 1]
            pose_block[k, r, 2] += y * coupling[i, r, 0] - x * coupling[i, r, 1]


def initial_landmarks(obs: OrderedObservations, path: Float) -> Float:
    """Return the mean observed position of each landmark for a path, shape (L, 3)."""
    pose, position = path[obs.frame], obs.position_m.copy()
    turned = np.einsum("nij,nj->ni", rotation(pose[:, 2]), position[:, :2])
    position[:, :2] = pose[:, :2] + turned
    return obs.sum_by_landmark(position) / np.diff(obs.starts)[:, None]


def squared_distances(obs: OrderedObservations, at: Estimate) -> Float:
    """Return the squared Mahalanobis distances of the observations, shape (N,).

    They are r' W r with the residuals r = R'(l + b - p) - z in the robot frame.
    """
    square = np.empty(len(obs))
    _fill_squared_distances(_observed_points(obs, at), square)
    return square


@kernel
def _fill_squared_distances(seen: _ObservedPoints, square: Float) -> None:
    """Fill the squared Mahalanobis distances (N,) of `squared_distances`."""
    for i in range(len(square)):
        k, t, W = seen.frame[i], seen.track[i], seen.information[i]
        c, s = seen.turn[k, 0], seen.turn[k, 1]
        x, y = seen.point_m[t, 0] - seen.path[k, 0], seen.point_m[t, 1] - seen.path[k, 1]
        r0 = c * x + s * y - seen.position_m[i, 0]
        r1 = c * y - s * x - seen.position_m[i, 1]
        r2 = seen.point_m[t, 2] - seen.position_m[i, 2]
        square[i] = (
            r0 * (W[0, 0] * r0 + 2 * W[0, 1] * r1)
            + r1 * (W[1, 1] * r1 + 2 * W[1, 2] * r2)
            + r2 * (W[2, 2] * r2 + 2 * W[0, 2] * r0)
        )


def expected_point_squares(obs: OrderedObservations, path: Float, covariance_m2: Float) -> Float:
    """Return the expected increase of squared distances by errors of the points, shape (N,).

    It is the trace of W R' C R, if the points are independent of the observations. Distances from
    points that are fitted to the same observations are smaller.

    Args:
        obs: the observations.
        path: path, shape (T, 3).
        covariance_m2: covariances C of the tracks' points, shape (B, 3, 3).
    """
    increase = np.empty(len(obs))
    stated = obs.frame, obs.track, obs.information
    _fill_expected_squares(*stated, heading_cos_sin(path), covariance_m2, increase)
    return increase


@kernel
def _fill_expected_squares(
    frame: np.ndarray,
    track: np.ndarray,
    information: Float,
    turn: Float,
    covariance_m2: Float,
    increase: Float,
) -> None:
    """Fill the traces (N,) of `expected_point_squares`; `turn` is of `heading_cos_sin`."""
    for i in range(len(increase)):
        W, C, c, s = information[i], covariance_m2[track[i]], turn[frame[i], 0], turn[frame[i], 1]
        xx, xy, xz, yy, yz = C[0, 0], C[0, 1], C[0, 2], C[1, 1], C[1, 2]
        increase[i] = (
            W[0, 0] * (c * c * xx + 2 * c * s * xy + s * s * yy)
            + W[1, 1] * (s * s * xx - 2 * c * s * xy + c * c * yy)
            + W[2, 2] * C[2, 2]
            + 2 * W[0, 1] * (c * s * (yy - xx) + (c * c - s * s) * xy)
            + 2 * W[0, 2] * (c * xz + s * yz)
            + 2 * W[1, 2] * (c * yz - s * xz)
        )


def offset_squares(obs: OrderedObservations, at: Estimate, offset_prior: float) -> Float:
    """Return the squared Mahalanobis distances of the offsets from zero."""
    offset = at.offset_m[obs.has_offset, : obs.n_dimensions]
    return offset_prior * np.sum(offset**2, axis=1)


def determined_dimensions(obs: OrderedObservations, offset_m2: Float, information: Float) -> Float:
    """Return the number of dimensions of each offset that the data determine.

    It is the trace of 1 - P C, with the offset's covariance C and its prior information P. It is
    also the expected squared Mahalanobis distance of the estimate. It is 0 for the only track of a
    landmark, and nearly n for one track among many.

    Args:
        obs: the observations.
        offset_m2: C, shape (B, 3, 3).
        information: P along each axis, shape (B,).
    """
    n, has_offset = obs.n_dimensions, obs.has_offset
    unknown = information[has_offset] * np.trace(offset_m2[has_offset, :n, :n], axis1=1, axis2=2)
    return np.clip(n - unknown, 0, n)
