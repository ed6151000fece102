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
from mapfusion.se2 import Float, rotation
from mapfusion.smoother.sightings import Sightings

# Of two tracks of one corner so many stay together; what is parted by mistake is seen twice.
_TOGETHER = 0.999
_SINGULAR = 1e-12  # pivot, as a share of its diagonal element, that is rounding error
# Pairs of tracks that are looked at together: some hundred bytes each. A landmark may have
# thousands of tracks, all of whose pairs would not fit into memory.
_PAIRS_AT_ONCE = 100_000


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
    corner = _corners(first, counts, point[:, :n], covariance[:, :n, :n], bound)
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


def _corners(
    first: np.ndarray, counts: np.ndarray, point: Float, covariance: Float, bound: float
) -> np.ndarray:
    """(B,) the corner of each landmark that each of its tracks is of: 0, 1, ...

    Again and again the track that the most observations agree with takes those tracks along.
    """
    corner, of = np.zeros(len(point), dtype=np.int64), _landmarks(first)
    i, j = _apart(first, point, covariance, bound)
    of_apart = of[i]
    for own in np.unique(of_apart):
        begin, size = first[own], first[own + 1] - first[own]
        here = slice(*np.searchsorted(of_apart, [own, own + 1]))
        near, one, other = np.ones((size, size), dtype=bool), i[here] - begin, j[here] - begin
        near[one, other] = near[other, one] = False
        left, k = np.ones(size, dtype=bool), 0
        while left.any():
            agree = np.where(left, near @ (left * counts[begin : begin + size]), 0)
            taken = left & near[np.argmax(agree)]
            corner[begin : begin + size][taken] = k
            left, k = left & ~taken, k + 1
    return corner


def _landmarks(first: np.ndarray) -> np.ndarray:
    """(B,) which landmark each track is of, of landmarks whose tracks begin at `first` (L + 1,)."""
    return np.repeat(np.arange(len(first) - 1), np.diff(first))


def _apart(first: np.ndarray, point: Float, covariance: Float, bound: float) -> np.ndarray:
    """(2, A) the tracks of one landmark that are of two corners, in the order of the first one."""
    begin = first[_landmarks(first)]
    before = np.arange(len(point)) - begin  # tracks of the same landmark before each
    part = np.cumsum(before) // _PAIRS_AT_ONCE
    S, off = (np.ascontiguousarray(values.T) for values in (covariance, point))
    found = []
    for own in np.split(np.arange(len(point)), np.flatnonzero(np.diff(part)) + 1):
        n = before[own]
        i = np.repeat(own, n)
        j = np.arange(len(i)) - np.repeat(np.cumsum(n) - n - begin[own], n)
        away = _squares(S[..., i] + S[..., j], off[..., i] - off[..., j]) > bound
        found.append(np.stack([i[away], j[away]]))
    return np.concatenate(found, axis=1)


def _squares(S: Float, off: Float) -> Float:
    """(P,) squared Mahalanobis distances of (n, P), 0 where S (n, n, P) is singular.

    By S = L D L'; both are changed.
    """
    total, regular = np.zeros(S.shape[-1]), np.ones(S.shape[-1], dtype=bool)
    least = [_SINGULAR * S[k, k] for k in range(len(S))]
    for k in range(len(S)):
        regular &= S[k, k] > least[k]
        pivot = np.where(regular, S[k, k], 1.0)
        total += off[k] ** 2 / pivot
        share = S[k + 1 :, k] / pivot
        off[k + 1 :] -= share * off[k]
        S[k + 1 :, k + 1 :] -= share[:, None] * S[k, k + 1 :]
    return np.where(regular, total, 0.0)
