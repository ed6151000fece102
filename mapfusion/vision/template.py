"""How the surroundings of points looked at first, prepared for finding them again.

All that a fit (`patch_fit.py`) needs of the earlier picture is here, so it is made once a track and
not once a view: grey levels, their slopes, and the Cholesky factor of the normal matrix.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky

# A smaller window tells scale from shift less well, a larger one is less a plane.
WINDOW_HALF_PX = 10
_SIDE_PX = 2 * WINDOW_HALF_PX + 1
_WINDOW_SIGMA_PX = 6.0  # of the Gaussian by which its pixels count
_SINGULAR = 1e-9  # pivot, as a share of its diagonal element, that is rounding error
N_PARAMETERS = 8  # shift u and v, their derivatives by u and v, offset and gain in brightness
_NEXT = np.uintp(1)  # indices without a sign, which a kernel need not wrap around
NO_FIT = -1.0  # tolerated of a window that leaves its patch, or that has too little texture


@dataclass(frozen=True)
class Templates:
    """Windows around N points of earlier pictures.

    Attributes:
        window: (N, W, W, 3) grey level and its slopes along u and v.
        factor: (N, 8, 8) of the normal matrix, its lower half.
        tolerated: (N,) weighted sum of squared residuals that still is the same, or NO_FIT.
    """

    window: Float
    factor: Float
    tolerated: Float

    @classmethod
    def room(cls, n: int) -> "Templates":
        """For n of them, not filled in."""
        factor = np.empty((n, N_PARAMETERS, N_PARAMETERS))
        return cls(np.empty((n, _SIDE_PX, _SIDE_PX, 3)), factor, np.empty(n))

    @classmethod
    def of(cls, patch: np.ndarray, point: Float, noise: float, max_misfit: float) -> "Templates":
        """What points look like.

        Args:
            patch: (N, P, P) uint8 of pictures.
            point: (N, 2) in them, u and v from their middles.
            noise: standard deviation of one picture's grey levels.
            max_misfit: what is found may differ by noise and by what this error of its place would
                explain, pixels.
        """
        made = cls.room(len(patch))
        variance, square_misfit = 2 * noise**2, max_misfit**2
        _prepare(patch, point, variance, square_misfit, made.window, made.factor, made.tolerated)
        return made

    def put(self, rows: np.ndarray, others: "Templates", theirs: np.ndarray | slice) -> None:
        """Replace, in place, rows by some of others."""
        self.window[rows] = others.window[theirs]
        self.factor[rows] = others.factor[theirs]
        self.tolerated[rows] = others.tolerated[theirs]


def _weights() -> Float:
    x = range(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1)
    by_distance = np.array([math.exp(-(k * k) / (2 * _WINDOW_SIGMA_PX**2)) for k in x])
    return by_distance * by_distance[:, None]


WEIGHT = _weights()  # (W, W), what the window's pixels count
WEIGHT.setflags(write=False)


@njit(cache=True)
def _prepare(
    patch: np.ndarray,
    point: Float,
    variance: float,
    square_misfit: float,
    window: Float,
    factor: Float,
    tolerated: Float,
) -> None:
    rows = np.empty((_SIDE_PX, _SIDE_PX, N_PARAMETERS))
    for n in range(len(patch)):
        tolerated[n] = NO_FIT
        if _take_window(patch[n], point[n], window[n], rows):
            sum_of_squares = _normal_matrix(rows, factor[n], variance, square_misfit)
            if cholesky(factor[n], _SINGULAR):
                tolerated[n] = sum_of_squares


@njit(cache=True)
def _take_window(patch: np.ndarray, point: Float, window: Float, rows: Float) -> bool:
    """Grey levels on the grid around the point, and their derivatives by the parameters."""
    half, middle = WINDOW_HALF_PX, patch.shape[0] // 2
    if max(abs(point[0]), abs(point[1])) + half + 2 > middle:
        return False
    for y in range(-half, half + 1):
        for x in range(-half, half + 1):
            u, v = middle + point[0] + x, middle + point[1] + y
            own, row = window[y + half, x + half], rows[y + half, x + half]
            level = grey(patch, u, v)
            gu = 0.5 * (grey(patch, u + 1, v) - grey(patch, u - 1, v))
            gv = 0.5 * (grey(patch, u, v + 1) - grey(patch, u, v - 1))
            own[0], own[1], own[2] = level, gu, gv
            row[0], row[1] = gu, gv
            row[2], row[3], row[4], row[5] = gu * x, gu * y, gv * x, gv * y
            row[6], row[7] = 1.0, level
    return True


@njit(cache=True)
def grey(image: np.ndarray, u: float, v: float) -> float:
    """Grey level between pixels, bilinear."""
    i, j = np.uintp(int(u)), np.uintp(int(v))
    a, b = u - int(u), v - int(v)
    upper = (1 - a) * image[j, i] + a * image[j, i + _NEXT]
    lower = (1 - a) * image[j + _NEXT, i] + a * image[j + _NEXT, i + _NEXT]
    return (1 - b) * upper + b * lower


@njit(cache=True)
def _normal_matrix(rows: Float, normal: Float, variance: float, square_misfit: float) -> float:
    """Fills its lower half; returns which weighted sum of squared residuals is tolerated.

    An error e of the place along some direction changes a grey level by g e, g its slope along it.
    """
    tolerated = 0.0
    normal[:] = 0.0
    for y in range(_SIDE_PX):
        for x in range(_SIDE_PX):
            row, weight = rows[y, x], WEIGHT[y, x]
            square_slope = 0.5 * (row[0] * row[0] + row[1] * row[1])  # the mean over directions
            tolerated += weight * (variance + square_misfit * square_slope)
            for i in range(N_PARAMETERS):
                for j in range(i + 1):
                    normal[i, j] += weight * row[i] * row[j]
    return tolerated
