"""How far observations lie from where path and landmarks say."""

import numpy as np
from numba import njit

from mapfusion.se2 import Float, rotation
from mapfusion.smoother.normal_equations import Estimate, turns
from mapfusion.smoother.sightings import Sightings


def first_points(seen: Sightings, path: Float) -> Float:
    """(L, 3) where the observations of each landmark lie in the mean, on this path."""
    pose, position = path[seen.frame], seen.position_m.copy()
    turned = np.einsum("nij,nj->ni", rotation(pose[:, 2]), position[:, :2])
    position[:, :2] = pose[:, :2] + turned
    return seen.sum_by_landmark(position) / np.diff(seen.starts)[:, None]


def squared_distances(seen: Sightings, at: Estimate, covariance_m2: Float | None = None) -> Float:
    """(N,) squared Mahalanobis distances of the observations from where they should be.

    With the covariances (B, 3, 3) of the tracks' points these are expected ones, as they are about
    the true points: those about points that were fitted to the same observations are smaller.
    """
    squares = np.empty(len(seen))
    turn = turns(at.path)
    if covariance_m2 is None:
        _squared_distances(seen.arrays, at, turn, squares)
    else:
        _expected_squares(seen.arrays, at, turn, covariance_m2, squares)
    return squares


@njit(cache=True)
def _squared_distances(
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    turn: Float,
    squares: Float,
) -> None:
    """In the robot's frame, where the information is: r' W r with r = R'(l + b - p) - z."""
    starts, owner, frame, position, information = seen
    for t in range(len(starts) - 1):
        point = at.point_m[owner[t]] + at.offset_m[t]
        for i in range(starts[t], starts[t + 1]):
            c, s, W = turn[frame[i], 0], turn[frame[i], 1], information[i]
            x, y = point[0] - at.path[frame[i], 0], point[1] - at.path[frame[i], 1]
            r0 = c * x + s * y - position[i, 0]
            r1 = c * y - s * x - position[i, 1]
            r2 = point[2] - position[i, 2]
            squares[i] = (
                r0 * (W[0, 0] * r0 + 2 * W[0, 1] * r1)
                + r1 * (W[1, 1] * r1 + 2 * W[1, 2] * r2)
                + r2 * (W[2, 2] * r2 + 2 * W[0, 2] * r0)
            )


@njit(cache=True)
def _expected_squares(
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    turn: Float,
    covariance_m2: Float,
    squares: Float,
) -> None:
    """The same and the trace of W R' C R: what the uncertainty of the track's point adds."""
    _squared_distances(seen, at, turn, squares)
    starts, _, frame, _, information = seen
    for t in range(len(starts) - 1):
        C = covariance_m2[t]
        for i in range(starts[t], starts[t + 1]):
            c, s, W = turn[frame[i], 0], turn[frame[i], 1], information[i]
            along = c * c * C[0, 0] + 2 * c * s * C[0, 1] + s * s * C[1, 1]
            across = s * s * C[0, 0] - 2 * c * s * C[0, 1] + c * c * C[1, 1]
            mixed = c * s * (C[1, 1] - C[0, 0]) + (c * c - s * s) * C[0, 1]
            squares[i] += (
                W[0, 0] * along
                + W[1, 1] * across
                + W[2, 2] * C[2, 2]
                + 2 * W[0, 1] * mixed
                + 2 * W[0, 2] * (c * C[0, 2] + s * C[1, 2])
                + 2 * W[1, 2] * (c * C[1, 2] - s * C[0, 2])
            )


def offset_squares(seen: Sightings, at: Estimate, stray_information: float) -> Float:
    """Squared Mahalanobis distances of the offsets of the tracks that stray from none."""
    offset = at.offset_m[seen.strays, : seen.n_dimensions]
    return stray_information * np.sum(offset**2, axis=1)


def known_dimensions(seen: Sightings, offset_m2: Float, information: Float) -> Float:
    """In how many dimensions the data tell where the offsets lie of the tracks that stray.

    Of the only track of a landmark they tell nothing, it is 0; of one track among many it is
    nearly n. It is also the square, in sigmas, that the estimate is expected to have: the trace of
    1 - P C, with the offset's covariance C and what was known before of it.

    Args:
        seen: the observations.
        offset_m2: (B, 3, 3) C.
        information: (B,) P, the same along each axis.
    """
    n, strays = seen.n_dimensions, seen.strays
    unknown = information[strays] * np.trace(offset_m2[strays, :n, :n], axis1=1, axis2=2)
    return np.clip(n - unknown, 0, n)
