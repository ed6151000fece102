"""Schur complements: eliminate track offsets and landmarks from the normal equations.

With S the track block, P the information of the offset and G = (S + P)^-1 its covariance if path
and landmark were known, eliminating b_t leaves (a Schur complement)

    coupling (1 - G S)                  of pose and landmark
    - coupling G coupling'              between all poses that saw the track
    sum over tracks of S (1 - G S)      of the landmark

and likewise the gradients. Poses that share a track are so tied to each other more than to the
landmark. A track that does not stray has G = 0. As P is the same along each axis, 1 - G S = P G.

With H_i an observation's block of pose and point, G_t the covariance of its track's offset if path
and landmark were known, K_t = 1 - G_t S_t, and A the covariance of its landmark if the path were
known, observations i, k of tracks t, u of one landmark take from what their poses have in common

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
    """The equations without the offsets, but for what is between poses.

    Attributes:
        own_m2: (B, 3, 3) G of each track.
        pull: (B, 3) the gradient of each offset.
        kept: (B, 3, 3) 1 - G S, the share of a landmark's motion that its track's point takes part
            in.
        point_gradient: (L, 3).
        landmark_m2: (L, 3, 3) covariance of each landmark if the path were known; in planar data,
            which say nothing of z, that has a variance of 1 of its own.
    """

    own_m2: Float
    pull: Float
    kept: Float
    point_gradient: Float
    landmark_m2: Float


def without_offsets(seen: Sightings, equations: PointEquations) -> Reduced:
    """Eliminate the offsets; the blocks between poses are left to do, with `own_m2` and `pull`.

    Raises:
        LinAlgError: what is known of some point, is not to be inverted.
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
    """The step of landmarks (L, 3) and offsets (B, 3).

    Args:
        seen: the observations.
        equations: theirs.
        left: once the offsets are eliminated.
        along: (B, 3) what the step of the path asks of each track, sum of coupling' dx.
    """
    owner, n = seen.landmark_of_track, seen.n_landmarks
    asked = np.concatenate([left.point_gradient, times_vectors(left.kept, along)])
    asked = sums_by(np.concatenate([np.arange(n), owner]), asked, n)
    points = -times_vectors(left.landmark_m2, asked)
    asked = left.pull + along + times_vectors(equations.track_block, points[owner])
    return points, -times_vectors(left.own_m2, asked)


class Points(NamedTuple):
    """Covariances if the path were known.

    Attributes:
        offset_m2: (B, 3, 3) of each track's offset.
        track_m2: (B, 3, 3) of each track's point.
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
    """Take what goes by offsets and landmarks from what is between poses.

    Args:
        seen: the observations.
        equations: all of them.
        left: once the offsets are eliminated.
        S: entries of what is between the unknown poses, in `seen.order.envelope`.
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
    """X coupling' between the pose of observation i and those of the rows `begin` to `end`."""
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
    """(T, 3) sum of coupling (point + offset) over the observations of each frame.

    Args:
        seen: the observations.
        coupling: (N, 3, 3) of each.
        point: (L, 3) way of each landmark.
        offset: (B, 3) way of each track's offset.
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
