"""How the surroundings of points looked at first, prepared for finding them again.

All that a fit (`patch_fit.py`) needs of the earlier picture is here, so it is made once a track and
not once a view: grey levels, their slopes, and the Cholesky factor of the normal matrix.
"""

import math
from collections.abc import Iterator
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

# Sums of one product down a window's columns have whole vectors of room, and lie as far from those
# of the next as is known when loops over them are compiled.
WIDE = 24
_AT = tuple(np.uintp(k * WIDE) for k in range(20))
# Derivatives by the parameters: a factor, and what of x and y it goes with. Where the products of
# two factors begin among the sums; those with higher powers of y follow.
_DERIVATIVES = ("u", "v", "ux", "uy", "vx", "vy", "1", "L")
_PRODUCTS = {"uu": 0, "uv": 3, "vv": 6, "1u": 9, "1v": 11, "Lu": 13, "Lv": 15}
_PRODUCTS |= {"11": 17, "1L": 18, "LL": 19}


def _entries() -> Iterator[tuple[int, int, int, int]]:
    """Of the normal matrix' lower half: row, column, place of its sums, and the power of x."""
    for i, one in enumerate(_DERIVATIVES):
        for j, other in enumerate(_DERIVATIVES[: i + 1]):
            both = one + other
            place = _PRODUCTS["".join(sorted(one[0] + other[0]))] + both.count("y")
            yield i, j, place, both.count("x")


_ENTRIES = np.array([*_entries()])
_X_POWERS = np.vander(np.arange(-WINDOW_HALF_PX, WINDOW_HALF_PX + 1.0), 3, increasing=True).T.copy()


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
    shown, down = np.empty((_SIDE_PX + 2) ** 2), np.empty(len(_AT) * WIDE)
    for n in range(len(rows)):
        i = rows[n]
        tolerated[i] = NO_FIT
        middle, reach = patch.shape[1] // 2, max(abs(point[n, 0]), abs(point[n, 1]))
        if reach + WINDOW_HALF_PX + 2 > middle:
            continue
        _read_grid(patch, n, middle + point[n, 0], middle + point[n, 1], shown)
        _fill_window(shown, window, i)
        sum_of_squares = _normal_matrix(window, i, factor, variance, square_misfit, down)
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
    window: Float, n: int, normal: Float, variance: float, square_misfit: float, down: Float
) -> float:
    """Fills in the lower half of matrix n of `normal`; returns which sum of squares is tolerated.

    That is weighted, of residuals: an error e of the place along some direction changes a grey
    level by g e, g its slope along it, whose square is a mean over directions.
    Sums are taken down the columns first, into `down`: so loops run in vectors.
    """
    for k in range(len(down)):
        down[k] = 0.0
    for row in range(_SIDE_PX):
        y, at = float(row - WINDOW_HALF_PX), np.uintp(row * _SIDE_PX)
        yy = y * y
        for x in range(_SIDE_PX):
            m, k = np.uintp(x), at + np.uintp(x)
            u, v, level = window[n, SLOPE_U, k], window[n, SLOPE_V, k], window[n, LEVEL, k]
            w = WEIGHT[k]
            wu, wv, w_level = w * u, w * v, w * level
            uu, uv, vv, u_level, v_level = wu * u, wu * v, wv * v, wu * level, wv * level
            down[m] += uu
            down[m + _AT[1]] += uu * y
            down[m + _AT[2]] += uu * yy
            down[m + _AT[3]] += uv
            down[m + _AT[4]] += uv * y
            down[m + _AT[5]] += uv * yy
            down[m + _AT[6]] += vv
            down[m + _AT[7]] += vv * y
            down[m + _AT[8]] += vv * yy
            down[m + _AT[9]] += wu
            down[m + _AT[10]] += wu * y
            down[m + _AT[11]] += wv
            down[m + _AT[12]] += wv * y
            down[m + _AT[13]] += u_level
            down[m + _AT[14]] += u_level * y
            down[m + _AT[15]] += v_level
            down[m + _AT[16]] += v_level * y
            down[m + _AT[17]] += w
            down[m + _AT[18]] += w_level
            down[m + _AT[19]] += w_level * level
    for e in range(len(_ENTRIES)):
        first, power, total = np.uintp(_ENTRIES[e, 2]) * np.uintp(WIDE), _ENTRIES[e, 3], 0.0
        for x in range(_SIDE_PX):
            total += down[first + np.uintp(x)] * _X_POWERS[power, x]
        normal[n, _ENTRIES[e, 0], _ENTRIES[e, 1]] = total
    square_slopes = normal[n, 0, 0] + normal[n, 1, 1]
    return variance * normal[n, 6, 6] + 0.5 * square_misfit * square_slopes
