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
    add_along,
    inner_kernel,
    kernel,
    kernel_part,
    put_along,
    put_inverse,
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
    n_tracks, n_landmarks = len(seen.strays), seen.n_landmarks
    left = Reduced(
        np.zeros((n_tracks, 3, 3)),
        equations.track_gradient + equations.offset_gradient,
        np.zeros((n_tracks, 3, 3)),
        np.zeros((n_landmarks, 3)),
        np.empty((n_landmarks, 3, 3)),
    )
    planar = seen.n_dimensions == 2
    if not _reduce(seen.by_landmark, seen.strays, planar, equations, left):
        raise np.linalg.LinAlgError("the information of a point is singular")
    return left


@kernel
def _reduce(
    rows: tuple[np.ndarray, np.ndarray, np.ndarray],
    strays: np.ndarray,
    planar: bool,
    equations: PointEquations,
    left: Reduced,
) -> bool:
    """Write the reduced equations; return False if a block is singular."""
    _, first_track, _ = rows
    block, known, inverse = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    S, P, G, K = equations.track_block, equations.offset_information, left.own_m2, left.kept
    for j in range(len(first_track) - 1):
        for r in range(3):
            for q in range(3):
                block[r, q] = 0.0
        for t in range(first_track[j], first_track[j + 1]):
            if strays[t]:
                for r in range(3):
                    for q in range(3):
                        known[r, q] = S[t, r, q]
                    known[r, r] += P[t]
                if not put_inverse(known, inverse):
                    return False
                for r in range(3):
                    for q in range(3):
                        G[t, r, q], K[t, r, q] = inverse[r, q], P[t] * inverse[r, q]
            else:
                for r in range(3):
                    K[t, r, r] = 1.0
            _add_track(equations, left, j, t, block)
        if planar:
            block[2, 2] = 1.0
        if not put_inverse(block, inverse):
            return False
        for r in range(3):
            for q in range(3):
                left.landmark_m2[j, r, q] = inverse[r, q]
    return True


@kernel_part
def _add_track(equations: PointEquations, left: Reduced, j: int, t: int, block: Float) -> None:
    """Add the reduced equations of a track to its landmark's block and gradient."""
    S, gradient, G, K = equations.track_block, equations.track_gradient, left.own_m2, left.kept
    a, b, c = left.pull[t, 0], left.pull[t, 1], left.pull[t, 2]
    x = G[t, 0, 0] * a + G[t, 0, 1] * b + G[t, 0, 2] * c
    y = G[t, 1, 0] * a + G[t, 1, 1] * b + G[t, 1, 2] * c
    z = G[t, 2, 0] * a + G[t, 2, 1] * b + G[t, 2, 2] * c
    for r in range(3):
        a, b, c = S[t, r, 0], S[t, r, 1], S[t, r, 2]
        left.point_gradient[j, r] += gradient[t, r] - (a * x + b * y + c * z)
        for q in range(3):
            block[r, q] += a * K[t, 0, q] + b * K[t, 1, q] + c * K[t, 2, q]


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
    points, offsets = np.empty((seen.n_landmarks, 3)), np.empty((len(seen.strays), 3))
    _put_moved(seen.first_track, equations.track_block, left, along, points, offsets)
    return points, offsets


@kernel
def _put_moved(
    first_track: np.ndarray,
    block: Float,
    left: Reduced,
    along: Float,
    points: Float,
    offsets: Float,
) -> None:
    asked, way, moved = np.empty(3), np.empty(3), np.empty(3)
    for j in range(len(first_track) - 1):
        for q in range(3):
            asked[q] = left.point_gradient[j, q]
        for t in range(first_track[j], first_track[j + 1]):
            for q in range(3):
                way[q] = along[t, q]
            add_along(left.kept, t, way, asked)  # it is symmetric
        put_along(left.landmark_m2, j, asked, moved)
        for q in range(3):
            points[j, q] = way[q] = -moved[q]
        for t in range(first_track[j], first_track[j + 1]):
            for q in range(3):
                asked[q] = left.pull[t, q] + along[t, q]
            add_along(block, t, way, asked)
            put_along(left.own_m2, t, asked, moved)
            for q in range(3):
                offsets[t, q] = -moved[q]


class Points(NamedTuple):
    """Covariances for a known path.

    Attributes:
        offset_m2: covariance of each track's offset, shape (B, 3, 3).
        track_m2: covariance of each track's point, shape (B, 3, 3).
    """

    offset_m2: Float
    track_m2: Float


def known_points(seen: Sightings, left: Reduced) -> Points:
    """Return the covariances of offsets and tracks' points for a known path."""
    made = np.empty((2, *left.own_m2.shape))
    _put_known(seen.landmark_of_track, left, made)
    return Points(made[0], made[1])


@kernel
def _put_known(landmark: np.ndarray, left: Reduced, made: Float) -> None:
    """Write G plus the propagated covariance of the landmark, for offsets and for points."""
    A, G, kept = left.landmark_m2, left.own_m2, left.kept
    follows, half = np.empty((3, 3)), np.empty((3, 3))
    for which in range(2):
        for t in range(len(landmark)):
            j = landmark[t]
            for r in range(3):
                for q in range(3):
                    follows[r, q] = kept[t, r, q]
                    if which == 0:  # -db / dl
                        follows[r, q] = (1.0 if r == q else 0.0) - kept[t, r, q]
            for r in range(3):
                x, y, z = follows[r, 0], follows[r, 1], follows[r, 2]
                for q in range(3):
                    half[r, q] = x * A[j, 0, q] + y * A[j, 1, q] + z * A[j, 2, q]
            for r in range(3):
                x, y, z = half[r, 0], half[r, 1], half[r, 2]
                for q in range(3):
                    moved = x * follows[0, q] + y * follows[1, q] + z * follows[2, q]
                    made[which, t, r, q] = G[t, r, q] + moved


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
                _put_gains(left, j, t, coupling, coupling_left, i, by_landmark, by_track)
                _add_product(by_landmark, left.kept, t, by_track)
                _subtract_rows(by_landmark, starts[j], own, i, place, coupling_left, offset, S)
                _subtract_rows(by_track, own, i, i, place, coupling, offset, S)
                _subtract_own(by_track, coupling, i, 3 * place[i], offset, S)


# Kernels take an array and a row: a view of a row costs more than the sums.
@kernel_part
def _put_gains(
    left: Reduced,
    j: int,
    t: int,
    coupling: Float,
    coupling_left: Float,
    i: int,
    by_landmark: Float,
    by_track: Float,
) -> None:
    A, G = left.landmark_m2, left.own_m2
    for r in range(3):
        x, y, z = coupling_left[i, r, 0], coupling_left[i, r, 1], coupling_left[i, r, 2]
        for q in range(3):
            by_landmark[r, q] = x * A[j, 0, q] + y * A[j, 1, q] + z * A[j, 2, q]
        x, y, z = coupling[i, r, 0], coupling[i, r, 1], coupling[i, r, 2]
        for q in range(3):
            by_track[r, q] = x * G[t, 0, q] + y * G[t, 1, q] + z * G[t, 2, q]


@kernel_part
def _add_product(A: Float, B: Float, t: int, total: Float) -> None:
    for r in range(3):
        for q in range(3):
            total[r, q] += A[r, 0] * B[t, 0, q] + A[r, 1] * B[t, 1, q] + A[r, 2] * B[t, 2, q]


@inner_kernel
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


@kernel_part
def _subtract_own(
    X: Float, coupling: Float, i: int, row: int, offset: np.ndarray, S: Float
) -> None:
    for q in range(3):
        a, b, c = coupling[i, q, 0], coupling[i, q, 1], coupling[i, q, 2]
        for r in range(3):
            at = offset[row + r] + row + q
            S[at] -= X[r, 0] * a + X[r, 1] * b + X[r, 2] * c


def left_couplings(seen: Sightings, coupling: Float, left: Reduced) -> Float:
    """Return the blocks (N, 3, 3) of pose and landmark after the offsets are eliminated."""
    made = np.empty_like(coupling)
    _put_left(seen.track_starts, coupling, left.kept, made)
    return made


@kernel
def _put_left(track_starts: np.ndarray, coupling: Float, kept: Float, made: Float) -> None:
    for t in range(len(kept)):
        for i in range(track_starts[t], track_starts[t + 1]):
            for r in range(3):
                x, y, z = coupling[i, r, 0], coupling[i, r, 1], coupling[i, r, 2]
                for q in range(3):
                    made[i, r, q] = x * kept[t, 0, q] + y * kept[t, 1, q] + z * kept[t, 2, q]


def along_way(seen: Sightings, coupling: Float, way: Float) -> Float:
    """Sum coupling' way over the observations of each track, shape (B, 3); `way` is (T, 3)."""
    total = np.zeros((len(seen.strays), 3))
    _add_along_way(seen.track_starts, seen.frame, coupling, way, total)
    return total


@kernel
def _add_along_way(
    track_starts: np.ndarray, frame: np.ndarray, coupling: Float, way: Float, total: Float
) -> None:
    for t in range(len(total)):
        for i in range(track_starts[t], track_starts[t + 1]):
            x, y, turned = way[frame[i], 0], way[frame[i], 1], way[frame[i], 2]
            for q in range(3):
                total[t, q] += coupling[i, 0, q] * x + coupling[i, 1, q] * y
                total[t, q] += coupling[i, 2, q] * turned


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
