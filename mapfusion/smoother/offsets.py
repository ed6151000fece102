"""The tracks' offsets eliminated, exactly: what is left are equations of poses and landmarks.

With S the track block, P the information of the offset and G = (S + P)^-1 its covariance if path
and landmark were known, eliminating b_t leaves (a Schur complement)

    coupling (1 - G S)                  of pose and landmark
    - coupling G coupling'              between all poses that saw the track
    sum over tracks of S (1 - G S)      of the landmark

and likewise the gradients. Poses that share a track are so tied to each other more than to the
landmark. A track that does not stray has G = 0. As P is the same along each axis, 1 - G S = P G.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.smoother.blocks import add_along, put_along, put_inverse
from mapfusion.smoother.normal_equations import PointEquations
from mapfusion.smoother.sightings import Sightings


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
        raise np.linalg.LinAlgError("what is known of a point is singular")
    return left


@kernel
def _reduce(
    rows: tuple[np.ndarray, np.ndarray, np.ndarray],
    strays: np.ndarray,
    planar: bool,
    equations: PointEquations,
    left: Reduced,
) -> bool:
    """Put what is left; False where some block is singular."""
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
    """Add what is left of a track to its landmark's block and gradient."""
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
    """The step of landmarks (L, 3) and offsets (B, 3).

    Args:
        seen: the observations.
        equations: theirs.
        left: once the offsets are eliminated.
        along: (B, 3) what the step of the path asks of each track, sum of coupling' dx.
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
    """Covariances if the path were known.

    Attributes:
        offset_m2: (B, 3, 3) of each track's offset.
        track_m2: (B, 3, 3) of each track's point.
    """

    offset_m2: Float
    track_m2: Float


def known_points(seen: Sightings, left: Reduced) -> Points:
    """What is known of offsets and tracks' points, their landmark's own covariance in it."""
    made = np.empty((2, *left.own_m2.shape))
    _put_known(seen.landmark_of_track, left, made)
    return Points(made[0], made[1])


@kernel
def _put_known(landmark: np.ndarray, left: Reduced, made: Float) -> None:
    """What is known of a track, and what its landmark's covariance does by a symmetric matrix."""
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
