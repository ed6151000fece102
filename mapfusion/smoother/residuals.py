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

    With the landmarks' covariances (L, 3, 3) these are expected ones, as they are about the true
    landmarks: those about landmarks that were fitted to the same observations are smaller.
    """
    if covariance_m2 is None:
        covariance_m2 = np.zeros((len(at.point_m), 3, 3))
    squares = np.empty(len(seen))
    _squared_distances(seen.arrays, at, covariance_m2, squares)
    return squares


@njit(cache=True)
def _squared_distances(
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    at: Estimate,
    covariance_m2: Float,
    squares: Float,
) -> None:
    starts, frame, position, information = seen
    for j in range(len(starts) - 1):
        for i in range(starts[j], starts[j + 1]):
            W, e, _ = linearised(at.path[frame[i]], at.point_m[j], position[i], information[i])
            total = 0.0
            for r in range(3):
                for q in range(3):
                    total += W[r, q] * (e[r] * e[q] + covariance_m2[j, r, q])
            squares[i] = total
