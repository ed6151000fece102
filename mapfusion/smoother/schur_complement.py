"""Schur complements: eliminate track offsets and landmarks from the normal equations.

Let S be the track block, P the information of the offset and G = (S + P)^-1 its covariance for a
known path and landmark. Eliminating b_t leaves the Schur complement

    coupling (1 - G S)                  of pose and landmark
    - coupling G coupling'              between all poses that saw the track
    sum over tracks of S (1 - G S)      of the landmark

and the corresponding gradients. A track without an offset has G = 0. As P is the same along each
axis, 1 - G S = P G.

Let H_i be the block of pose and point of observation i, G_t the covariance of its track's offset
for a known path and landmark, K_t = 1 - G_t S_t, and A the covariance of its landmark for a known
path. Observations i, k of tracks t, u of one landmark subtract from the block of their poses

    H_i (K_t A K_u' + G_t if t = u) H_k'.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import (
    Float,
    inverses,
    kernel,
    sums_by,
    times_blocks,
    times_vectors,
)
from mapfusion.smoother.normal_equations import PointEquations
from mapfusion.smoother.problem import OrderedObservations


class ReducedEquations(NamedTuple):
    """Equations after the offsets are eliminated, without the blocks of two poses.

    Attributes:
        own_m2: G of each track, shape (B, 3, 3).
        offset_gradient: gradient of each offset, shape (B, 3).
        point_by_landmark: 1 - G S, derivative of the track's point by the landmark, shape
            (B, 3, 3).
        point_gradient: shape (L, 3).
        landmark_m2: covariance of each landmark for a known path, shape (L, 3, 3); in planar data z
            is not observed and has variance 1.
    """

    own_m2: Float
    offset_gradient: Float
    point_by_landmark: Float
    point_gradient: Float
    landmark_m2: Float


def eliminate_offsets(obs: OrderedObservations, equations: PointEquations) -> ReducedEquations:
    """Eliminate the offsets.

    Raises:
        LinAlgError: the information of a point is singular.
    """
    S, has_offset = equations.track_block, obs.has_offset
    P = equations.offset_information[has_offset]
    own_m2, point_by_landmark = np.zeros(S.shape), np.tile(np.eye(3), (len(S), 1, 1))
    own_m2[has_offset] = inverses(S[has_offset] + P[:, None, None] * np.eye(3))
    point_by_landmark[has_offset] = P[:, None, None] * own_m2[has_offset]
    offset_gradient = equations.track_gradient + equations.offset_gradient
    gradient = equations.track_gradient - times_vectors(S, times_vectors(own_m2, offset_gradient))
    owner, n = obs.landmark_of_track, obs.n_landmarks
    block = sums_by(owner, times_blocks(S, point_by_landmark), n)
    if obs.n_dimensions == 2:
        block[:, 2, 2] = 1.0
    return ReducedEquations(
        own_m2, offset_gradient, point_by_landmark, sums_by(owner, gradient, n), inverses(block)
    )


def substitute_points(
    obs: OrderedObservations, equations: PointEquations, reduced: ReducedEquations, path_term: Float
) -> tuple[Float, Float]:
    """Return the steps of landmarks (L, 3) and offsets (B, 3).

    Args:
        obs: the observations.
        equations: the equations of the points.
        reduced: the equations after the offsets are eliminated.
        path_term: sum of coupling' dx over each track, with the step dx of the path, shape
            (B, 3).
    """
    owner, n = obs.landmark_of_track, obs.n_landmarks
    right = np.concatenate(
        [reduced.point_gradient, times_vectors(reduced.point_by_landmark, path_term)]
    )
    right = sums_by(np.concatenate([np.arange(n), owner]), right, n)
    points = -times_vectors(reduced.landmark_m2, right)
    right = reduced.offset_gradient + path_term
    right = right + times_vectors(equations.track_block, points[owner])
    return points, -times_vectors(reduced.own_m2, right)


class PointCovariances(NamedTuple):
    """Covariances for a known path.

    Attributes:
        offset_m2: covariance of each track's offset, shape (B, 3, 3).
        track_m2: covariance of each track's point, shape (B, 3, 3).
    """

    offset_m2: Float
    track_m2: Float


def point_covariances(obs: OrderedObservations, reduced: ReducedEquations) -> PointCovariances:
    """Return the covariances of offsets and tracks' points for a known path."""
    of_landmark = reduced.landmark_m2[obs.landmark_of_track]
    # derivatives of the (negative) offset and of the point by the landmark
    jacobians = np.eye(3) - reduced.point_by_landmark, reduced.point_by_landmark
    return PointCovariances(
        *(reduced.own_m2 + times_blocks(times_blocks(J, of_landmark), J) for J in jacobians)
    )


@kernel
def subtract_point_terms(
    rows: tuple[np.ndarray, np.ndarray, np.ndarray],
    unknown_index: np.ndarray,
    couplings: tuple[Float, Float],
    reduced: ReducedEquations,
    offset: np.ndarray,
    S: Float,
) -> None:
    """Subtract the terms of offsets and landmarks from the matrix of the poses.

    Args:
        rows: `OrderedObservations.by_landmark`.
        unknown_index: `OrderedObservations.unknown_index`.
        couplings: those of poses and landmarks, as stated and from `reduced_couplings`.
        reduced: the equations after the offsets are eliminated.
        offset: offsets of the rows of the envelope.
        S: entries of the matrix of the unknown poses, in the envelope.
    """
    (starts, first_track, track_starts), (coupling, coupling_left) = rows, couplings
    by_landmark, by_track = np.empty((3, 3)), np.empty((3, 3))  # H K A, and H (K A K' + G)
    for j in range(len(starts) - 1):
        for t in range(first_track[j], first_track[j + 1]):
            t0 = track_starts[t]
            for i in range(t0, track_starts[t + 1]):
                if unknown_index[i] < 0:
                    continue
                A, G = reduced.landmark_m2, reduced.own_m2
                for r in range(3):
                    x, y, z = coupling_left[i, r, 0], coupling_left[i, r, 1], coupling_left[i, r, 2]
                    for q in range(3):
                        by_landmark[r, q] = x * A[j, 0, q] + y * A[j, 1, q] + z * A[j, 2, q]
                    x, y, z = coupling[i, r, 0], coupling[i, r, 1], coupling[i, r, 2]
                    for q in range(3):
                        by_track[r, q] = x * G[t, 0, q] + y * G[t, 1, q] + z * G[t, 2, q]
                B = reduced.point_by_landmark
                for r in range(3):
                    for q in range(3):
                        by_track[r, q] += (
                            by_landmark[r, 0] * B[t, 0, q]
                            + by_landmark[r, 1] * B[t, 1, q]
                            + by_landmark[r, 2] * B[t, 2, q]
                        )
                _subtract_rows(
                    by_landmark, starts[j], t0, i, unknown_index, coupling_left, offset, S
                )
                _subtract_rows(by_track, t0, i, i, unknown_index, coupling, offset, S)
                row = 3 * unknown_index[i]
                for q in range(3):
                    a, b, c = coupling[i, q, 0], coupling[i, q, 1], coupling[i, q, 2]
                    for r in range(3):
                        at = offset[row + r] + row + q
                        S[at] -= by_track[r, 0] * a + by_track[r, 1] * b + by_track[r, 2] * c


@kernel
def _subtract_rows(
    X: Float,
    begin: int,
    end: int,
    i: int,
    unknown_index: np.ndarray,
    coupling: Float,
    offset: np.ndarray,
    S: Float,
) -> None:
    """Subtract X coupling' from the blocks of observation i with rows `begin` to `end`."""
    x00, x01, x02 = X[0, 0], X[0, 1], X[0, 2]  # local, because X and S may overlap for the compiler
    x10, x11, x12 = X[1, 0], X[1, 1], X[1, 2]
    x20, x21, x22 = X[2, 0], X[2, 1], X[2, 2]
    row = 3 * unknown_index[i]
    at0, at1, at2 = offset[row], offset[row + 1], offset[row + 2]
    for k in range(begin, end):
        column = 3 * unknown_index[k]
        if column < 0:
            continue
        for q in range(3):
            a, b, c = coupling[k, q, 0], coupling[k, q, 1], coupling[k, q, 2]
            v0 = x00 * a + x01 * b + x02 * c
            v1 = x10 * a + x11 * b + x12 * c
            v2 = x20 * a + x21 * b + x22 * c
            if column <= row:
                S[at0 + column + q] -= v0
                S[at1 + column + q] -= v1
                S[at2 + column + q] -= v2
            if column >= row:  # one pose may have several observations, in any order
                at = offset[column + q] + row
                S[at] -= v0
                S[at + 1] -= v1
                S[at + 2] -= v2


def reduced_couplings(
    obs: OrderedObservations, coupling: Float, reduced: ReducedEquations
) -> Float:
    """Return the blocks of pose and landmark (N, 3, 3) after the offsets are eliminated."""
    return times_blocks(coupling, reduced.point_by_landmark[obs.track])


def coupling_times_poses(obs: OrderedObservations, coupling: Float, path_step: Float) -> Float:
    """Sum coupling' path_step over the observations of each track, shape (B, 3).

    Args:
        obs: the observations.
        coupling: blocks of pose and landmark, shape (N, 3, 3).
        path_step: step of each pose, shape (T, 3).
    """
    total = np.zeros((len(obs.has_offset), 3))
    _add_coupling_times_poses(obs.track, obs.frame, coupling, path_step, total)
    return total


@kernel
def _add_coupling_times_poses(
    track: np.ndarray, frame: np.ndarray, coupling: Float, path_step: Float, total: Float
) -> None:
    """Add coupling' path_step of each observation to the total of its track."""
    for i in range(len(track)):
        x, y, turn = path_step[frame[i], 0], path_step[frame[i], 1], path_step[frame[i], 2]
        for q in range(3):
            total[track[i], q] += (
                coupling[i, 0, q] * x + coupling[i, 1, q] * y + coupling[i, 2, q] * turn
            )


def coupling_times_points(
    obs: OrderedObservations, coupling: Float, point: Float, offset: Float
) -> Float:
    """Sum coupling (point + offset) over the observations of each frame, shape (T, 3).

    Args:
        obs: the observations.
        coupling: blocks of pose and landmark, shape (N, 3, 3).
        point: step of each landmark, shape (L, 3).
        offset: step of each track's offset, shape (B, 3).
    """
    total = np.zeros((obs.order.n_poses, 3))
    _add_coupling_times_points(
        obs.track_starts, obs.landmark_of_track, obs.frame, coupling, point, offset, total
    )
    return total


@kernel
def _add_coupling_times_points(
    track_starts: np.ndarray,
    owner: np.ndarray,
    frame: np.ndarray,
    coupling: Float,
    point: Float,
    offset: Float,
    total: Float,
) -> None:
    """Add coupling (point + offset) of each observation to the total of its frame."""
    for t in range(len(owner)):
        j = owner[t]
        x, y, z = point[j, 0] + offset[t, 0], point[j, 1] + offset[t, 1], point[j, 2] + offset[t, 2]
        for i in range(track_starts[t], track_starts[t + 1]):
            for r in range(3):
                total[frame[i], r] += (
                    coupling[i, r, 0] * x + coupling[i, r, 1] * y + coupling[i, r, 2] * z
                )
