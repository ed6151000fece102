"""The normal equations of all observations, with the landmarks eliminated exactly.

An observation z of landmark l from pose x = (p, theta) has the residual e = R (R^T (l - p) - z),
turned into the map frame, so that de/dl = I and de/dx = [-I, lever]. The lever arm of the rotation is
the landmark's own position: with the observed point instead, whose error is also in z, rotations are
biased. Setting de/dl's normal equations to zero leaves the Schur complement on the poses:

    S = sum J' W J - H' A^-1 H,   A = sum W,   H = W J   (of one landmark, over its observations)
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.se2 import Float, rotation
from mapfusion.smoother.sightings import Sightings
from mapfusion.symmetric import cofactors


class Eliminated(NamedTuple):
    """What brings the landmarks back once the poses are known.

    Attributes:
        covariance_m2: (L, 3, 3) A^-1, of each landmark if the poses were known.
        towards_m: (L, 3) the landmarks' best step while the poses stay.
        coupling: (N, 3, 3) J' W, pose against landmark, by observation.
    """

    covariance_m2: Float
    towards_m: Float
    coupling: Float


def eliminate(
    seen: Sightings, path: Float, point_m: Float, weight: Float, S: Float, g: Float
) -> Eliminated:
    """Add what the observations say of the poses to S (3T, 3T), lower half, and g (3T,).

    The step of the poses then solves S dx = -g.

    Args:
        seen: the observations.
        path: (T, 3) poses at which is linearised.
        point_m: (L, 3) landmarks likewise.
        weight: (N,) factor on the information of each observation.
        S: is added to.
        g: is added to.
    """
    n_landmarks = len(seen.starts) - 1
    made = Eliminated(
        np.zeros((n_landmarks, 3, 3)), np.zeros((n_landmarks, 3)), np.empty((len(seen), 3, 3))
    )
    _eliminate(
        (seen.starts, seen.frame, seen.position_m, seen.information),
        path,
        point_m,
        weight,
        S,
        g,
        made,
    )
    return made


@njit(cache=True)
def _eliminate(  # noqa: PLR0913
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    path: Float,
    point_m: Float,
    weight: Float,
    S: Float,
    g: Float,
    made: Eliminated,
) -> None:
    starts, frame, position, information = seen
    for j in range(len(starts) - 1):
        first, last = starts[j], starts[j + 1]
        A, b = np.zeros((3, 3)), np.zeros(3)
        for i in range(first, last):
            k = 3 * frame[i]
            pose = path[frame[i]]
            W, e, J = _linearised(pose, point_m[j], position[i], information[i], weight[i])
            H = made.coupling[i]
            for r in range(3):
                for q in range(3):
                    A[r, q] += W[r, q]
                    H[r, q] = J[0, r] * W[0, q] + J[1, r] * W[1, q] + J[2, r] * W[2, q]
            for r in range(3):
                b[r] += W[r, 0] * e[0] + W[r, 1] * e[1] + W[r, 2] * e[2]
                g[k + r] += H[r, 0] * e[0] + H[r, 1] * e[1] + H[r, 2] * e[2]
                for q in range(r + 1):
                    S[k + r, k + q] += H[r, 0] * J[0, q] + H[r, 1] * J[1, q] + H[r, 2] * J[2, q]
        inverse = made.covariance_m2[j]
        _invert(A, inverse)
        for r in range(3):
            made.towards_m[j, r] = -(
                inverse[r, 0] * b[0] + inverse[r, 1] * b[1] + inverse[r, 2] * b[2]
            )
        _subtract(frame[first:last], made.coupling[first:last], inverse, b, S, g)


@njit(cache=True)
def _linearised(
    pose: Float, point: Float, seen_at: Float, information: Float, weight: float
) -> tuple[Float, Float, Float]:
    """W, e and de/dx of one observation, in the map frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    W, e, J = np.empty((3, 3)), np.empty(3), np.zeros((3, 3))
    for r in range(3):
        for q in range(3):
            total = 0.0
            for u in range(3):
                for v in range(3):
                    total += R[r, u] * information[u, v] * R[q, v]
            W[r, q] = weight * total
        e[r] = point[r] - R[r, 0] * seen_at[0] - R[r, 1] * seen_at[1] - R[r, 2] * seen_at[2]
    e[0] -= pose[0]
    e[1] -= pose[1]
    J[0, 0] = J[1, 1] = -1.0
    J[0, 2], J[1, 2] = point[1] - pose[1], pose[0] - point[0]
    return W, e, J


@njit(cache=True)
def _invert(A: Float, inverse: Float) -> None:
    """The inverse of a symmetric A; of planar data, without information in z, that of its xy part."""
    if A[2, 2] == 0.0:
        determinant = A[0, 0] * A[1, 1] - A[0, 1] ** 2
        inverse[0, 0], inverse[1, 1] = A[1, 1] / determinant, A[0, 0] / determinant
        inverse[0, 1] = inverse[1, 0] = -A[0, 1] / determinant
        return
    xx, xy, xz, yy, yz, zz, determinant = cofactors(
        A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    )
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = (
        xx / determinant,
        yy / determinant,
        zz / determinant,
    )
    inverse[0, 1] = inverse[1, 0] = xy / determinant
    inverse[0, 2] = inverse[2, 0] = xz / determinant
    inverse[1, 2] = inverse[2, 1] = yz / determinant


@njit(cache=True)
def _subtract(frame: np.ndarray, H: Float, inverse: Float, b: Float, S: Float, g: Float) -> None:
    """H' A^-1 H between all frames of one landmark; they ascend, so the lower half is met."""
    gain = np.empty((3, 3))
    for i in range(len(frame)):
        row = 3 * frame[i]
        for r in range(3):
            for q in range(3):
                gain[r, q] = (
                    H[i, r, 0] * inverse[0, q]
                    + H[i, r, 1] * inverse[1, q]
                    + H[i, r, 2] * inverse[2, q]
                )
            g[row + r] -= gain[r, 0] * b[0] + gain[r, 1] * b[1] + gain[r, 2] * b[2]
        for k in range(i + 1):
            column = 3 * frame[k]
            for r in range(3):
                for q in range(3):
                    S[row + r, column + q] -= (
                        gain[r, 0] * H[k, q, 0] + gain[r, 1] * H[k, q, 1] + gain[r, 2] * H[k, q, 2]
                    )


def landmark_steps(seen: Sightings, made: Eliminated, way: Float) -> Float:
    """(L, 3) what a step of the poses (3T,) moves the landmarks by, their own step included."""
    moved = np.einsum("nij,ni->nj", made.coupling, way.reshape(-1, 3)[seen.frame])
    of_each = np.add.reduceat(moved, seen.starts[:-1]) if len(seen) else np.zeros((0, 3))
    return made.towards_m - np.einsum("lij,lj->li", made.covariance_m2, of_each)


def first_points(seen: Sightings, path: Float) -> Float:
    """(L, 3) where the observations of each landmark lie in the mean, on this path."""
    pose = path[seen.frame]
    position = seen.position_m.copy()
    turned = np.einsum("nij,nj->ni", rotation(pose[:, 2]), position[:, :2])
    position[:, :2] = pose[:, :2] + turned
    count = np.diff(seen.starts)[:, None]
    return np.add.reduceat(position, seen.starts[:-1]) / count if len(seen) else np.zeros((0, 3))


def squared_distances(
    seen: Sightings, path: Float, point_m: Float, covariance_m2: Float | None = None
) -> Float:
    """(N,) squared Mahalanobis distances of the observations from where they should be.

    With the landmarks' covariances (L, 3, 3) these are expected ones, as they are about the true
    landmarks: those about landmarks that were fitted to the same observations are smaller.
    """
    if covariance_m2 is None:
        covariance_m2 = np.zeros((len(point_m), 3, 3))
    squares = np.empty(len(seen))
    arrays = seen.starts, seen.frame, seen.position_m, seen.information
    _squared_distances(arrays, path, point_m, covariance_m2, squares)
    return squares


@njit(cache=True)
def _squared_distances(
    seen: tuple[np.ndarray, np.ndarray, Float, Float],
    path: Float,
    point_m: Float,
    covariance_m2: Float,
    squares: Float,
) -> None:
    starts, frame, position, information = seen
    for j in range(len(starts) - 1):
        for i in range(starts[j], starts[j + 1]):
            W, e, _ = _linearised(path[frame[i]], point_m[j], position[i], information[i], 1.0)
            total = 0.0
            for r in range(3):
                for q in range(3):
                    total += W[r, q] * (e[r] * e[q] + covariance_m2[j, r, q])
            squares[i] = total
