"""How far observations lie from where path and landmarks say."""

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.se2 import Float, rotation
from mapfusion.smoother.normal_equations import Estimate, turns
from mapfusion.smoother.sightings import Sightings


def first_points(seen: Sightings, path: Float) -> Float:
    """(L, 3) where the observations of each landmark lie in the mean, on this path."""
    pose, position = path[seen.frame], seen.position_m.copy()
    turned = np.einsum("nij,nj->ni", rotation(pose[:, 2]), position[:, :2])
    position[:, :2] = pose[:, :2] + turned
    return seen.sum_by_landmark(position) / np.diff(seen.starts)[:, None]


def squared_distances(seen: Sightings, at: Estimate) -> Float:
    """(N,) squared Mahalanobis distances of the observations from where they should be."""
    squares = np.empty(len(seen))
    _put_squares(seen.arrays, at, turns(at.path), squares)
    return squares


def squares_of_points(seen: Sightings, path: Float, covariance_m2: Float) -> Float:
    """(N,) what squared distances are expected to be more by, about the tracks' true points.

    Those about points that were fitted to the same observations are smaller.

    Args:
        seen: the observations.
        path: (T, 3).
        covariance_m2: (B, 3, 3) of the tracks' points.
    """
    squares = np.empty(len(seen))
    _put_traces(seen.arrays, turns(path), covariance_m2, squares)
    return squares


@kernel
def _put_squares(
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    turn: Float,
    squares: Float,
) -> None:
    """In the robot's frame, where the information is: r' W r with r = R'(l + b - p) - z."""
    starts, owner, frame, position, W = seen
    for t in range(len(starts) - 1):
        j = owner[t]
        x = at.point_m[j, 0] + at.offset_m[t, 0]
        y = at.point_m[j, 1] + at.offset_m[t, 1]
        z = at.point_m[j, 2] + at.offset_m[t, 2]
        for i in range(starts[t], starts[t + 1]):
            k = frame[i]
            c, s, along, across = turn[k, 0], turn[k, 1], x - at.path[k, 0], y - at.path[k, 1]
            r0 = c * along + s * across - position[i, 0]
            r1 = c * across - s * along - position[i, 1]
            r2 = z - position[i, 2]
            squares[i] = (
                r0 * (W[i, 0, 0] * r0 + 2 * W[i, 0, 1] * r1)
                + r1 * (W[i, 1, 1] * r1 + 2 * W[i, 1, 2] * r2)
                + r2 * (W[i, 2, 2] * r2 + 2 * W[i, 0, 2] * r0)
            )


@kernel
def _put_traces(
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, Float, Float],
    turn: Float,
    covariance_m2: Float,
    squares: Float,
) -> None:
    """The trace of W R' C R."""
    starts, _, frame, _, W = seen
    for t in range(len(starts) - 1):
        xx, xy, xz = covariance_m2[t, 0, 0], covariance_m2[t, 0, 1], covariance_m2[t, 0, 2]
        yy, yz, zz = covariance_m2[t, 1, 1], covariance_m2[t, 1, 2], covariance_m2[t, 2, 2]
        for i in range(starts[t], starts[t + 1]):
            c, s = turn[frame[i], 0], turn[frame[i], 1]
            along = c * c * xx + 2 * c * s * xy + s * s * yy
            across = s * s * xx - 2 * c * s * xy + c * c * yy
            mixed = c * s * (yy - xx) + (c * c - s * s) * xy
            squares[i] = (
                W[i, 0, 0] * along
                + W[i, 1, 1] * across
                + W[i, 2, 2] * zz
                + 2 * W[i, 0, 1] * mixed
                + 2 * W[i, 0, 2] * (c * xz + s * yz)
                + 2 * W[i, 1, 2] * (c * yz - s * xz)
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
