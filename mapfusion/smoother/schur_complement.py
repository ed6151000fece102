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
from mapfusion.smoother.normal_equations import NormalEquations, PointEquations
from mapfusion.smoother.problem import Sightings


class Reduced(NamedTuple):
    """Equations after the offsets are eliminated, without the blocks of two poses.

    Attributes:
        own_m2: G of each track, shape (B, 3, 3).
        pull: gradient of each offset, shape (B, 3).
        kept: 1 - G S, the derivative of the track's point by the landmark, shape (B, 3, 3).
        point_gradient: shape (L, 3).
        landmark_m2: covariance of each landmark for a known path, shape (L, 3, 3); in planar data z
            is not observed and has variance 1.
    """

    own_m2: Float
    pull: Float
    kept: Float
    point_gradient: Float
    landmark_m2: Float


def without_offsets(seen: Sightings, equations: PointEquations) -> Reduced:
    """Eliminate the offsets.

    Raises:
        LinAlgError: the information of a point is singular.
    """
    S, strays, P = equations.track_block, seen.strays, equations.offset_information[seen.strays]
    own_m2, kept = np.zeros(S.shape), np.tile(np.eye(3), (len(S), 1, 1))
    own_m2[strays] = inverses(S[strays] + P[:, None, None] * np.eye(3))
    kept[strays] = P[:, None, None] * own_m2[strays]
    pull = equations.track_gradient + equations.offset_gradient
    gradient = equations.track_gradient - times_vectors(S, times_vectors(own_m2, pull))
    owner, n = seen.landmark_of_track, seen.n_landmarks
    block = sums_by(owner, times_blocks(S, kept), n)
    if seen.n_dimensions == 2:
        block[:, 2, 2] = 1.0
    return Reduced(own_m2, pull, kept, sums_by(owner, gradient, n), inverses(block))


def moved_points(
    seen: Sightings, equations: PointEquations, left: Reduced, along: Float
) -> tuple[Float, Float]:
    """Return the steps of landmarks (L, 3) and offsets (B, 3).

    Args:
        seen: the observations.
        equations: the equations of the points.
        left: the equations after the offsets are eliminated.
        along: sum of coupling' dx for each track, where dx is the step of the path, shape (B, 3).
    """
    owner, n = seen.landmark_of_track, seen.n_landmarks
    asked = np.concatenate([left.point_gradient, times_vectors(left.kept, along)])
    asked = sums_by(np.concatenate([np.arange(n), owner]), asked, n)
    points = -times_vectors(left.landmark_m2, asked)
    asked = left.pull + along + times_vectors(equations.track_block, points[owner])
    return points, -times_vectors(left.own_m2, asked)


class Points(NamedTuple):
    """Covariances for a known path.

    Attributes:
        offset_m2: covariance of each track's offset, shape (B, 3, 3).
        track_m2: covariance of each track's point, shape (B, 3, 3).
    """

    offset_m2: Float
    track_m2: Float


def known_points(seen: Sightings, left: Reduced) -> Points:
    """What is known of offsets and tracks' points, their landmark's own covariance in it."""
    of_landmark = left.landmark_m2[seen.landmark_of_track]
    made = [
        left.own_m2 + times_blocks(times_blocks(follows, of_landmark), follows)
        for follows in (np.eye(3) - left.kept, left.kept)  # -db / dl, and that of the point
    ]
    return Points(*made)


def subtract_points(seen: Sightings, equations: NormalEquations, left: Reduced, S: Float) -> None:
    """Subtract the terms of offsets and landmarks from the matrix of the poses.

    Args:
        seen: the observations.
        equations: the normal equations.
        left: the equations after the offsets are eliminated.
        S: entries of the matrix of the unknown poses, in `seen.order.envelope`.
    """
    coupling, offset = equations.coupling, seen.order.envelope.offset
    couplings = coupling, left_couplings(seen, coupling, left)
    _subtract(seen.by_landmark, seen.unknown_place, couplings, left, offset, S)


@kernel
def _subtract(
    rows: tuple[np.ndarray, np.ndarray, np.ndarray],
    place: np.ndarray,
    couplings: tuple[Float, Float],
    left: Reduced,
    offset: np.ndarray,
    S: Float,
) -> None:
    (starts, first_track, track_starts), (coupling, coupling_left) = rows, couplings
    by_landmark, by_track = np.empty((3, 3)), np.empty((3, 3))  # H K A, and H (K A K' + G)
    for j in range(len(starts) - 1):
        for t in range(first_track[j], first_track[j + 1]):
            own = track_starts[t]
            for i in range(own, track_starts[t + 1]):
                if place[i] < 0:
                    continue
                A, G = left.landmark_m2, left.own_m2
                for r in range(3):
                    x, y, z = coupling_left[i, r, 0], coupling_left[i, r, 1], coupling_left[i, r, 2]
                    for q in range(3):
                        by_landmark[r, q] = x * A[j, 0, q] + y * A[j, 1, q] + z * A[j, 2, q]
                    x, y, z = coupling[i, r, 0], coupling[i, r, 1], coupling[i, r, 2]
                    for q in range(3):
                        by_track[r, q] = x * G[t, 0, q] + y * G[t, 1, q] + z * G[t, 2, q]
                B = left.kept
                for r in range(3):
                    for q in range(3):
                        by_track[r, q] += (
                            by_landmark[r, 0] * B[t, 0, q]
                            + by_landmark[r, 1] * B[t, 1, q]
                            + by_landmark[r, 2] * B[t, 2, q]
                        )
                _subtract_rows(by_landmark, starts[j], own, i, place, coupling_left, offset, S)
                _subtract_rows(by_track, own, i, i, place, coupling, offset, S)
                row = 3 * place[i]
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
    place: np.ndarray,
    coupling: Float,
    offset: np.ndarray,
    S: Float,
) -> None:
    """Subtract X coupling' from the blocks of observation i with rows `begin` to `end`."""
    x00, x01, x02 = X[0, 0], X[0, 1], X[0, 2]  # `S` may not be where `X` is, no compiler knows
    x10, x11, x12 = X[1, 0], X[1, 1], X[1, 2]
    x20, x21, x22 = X[2, 0], X[2, 1], X[2, 2]
    row = 3 * place[i]
    at0, at1, at2 = offset[row], offset[row + 1], offset[row + 2]
    for k in range(begin, end):
        column = 3 * place[k]
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
            if column >= row:  # rows are not in the order of places, and one pose may have several
                at = offset[column + q] + row
                S[at] -= v0
                S[at + 1] -= v1
                S[at + 2] -= v2


def left_couplings(seen: Sightings, coupling: Float, left: Reduced) -> Float:
    """(N, 3, 3) a pose's block with a landmark once offsets are eliminated, by observation."""
    return times_blocks(coupling, left.kept[seen.track])


def along_way(seen: Sightings, coupling: Float, way: Float) -> Float:
    """(B, 3) sum of coupling' way over the observations of each track; `way` (T, 3) by frame."""
    moved, turned = way[seen.frame, :2, None], way[seen.frame, 2, None]
    parts = coupling[:, 0] * moved[:, 0] + coupling[:, 1] * moved[:, 1], coupling[:, 2] * turned
    both = np.stack(parts, axis=1).reshape(-1, 3)
    return sums_by(np.repeat(seen.track, 2), both, len(seen.strays))


def along_points(seen: Sightings, coupling: Float, point: Float, offset: Float) -> Float:
    """Sum coupling (point + offset) over the observations of each frame, shape (T, 3).

    Args:
        seen: the observations.
        coupling: blocks of pose and landmark, shape (N, 3, 3).
        point: step of each landmark, shape (L, 3).
        offset: step of each track's offset, shape (B, 3).
    """
    total = np.zeros((seen.order.n_poses, 3))
    _add_along_points(
        seen.track_starts, seen.landmark_of_track, seen.frame, coupling, point, offset, total
    )
    return total


@kernel
def _add_along_points(
    track_starts: np.ndarray,
    owner: np.ndarray,
    frame: np.ndarray,
    coupling: Float,
    point: Float,
    offset: Float,
    total: Float,
) -> None:
    for t in range(len(owner)):
        j = owner[t]
        x, y, z = point[j, 0] + offset[t, 0], point[j, 1] + offset[t, 1], point[j, 2] + offset[t, 2]
        for i in range(track_starts[t], track_starts[t + 1]):
            for r in range(3):
                total[frame[i], r] += (
                    coupling[i, r, 0] * x + coupling[i, r, 1] * y + coupling[i, r, 2] * z
                )
