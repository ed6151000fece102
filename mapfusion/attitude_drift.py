"""What heights of landmarks have in common: by the attitude they were levelled with.

Nobody tells how the body stood to begin with, and links between frames add up their errors. A tilt
that is wrong stays so for a while, and what was seen meanwhile lies on a plane that is tilted as a
whole. Within a frame and from one to the next that is no noise, and more sightings do not average
it out. So the landmarks' heights are moved by what a filter calls considered errors (Schmidt 1966,
"Application of state-space methods to navigation problems"): the estimate stays as it is, its
covariance has them.

In the plane a wrong tilt moves what is seen by its height above the floor alone, metres where
levers are tens of them, and the robot's path with it: that is left out.
"""

import numpy as np

from mapfusion.attitude import Attitude
from mapfusion.se2 import Float

_MOST_SOURCES = 64  # of new errors along a log; frames between two of them share one
_SIZE = 3  # of an error: tilts about the map's axes x and y, and a height


def shared_heights(
    attitude: Attitude, path: Float, frame: np.ndarray, landmark: np.ndarray, point_m: Float
) -> Float:
    """How far one sigma of each shared error lifts landmarks: (R, L), in metres.

    Args:
        attitude: of T frames or more.
        path: (T, 3) of the robot in its map.
        frame: (N,) of each sighting.
        landmark: (N,) what it is of: 0 to L - 1, each at least once.
        point_m: (L, 2) or (L, 3) where these are.
    """
    n = len(path)
    first = np.unique(np.linspace(1, n, min(_MOST_SOURCES, n), dtype=np.int64))
    starts = np.concatenate([[0], first[first < n]])  # how the body stood at first is one alone
    new = np.add.reduceat(_new_variances(attitude, path), starts)
    order = np.argsort(frame, kind="stable")
    bounds = np.searchsorted(frame[order], np.arange(n + 1))
    moved = np.zeros((len(point_m), _SIZE * len(starts)))
    error, source = np.zeros((_SIZE, _SIZE * len(starts))), 0
    for k in range(n):
        if k:
            error = _carried(attitude, path, k) @ error
        if source < len(starts) and k == starts[source]:
            own = slice(_SIZE * source, _SIZE * source + _SIZE)
            error[:, own] += np.diag(np.sqrt(new[source]))
            source += 1
        rows = landmark[order[bounds[k] : bounds[k + 1]]]
        x, y = (point_m[rows, :2] - path[k, :2]).T
        np.add.at(moved, rows, np.column_stack([y, -x, np.ones(len(rows))]) @ error)
    return (moved / np.bincount(landmark, minlength=len(point_m))[:, None]).T


def _carried(attitude: Attitude, path: Float, k: int) -> Float:
    """(3, 3) what the error of frame k - 1 is in frame k: a tilted robot climbs as it goes."""
    tilt, height = attitude.carried[k]
    dx, dy = path[k, :2] - path[k - 1, :2]
    return np.array([[tilt, 0.0, 0.0], [0.0, tilt, 0.0], [height * dy, -height * dx, height]])


def _new_variances(attitude: Attitude, path: Float) -> Float:
    """(T, 3) of the error that comes with each frame, so that all together are as is stated."""
    stated = np.column_stack([np.mean(attitude.sigma[:, :2] ** 2, axis=1)] * 2)
    stated = np.column_stack([stated, attitude.sigma[:, 2] ** 2])
    new, P = np.zeros((len(path), _SIZE)), np.zeros((_SIZE, _SIZE))
    for k in range(len(path)):
        if k:
            F = _carried(attitude, path, k)
            P = F @ P @ F.T
        new[k] = np.maximum(stated[k] - np.diag(P), 0.0)
        P += np.diag(new[k])
    return new
