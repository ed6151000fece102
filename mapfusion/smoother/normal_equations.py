"""The normal equations of a log at a guess of path and landmarks.

An observation z of landmark l from pose x = (p, theta) has the residual e = R (R^T (l - p) - z),
turned into the map frame, so that de/dl = I and de/dx = J = [-I, lever]. The lever arm of the
rotation is the landmark's own position: with the observed point instead, whose error is also in z,
rotations are biased. With W the information in the map frame the equations of a step are

    pose_block dx + link dx' + coupling dl = -pose_gradient,    coupling = J' W
    coupling' dx + point_block dl = -point_gradient,            point_block = sum W
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
    """Path (T, 3) and landmarks (L, 3), in the frame of the first pose."""

    path: Float
    point_m: Float


class NormalEquations(NamedTuple):
    """Of T poses and L landmarks, by blocks.

    Attributes:
        pose_block: (T, 3, 3).
        link: (T - 1, 3, 3) each pose's block with the pose before it.
        pose_gradient: (T, 3).
        point_block: (L, 3, 3).
        point_gradient: (L, 3).
        coupling: (N, 3, 3) a pose's block with a landmark, by observation.
        between: (3T, 3T) lower half of what errors that views share add between poses, if any.
    """

    pose_block: Float
    link: Float
    pose_gradient: Float
    point_block: Float
    point_gradient: Float
    coupling: Float
    between: Float | None = None


def odometry_information(odometry: Float, noise: MotionNoise) -> Float:
    """(T - 1, 3) inverse variances of the increments (T, 3) after the first, which is no motion."""
    sigma = np.array([noise.standard_deviations(each) for each in odometry[1:]]).reshape(-1, 3)
    return 1.0 / (sigma**2 + _STILL**2)


def disturbances(path: Float, odometry: Float) -> Float:
    """(T - 1, 3) d of eq. 3 on this path: x_k = x_(k-1) + (u_k + d)."""
    found = between(path[:-1], path[1:]) - odometry[1:]
    found[:, 2] = wrap(found[:, 2])
    return found


def no_equations(seen: Sightings, at: Estimate) -> NormalEquations:
    """To be added to."""
    n_poses, n_points = len(at.path), len(at.point_m)
    return NormalEquations(
        np.zeros((n_poses, 3, 3)),
        np.zeros((n_poses - 1, 3, 3)),
        np.zeros((n_poses, 3)),
        np.zeros((n_points, 3, 3)),
        np.zeros((n_points, 3)),
        np.empty((len(seen), 3, 3)),
    )


def add_observations(seen: Sightings, at: Estimate, weight: Float, made: NormalEquations) -> None:
    """Add observations whose errors are independent, with factors (N,) on their information."""
    _add_observations(seen.arrays, at, weight, made)


def add_odometry(path: Float, odometry: Float, information: Float, made: NormalEquations) -> None:
    """Add increments (T, 3) of information (T - 1, 3) on the path (T, 3)."""
    n = len(path) - 1
    d = disturbances(path, odometry)
    to_robot = np.swapaxes(rotation(path[:-1, 2]), 1, 2)
    way = path[1:, :2] - path[:-1, :2]
    before, after = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))  # of d, by either pose
    after[:, :2, :2], after[:, 2, 2] = to_robot, 1.0
    before[:, :2, :2], before[:, 2, 2] = -to_robot, -1.0
    before[:, :2, 2] = np.einsum("nij,nj->ni", to_robot, np.stack([way[:, 1], -way[:, 0]], 1))
    for J, at in ((before, slice(0, n)), (after, slice(1, n + 1))):
        weighted = np.swapaxes(J, 1, 2) * information[:, None, :]
        made.pose_block[at] += weighted @ J
        made.pose_gradient[at] += np.einsum("nij,nj->ni", weighted, d)
    made.link[:] = (np.swapaxes(after, 1, 2) * information[:, None, :]) @ before


@njit(cache=True)
def _add_observations(
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    weight: Float,
    made: NormalEquations,
) -> None:
    starts, frame, position, information = seen
    for j in range(len(starts) - 1):
        A, b = made.point_block[j], made.point_gradient[j]
        for i in range(starts[j], starts[j + 1]):
            k = frame[i]
            W, e, J = linearised(at.path[k], at.point_m[j], position[i], information[i])
            H, block = made.coupling[i], made.pose_block[k]
            for r in range(3):
                for q in range(3):
                    W[r, q] *= weight[i]
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
def linearised(
    pose: Float, point: Float, seen_at: Float, information: Float
) -> tuple[Float, Float, Float]:
    """W, e and de/dx of one observation, in the map frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    W, e, J = np.empty((3, 3)), np.empty(3), np.zeros((3, 3))
    for r in range(3):
        for q in range(3):
            total = 0.0
            for u in range(3):
                for v in range(3):
                    total += R[r, u] * information[u, v] * R[q, v]
            W[r, q] = total
        e[r] = point[r] - R[r, 0] * seen_at[0] - R[r, 1] * seen_at[1] - R[r, 2] * seen_at[2]
    e[0] -= pose[0]
    e[1] -= pose[1]
    J[0, 0] = J[1, 1] = -1.0
    J[0, 2], J[1, 2] = point[1] - pose[1], pose[0] - point[0]
    return W, e, J
