"""What is left of the poses once offsets and landmarks are eliminated, and the step that follows.

With H_i an observation's block of pose and point, G_t the covariance of its track's offset if path
and landmark were known, K_t = 1 - G_t S_t, and A the covariance of its landmark if the path were
known, observations i, k of tracks t, u of one landmark take from what their poses have in common

    H_i (K_t A K_u' + G_t if t = u) H_k'.
"""

import numpy as np

from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import NormalEquations
from mapfusion.smoother.offsets import Reduced
from mapfusion.smoother.sightings import Sightings


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
                _put_gains(left, j, t, coupling, coupling_left, i, by_landmark, by_track)
                _add_product(by_landmark, left.kept, t, by_track)
                _subtract_rows(by_landmark, starts[j], own, i, place, coupling_left, offset, S)
                _subtract_rows(by_track, own, i, i, place, coupling, offset, S)
                _subtract_own(by_track, coupling, i, 3 * place[i], offset, S)


# Kernels take arrays and rows of them: views of rows are counted, which takes longer than the sums.
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
    """(N, 3, 3) a pose's block with a landmark once offsets are eliminated, by observation."""
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
    """(B, 3) sum of coupling' way over the observations of each track; `way` (T, 3) by frame."""
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
