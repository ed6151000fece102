"""The normal equations of a log at a guess of path, landmarks and tracks.

An observation z of landmark l on track t from pose x = (p, theta) is of the point l + b_t, and has
the residual e = R (R^T (l + b_t - p) - z), turned into the map frame, so that de/dl = de/db_t = I
and de/dx = J = [-I, lever]. The lever arm of the rotation is where the point is thought to be: with
the observed point instead, whose error is also in z, rotations are biased. With W the information
in the map frame and P_t that of the offset b_t the equations of a step are

    pose_block dx + link dx' + sum coupling (dl + db_t) = -pose_gradient,     coupling = J' W
    sum over tracks of (coupling' dx + track_block (dl + db_t)) = -sum track_gradient
    coupling' dx + track_block (dl + db_t) + P_t db_t = -(track_gradient + P_t b_t)

with track_block = sum W and track_gradient = sum W e over the observations of a track.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.se2 import Float, between, rotation, wrap
from mapfusion.smoother.sightings import Sightings

# Wheels that do not turn hold the robot, but no closer than this: far below what any sensor of a
# robot tells, and far above what rounding leaves of a system of a thousand poses.
_STILL = np.array([1e-4, 1e-4, 1e-5])  # m, m, rad


class Estimate(NamedTuple):
    """Path (T, 3), landmarks (L, 3) and tracks' offsets (B, 3), in the frame of the first pose."""

    path: Float
    point_m: Float
    offset_m: Float


class Weights(NamedTuple):
    """What robust losses make of the information: factors on it.

    Attributes:
        observation: (N,) of each observation.
        offset: (B,) of each track's offset.
    """

    observation: Float
    offset: Float


class NormalEquations(NamedTuple):
    """Of T poses, L landmarks and B tracks, by blocks.

    Attributes:
        pose_block: (T, 3, 3).
        link: (T - 1, 3, 3) each pose's block with the pose before it.
        pose_gradient: (T, 3).
        track_block: (B, 3, 3).
        track_gradient: (B, 3).
        offset_information: (B,) P_t, the same along each axis.
        offset_gradient: (B, 3) P_t b_t.
        coupling: (N, 3, 3) a pose's block with a landmark, by observation.
    """

    pose_block: Float
    link: Float
    pose_gradient: Float
    track_block: Float
    track_gradient: Float
    offset_information: Float
    offset_gradient: Float
    coupling: Float


def odometry_information(odometry: Float, noise: MotionNoise) -> Float:
    """(T - 1, 3) inverse variances of the increments (T, 3) after the first, which is no motion."""
    sigma = np.array([noise.standard_deviations(each) for each in odometry[1:]]).reshape(-1, 3)
    return information_of(sigma)


def information_of(sigma: Float) -> Float:
    """Inverse variances (N, 3) of motions with standard deviations (N, 3), bounded."""
    return 1.0 / (sigma**2 + _STILL**2)


def turns(path: Float) -> Float:
    """(T, 2) cosine and sine of each heading."""
    return np.stack([np.cos(path[:, 2]), np.sin(path[:, 2])], axis=1)


def disturbances(path: Float, odometry: Float) -> Float:
    """(T - 1, 3) d of eq. 3 on this path: x_k = x_(k-1) + (u_k + d)."""
    found = between(path[:-1], path[1:]) - odometry[1:]
    found[:, 2] = wrap(found[:, 2])
    return found


def disturbance_jacobians(path: Float) -> tuple[Float, Float]:
    """(T - 1, 3, 3) of each disturbance by the pose before it, and by the one after it."""
    n = len(path) - 1
    to_robot = np.swapaxes(rotation(path[:-1, 2]), 1, 2)
    way = path[1:, :2] - path[:-1, :2]
    before, after = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    after[:, :2, :2], after[:, 2, 2] = to_robot, 1.0
    before[:, :2, :2], before[:, 2, 2] = -to_robot, -1.0
    before[:, :2, 2] = np.einsum("nij,nj->ni", to_robot, np.stack([way[:, 1], -way[:, 0]], 1))
    return before, after


def normal_equations(
    seen: Sightings,
    at: Estimate,
    weights: Weights,
    stray_information: float,
    odometry: Float,
    information: Float,
) -> NormalEquations:
    """The equations of the next step.

    Args:
        seen: the observations.
        at: where is linearised.
        weights: of observations and offsets.
        stray_information: of an offset along each axis, in 1/m^2.
        odometry: (T, 3) increments.
        information: (T - 1, 3) theirs.
    """
    n_poses, n_tracks = len(at.path), len(at.offset_m)
    of_offset = weights.offset * stray_information
    made = NormalEquations(
        np.zeros((n_poses, 3, 3)),
        np.zeros((n_poses - 1, 3, 3)),
        np.zeros((n_poses, 3)),
        np.zeros((n_tracks, 3, 3)),
        np.zeros((n_tracks, 3)),
        of_offset,
        of_offset[:, None] * at.offset_m,
        np.empty((len(seen), 3, 3)),
    )
    _add_observations(seen.arrays, at, turns(at.path), weights.observation, made)
    _add_odometry(at.path, odometry, information, made)
    return made


def _add_odometry(path: Float, odometry: Float, information: Float, made: NormalEquations) -> None:
    n = len(path) - 1
    d = disturbances(path, odometry)
    before, after = disturbance_jacobians(path)
    for J, at in ((before, slice(0, n)), (after, slice(1, n + 1))):
        weighted = np.swapaxes(J, 1, 2) * information[:, None, :]
        made.pose_block[at] += weighted @ J
        made.pose_gradient[at] += np.einsum("nij,nj->ni", weighted, d)
    made.link[:] = (np.swapaxes(after, 1, 2) * information[:, None, :]) @ before


@njit(cache=True)
def _add_observations(
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    turn: Float,
    weight: Float,
    made: NormalEquations,
) -> None:
    starts, owner, frame, position, information = seen
    W, e, J = np.empty((3, 3)), np.empty(3), np.zeros((3, 3))
    half, R = np.empty((3, 3)), np.zeros((3, 3))
    for t in range(len(starts) - 1):
        point = at.point_m[owner[t]] + at.offset_m[t]
        A, b = made.track_block[t], made.track_gradient[t]
        for i in range(starts[t], starts[t + 1]):
            k = frame[i]
            _put_rotation(turn[k], R)
            _put_in_map_frame(R, information[i], weight[i], half, W)
            _put_residual(at.path[k], point, R, position[i], e, J)
            H, block = made.coupling[i], made.pose_block[k]
            for r in range(3):
                for q in range(3):
                    A[r, q] += W[r, q]
                    H[r, q] = J[0, r] * W[0, q] + J[1, r] * W[1, q] + J[2, r] * W[2, q]
            for r in range(3):
                b[r] += W[r, 0] * e[0] + W[r, 1] * e[1] + W[r, 2] * e[2]
                made.pose_gradient[k, r] += H[r, 0] * e[0] + H[r, 1] * e[1] + H[r, 2] * e[2]
                for q in range(3):
                    block[r, q] += H[r, 0] * J[0, q] + H[r, 1] * J[1, q] + H[r, 2] * J[2, q]


@njit(cache=True)
def _put_rotation(turn: Float, R: Float) -> None:
    c, s = turn
    R[0, 0], R[0, 1], R[1, 0], R[1, 1], R[2, 2] = c, -s, s, c, 1.0


@njit(cache=True)
def _put_in_map_frame(R: Float, information: Float, weight: float, half: Float, W: Float) -> None:
    """The information of an observation, in the map frame: weight R information R'."""
    for r in range(3):
        for q in range(3):
            half[r, q] = (
                R[r, 0] * information[0, q]
                + R[r, 1] * information[1, q]
                + R[r, 2] * information[2, q]
            )
    for r in range(3):
        for q in range(3):
            W[r, q] = weight * (half[r, 0] * R[q, 0] + half[r, 1] * R[q, 1] + half[r, 2] * R[q, 2])


@njit(cache=True)
def _put_residual(pose: Float, point: Float, R: Float, seen_at: Float, e: Float, J: Float) -> None:
    """The residual e of one observation in the map frame, and de/dx."""
    for r in range(3):
        e[r] = point[r] - R[r, 0] * seen_at[0] - R[r, 1] * seen_at[1] - R[r, 2] * seen_at[2]
    e[0] -= pose[0]
    e[1] -= pose[1]
    J[0, 0] = J[1, 1] = -1.0
    J[0, 2], J[1, 2] = point[1] - pose[1], pose[0] - point[0]
