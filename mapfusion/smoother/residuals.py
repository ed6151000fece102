"""How far observations lie from where path and landmarks say."""

import numpy as np
from numba import njit

from mapfusion.se2 import Float, rotation
from mapfusion.smoother.normal_equations import Estimate, linearised
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
    if covariance_m2 is None:
        covariance_m2 = np.zeros((len(at.offset_m), 3, 3))
    squares = np.empty(len(seen))
    _squared_distances(seen.arrays, at, covariance_m2, squares)
    return squares


@njit(cache=True)
def _squared_distances(
    seen: tuple[np.ndarray, np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    covariance_m2: Float,
    squares: Float,
) -> None:
    starts, owner, frame, position, information = seen
    for t in range(len(starts) - 1):
        point = at.point_m[owner[t]] + at.offset_m[t]
        for i in range(starts[t], starts[t + 1]):
            W, e, _ = linearised(at.path[frame[i]], point, position[i], information[i])
            total = 0.0
            for r in range(3):
                for q in range(3):
                    total += W[r, q] * (e[r] * e[q] + covariance_m2[t, r, q])
            squares[i] = total


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
