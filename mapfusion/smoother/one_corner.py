"""Tracks that were taken for one landmark: which of them are of one corner?

A filter joins what it sees to its landmarks while its path is uncertain, and on a textured wall the
next corner is often nearer than that. Along a smoothed path it shows: two tracks i, j of one corner
have their points p, told by their own observations with covariances W, apart by no more than

    (p_i - p_j)' (W_i + W_j + 2 s^2)^-1 (p_i - p_j),

chi-square distributed if each strays from the corner by s. The path was fitted to the same tracks,
so what it is off by draws them together and not apart. A landmark becomes as many as it needs.
"""

import numpy as np

from mapfusion.chi_square import chi_square_bound
from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float, rotation
from mapfusion.smoother.sightings import Sightings
from mapfusion.symmetric import cholesky, solve_lower

# Of two tracks of one corner so many stay together; what is parted by mistake is seen twice.
_TOGETHER = 0.999
_SINGULAR = 1e-12  # pivot, as a share of its diagonal element, that is rounding error


def parted(seen: Sightings, landmark: np.ndarray, path: Float, stray_m: float) -> np.ndarray:
    """(N,) which landmark each observation is of, where those of several corners are several.

    The corner that holds the observation which a landmark is numbered after keeps the number, else
    that with the most. Others are named after the first of their own that names no other landmark.

    Args:
        seen: what the landmarks were seen by.
        landmark: (N,) which one each observation of the log is of.
        path: (T, 3) along which it was observed.
        stray_m: s.
    """
    made = landmark.copy()
    if not seen.strays.any():
        return made
    point, covariance = _track_points(seen, path)
    covariance[seen.strays] += stray_m**2 * np.eye(3)
    first = np.searchsorted(seen.track_starts, seen.starts)
    counts, n = np.diff(seen.track_starts), seen.n_dimensions
    bound = chi_square_bound(_TOGETHER, n)
    corner = _corners(first, counts, point[:, :n].copy(), covariance[:, :n, :n].copy(), bound)
    names = set(landmark.tolist())
    for own in np.flatnonzero(np.maximum.reduceat(corner, first[:-1])):
        track = np.repeat(corner[first[own] : first[own + 1]], counts[first[own] : first[own + 1]])
        rows = seen.row[seen.starts[own] : seen.starts[own + 1]]
        home = track[rows == landmark[rows[0]]]
        keeps = home[0] if len(home) else 0
        for k in np.setdiff1d(track, keeps):
            mine = rows[track == k]
            free = [row for row in mine.tolist() if row not in names]
            made[mine] = min(free, default=-1)
    return made


def _track_points(seen: Sightings, path: Float) -> tuple[Float, Float]:
    """Of B tracks the points (B, 3) that their observations tell, and their covariances."""
    pose, R = path[seen.frame], np.zeros((len(seen), 3, 3))
    R[:, :2, :2], R[:, 2, 2] = rotation(pose[:, 2]), 1.0
    point = np.einsum("nij,nj->ni", R, seen.position_m)
    point[:, :2] += pose[:, :2]
    W = R @ seen.information @ np.swapaxes(R, 1, 2)
    total, n = seen.sum_by_track(W), seen.n_dimensions
    covariance = np.zeros_like(total)
    covariance[:, :n, :n] = np.linalg.inv(total[:, :n, :n])
    weighted = seen.sum_by_track(np.einsum("nij,nj->ni", W, point))
    return np.einsum("tij,tj->ti", covariance, weighted), covariance


@kernel
def _corners(
    first: np.ndarray, counts: np.ndarray, point: Float, covariance: Float, bound: float
) -> np.ndarray:
    """(B,) the corner of each landmark that each of its tracks is of: 0, 1, ...

    Again and again the track that the most observations agree with takes those tracks along.
    """
    corner = np.zeros(len(point), dtype=np.int64)
    n = point.shape[1]
    S, off = np.empty((n, n)), np.empty(n)
    for own in range(len(first) - 1):
        begin, size = first[own], first[own + 1] - first[own]
        near = np.zeros((size, size), dtype=np.bool_)
        for i in range(size):
            near[i, i] = True
            for j in range(i):
                for r in range(n):
                    off[r] = point[begin + i, r] - point[begin + j, r]
                    for q in range(n):
                        S[r, q] = covariance[begin + i, r, q] + covariance[begin + j, r, q]
                near[i, j] = near[j, i] = _square(S, off) <= bound
        left, k = np.ones(size, dtype=np.bool_), 0
        while left.any():
            best, most = -1, 0
            for i in range(size):
                agree = 0
                for j in range(size):
                    if left[i] and left[j] and near[i, j]:
                        agree += counts[begin + j]
                if agree > most:
                    best, most = i, agree
            for j in range(size):
                if left[j] and near[best, j]:
                    corner[begin + j], left[j] = k, False
            k += 1
    return corner


@kernel_part
def _square(S: Float, off: Float) -> float:
    """Squared Mahalanobis distance; destroys both."""
    if not cholesky(S, _SINGULAR):
        return 0.0
    solve_lower(S, off)
    total = 0.0
    for value in off:
        total += value * value
    return total
