"""How the surroundings of points looked at first, prepared for finding them again.

All that a fit (`patch_fit.py`) needs of the earlier picture is here, so it is made once a track and
not once a view: grey levels, their slopes, and the Cholesky factor of the normal matrix.
"""

import math
from dataclasses import dataclass

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky

# A smaller window tells scale from shift less well, a larger one is less a plane.
WINDOW_HALF_PX = 10
_SIDE_PX = 2 * WINDOW_HALF_PX + 1
_WINDOW_SIGMA_PX = 6.0  # of the Gaussian by which its pixels count
_SINGULAR = 1e-9  # pivot, as a share of its diagonal element, that is rounding error
N_PARAMETERS = 8  # shift u and v, their derivatives by u and v, offset and gain in brightness
LEVEL, SLOPE_U, SLOPE_V = range(3)  # of a window's pixels
NO_FIT = -1.0  # tolerated of a window that leaves its patch, or that has too little texture


@dataclass
class Templates:
    """Windows around points of earlier pictures: K rows, of which some are in use.

    Attributes:
        window: (K, 3, W * W) grey levels, row by row, and their slopes along u and v.
        factor: (K, 8, 8) of the normal matrix, its lower half.
        tolerated: (K,) weighted sum of squared residuals that still is the same, or NO_FIT.
    """

    window: Float
    factor: Float
    tolerated: Float

    @classmethod
    def room(cls, n: int) -> "Templates":
        """For n of them, not filled in."""
        factor = np.empty((n, N_PARAMETERS, N_PARAMETERS))
        return cls(np.empty((n, 3, _SIDE_PX**2)), factor, np.empty(n))

    @classmethod
    def of(cls, patch: np.ndarray, point: Float, noise: float, max_misfit: float) -> "Templates":
        """Those of N points, in their order; arguments as `fill` has them."""
        made = cls.room(len(patch))
        made.fill(np.arange(len(patch)), patch, point, noise, max_misfit)
        return made

    def unused(self, used: np.ndarray, n: int) -> np.ndarray:
        """Rows (n,) beside those in use (U,); there will be twice the room where that is short."""
        if len(used) + n > len(self.tolerated):
            larger = Templates.room(2 * (len(used) + n))
            for name, values in vars(self).items():
                getattr(larger, name)[: len(values)] = values
            self.window, self.factor, self.tolerated = vars(larger).values()
        is_free = np.ones(len(self.tolerated), dtype=bool)
        is_free[used] = False
        return np.flatnonzero(is_free)[:n]

    def fill(
        self, rows: np.ndarray, patch: np.ndarray, point: Float, noise: float, max_misfit: float
    ) -> None:
        """Put what points look like into some rows.

        Args:
            rows: (N,).
            patch: (N, P, P) uint8 of pictures.
            point: (N, 2) in them, u and v from their middles.
            noise: standard deviation of one picture's grey levels.
            max_misfit: what is found may differ by noise and by what this error of its place would
                explain, pixels.
        """
        given = (patch, point, 2 * noise**2, max_misfit**2, rows)
        _prepare(*given, self.window, self.factor, self.tolerated)


def _weights() -> Float:
    x = range(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1)
    by_distance = np.array([math.exp(-(k * k) / (2 * _WINDOW_SIGMA_PX**2)) for k in x])
    return by_distance * by_distance[:, None]


WEIGHT = _weights().ravel()  # (W * W,), what the window's pixels count
WEIGHT.setflags(write=False)


@kernel
def _prepare(
    patch: np.ndarray,
    point: Float,
    variance: float,
    square_misfit: float,
    rows: np.ndarray,
    window: Float,
    factor: Float,
    tolerated: Float,
) -> None:
    shown = np.empty((_SIDE_PX + 2) ** 2)
    for n in range(len(rows)):
        i = rows[n]
        tolerated[i] = NO_FIT
        middle, reach = patch.shape[1] // 2, max(abs(point[n, 0]), abs(point[n, 1]))
        if reach + WINDOW_HALF_PX + 2 > middle:
            continue
        _read_grid(patch, n, middle + point[n, 0], middle + point[n, 1], shown)
        _fill_window(shown, window, i)
        sum_of_squares = _normal_matrix(window, i, factor, variance, square_misfit)
        if cholesky(factor[i], _SINGULAR):
            tolerated[i] = sum_of_squares


@kernel_part
def _read_grid(patch: np.ndarray, n: int, u: float, v: float, shown: Float) -> None:
    """Fill in grey levels between pixels, bilinear: of a window around (u, v) and one pixel more.

    All have the same shares of the pixels around them, since u and v have no more digits than
    their sums with whole numbers.
    """
    half, side = WINDOW_HALF_PX + 1, _SIDE_PX + 2
    i, j = np.uintp(int(u) - half), np.uintp(int(v) - half)
    a, b = u - int(u), v - int(v)
    for y in range(side):
        row, below = j + np.uintp(y), j + np.uintp(y + 1)
        for x in range(side):
            k, after = i + np.uintp(x), i + np.uintp(x + 1)
            upper = (1 - a) * patch[n, row, k] + a * patch[n, row, after]
            lower = (1 - a) * patch[n, below, k] + a * patch[n, below, after]
            shown[np.uintp(y * side + x)] = (1 - b) * upper + b * lower


@kernel_part
def _fill_window(shown: Float, window: Float, n: int) -> None:
    """Fill in window n's grey levels and their slopes from those of a grid around it."""
    wide = np.uintp(_SIDE_PX + 2)
    one = np.uintp(1)
    for y in range(_SIDE_PX):
        for x in range(_SIDE_PX):
            k, at = np.uintp(y * _SIDE_PX + x), np.uintp(y + 1) * wide + np.uintp(x + 1)
            window[n, LEVEL, k] = shown[at]
            window[n, SLOPE_U, k] = 0.5 * (shown[at + one] - shown[at - one])
            window[n, SLOPE_V, k] = 0.5 * (shown[at + wide] - shown[at - wide])


@kernel_part
def _normal_matrix(
    window: Float, n: int, normal: Float, variance: float, square_misfit: float
) -> float:
    """Fills in the lower half of matrix n of `normal`; returns which sum of squares is tolerated.

    That is weighted, of residuals: an error e of the place along some direction changes a grey
    level by g e, g its slope along it.
    Entries are added up by names of their own, one for each: so they stay in registers.
    """
    tolerated, k = 0.0, np.uintp(0)
    n00 = n10 = n11 = n20 = n21 = n22 = n30 = n31 = n32 = n33 = 0.0
    n40 = n41 = n42 = n43 = n44 = n50 = n51 = n52 = n53 = n54 = n55 = 0.0
    n60 = n61 = n62 = n63 = n64 = n65 = n66 = 0.0
    n70 = n71 = n72 = n73 = n74 = n75 = n76 = n77 = 0.0
    for y in range(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1):
        for x in range(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1):
            g0, g1 = window[n, SLOPE_U, k], window[n, SLOPE_V, k]
            g2, g3, g4, g5 = g0 * x, g0 * y, g1 * x, g1 * y
            g7, w = window[n, LEVEL, k], WEIGHT[k]
            square_slope = 0.5 * (g0 * g0 + g1 * g1)  # the mean over directions
            tolerated += w * (variance + square_misfit * square_slope)
            w0, w1, w2, w3 = w * g0, w * g1, w * g2, w * g3
            w4, w5, w7 = w * g4, w * g5, w * g7
            n00, n10, n11 = n00 + w0 * g0, n10 + w1 * g0, n11 + w1 * g1
            n20, n21, n22 = n20 + w2 * g0, n21 + w2 * g1, n22 + w2 * g2
            n30, n31, n32, n33 = n30 + w3 * g0, n31 + w3 * g1, n32 + w3 * g2, n33 + w3 * g3
            n40, n41, n42, n43 = n40 + w4 * g0, n41 + w4 * g1, n42 + w4 * g2, n43 + w4 * g3
            n44, n50, n51, n52 = n44 + w4 * g4, n50 + w5 * g0, n51 + w5 * g1, n52 + w5 * g2
            n53, n54, n55 = n53 + w5 * g3, n54 + w5 * g4, n55 + w5 * g5
            n60, n61, n62, n63 = n60 + w * g0, n61 + w * g1, n62 + w * g2, n63 + w * g3
            n64, n65, n66 = n64 + w * g4, n65 + w * g5, n66 + w
            n70, n71, n72, n73 = n70 + w7 * g0, n71 + w7 * g1, n72 + w7 * g2, n73 + w7 * g3
            n74, n75, n76, n77 = n74 + w7 * g4, n75 + w7 * g5, n76 + w7, n77 + w7 * g7
            k += np.uintp(1)
    entries = (
        *(n00, n10, n11, n20, n21, n22, n30, n31, n32, n33),
        *(n40, n41, n42, n43, n44, n50, n51, n52, n53, n54, n55),
        *(n60, n61, n62, n63, n64, n65, n66, n70, n71, n72, n73, n74, n75, n76, n77),
    )
    for i in range(N_PARAMETERS):
        for j in range(i + 1):
            normal[n, i, j] = entries[i * (i + 1) // 2 + j]
    return tolerated
