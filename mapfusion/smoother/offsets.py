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
from numba import njit

from mapfusion.se2 import Float
from mapfusion.smoother.blocks import add_along, put_along, put_inverse, put_product
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


@njit(cache=True)
def _reduce(
    rows: tuple[np.ndarray, np.ndarray, np.ndarray],
    strays: np.ndarray,
    planar: bool,
    equations: PointEquations,
    left: Reduced,
) -> bool:
    """Put what is left; False where some block is singular."""
    _, first_track, _ = rows
    block, known = np.empty((3, 3)), np.empty((3, 3))
    for j in range(len(first_track) - 1):
        for r in range(3):
            for q in range(3):
                block[r, q] = 0.0
        for t in range(first_track[j], first_track[j + 1]):
            S, K = equations.track_block[t], left.kept[t]
            if strays[t]:
                G, P = left.own_m2[t], equations.offset_information[t]
                for r in range(3):
                    for q in range(3):
                        known[r, q] = S[r, q]
                    known[r, r] += P
                if not put_inverse(known, G):
                    return False
                for r in range(3):
                    for q in range(3):
                        K[r, q] = P * G[r, q]
            else:
                for r in range(3):
                    K[r, r] = 1.0
            _add_track(S, K, equations.track_gradient[t], left, j, t, block)
        if planar:
            block[2, 2] = 1.0
        if not put_inverse(block, left.landmark_m2[j]):
            return False
    return True


@njit(cache=True)
def _add_track(
    S: Float, K: Float, gradient: Float, left: Reduced, j: int, t: int, block: Float
) -> None:
    """Add what is left of a track to its landmark's block and gradient."""
    G, pull = left.own_m2[t], left.pull[t]
    x = G[0, 0] * pull[0] + G[0, 1] * pull[1] + G[0, 2] * pull[2]
    y = G[1, 0] * pull[0] + G[1, 1] * pull[1] + G[1, 2] * pull[2]
    z = G[2, 0] * pull[0] + G[2, 1] * pull[1] + G[2, 2] * pull[2]
    for r in range(3):
        left.point_gradient[j, r] += gradient[r] - (S[r, 0] * x + S[r, 1] * y + S[r, 2] * z)
        for q in range(3):
            block[r, q] += S[r, 0] * K[0, q] + S[r, 1] * K[1, q] + S[r, 2] * K[2, q]


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


@njit(cache=True)
def _put_moved(
    first_track: np.ndarray,
    block: Float,
    left: Reduced,
    along: Float,
    points: Float,
    offsets: Float,
) -> None:
    asked, moved = np.empty(3), np.empty(3)
    for j in range(len(first_track) - 1):
        for q in range(3):
            asked[q] = left.point_gradient[j, q]
        for t in range(first_track[j], first_track[j + 1]):
            add_along(left.kept[t], along[t], asked)  # it is symmetric
        put_along(left.landmark_m2[j], asked, moved)
        for q in range(3):
            points[j, q] = -moved[q]
        for t in range(first_track[j], first_track[j + 1]):
            for q in range(3):
                asked[q] = left.pull[t, q] + along[t, q]
            add_along(block[t], points[j], asked)
            put_along(left.own_m2[t], asked, moved)
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
    made = Points(np.empty_like(left.own_m2), np.empty_like(left.own_m2))
    _put_known(seen.landmark_of_track, left, made)
    return made


@njit(cache=True)
def _put_known(landmark: np.ndarray, left: Reduced, made: Points) -> None:
    follows, half, spread = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for t in range(len(landmark)):
        A, G, K = left.landmark_m2[landmark[t]], left.own_m2[t], left.kept[t]
        for r in range(3):
            for q in range(3):
                follows[r, q] = -K[r, q]  # -db / dl
            follows[r, r] += 1.0
        for of_landmark, covariance in ((follows, made.offset_m2[t]), (K, made.track_m2[t])):
            put_product(of_landmark, A, half)
            put_product(half, of_landmark, spread)  # it is symmetric
            for r in range(3):
                for q in range(3):
                    covariance[r, q] = G[r, q] + spread[r, q]
