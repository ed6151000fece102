"""Whether a window shows one plane: a score test of its disparity for steps, creases and bends.

Where a window shows two surfaces the plane that fits best lies between them, in every picture
again: many observations do not average that out. Under the plane d + a x + b y residuals are noise;
where the disparity has further terms, each leaves its derivative times the slope g of the grey
levels. The score test (Rao 1948; Breusch and Pagan 1980) asks for all of them without a second fit.
"""

import numpy as np
from numba import njit

from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky, solve_lower
from mapfusion.vision.plane_fit import grey_at

# Disparities g x^i sgn(x)^p y^j sgn(y)^q as (i, p, j, q): the plane, then what no plane has,
# steps at the window's centre, creases there, and bends.
_PLANE = ((0, 0, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0))
_FURTHER = (
    *((0, 1, 0, 0), (0, 0, 0, 1)),
    *((1, 1, 0, 0), (0, 0, 1, 1)),
    *((2, 0, 0, 0), (1, 0, 1, 0), (0, 0, 2, 0)),
)
_TERMS = np.array(_PLANE + _FURTHER)
_BRIGHTNESS = 2  # columns: offset and gain of one picture against the other
_KNOWN = _BRIGHTNESS + len(_PLANE)
FURTHER_TERMS = len(_FURTHER)
# Share of each term's square that stands against it: terms that the texture does not tell from
# others then count nothing.
_RIDGE = 1e-6
_SUMS = 14  # of a row: g times 1, L and r, each with x^0 to x^2, and g^2 with x^0 to x^4


@njit(cache=True)
def plane_scores(
    left: np.ndarray, right: np.ndarray, pixel: np.ndarray, plane: np.ndarray, half: int
) -> Float:
    """What windows hold against one plane, and how steep their grey levels are.

    Args:
        left: (H, W) uint8.
        right: (H, W) uint8.
        pixel: (N, 2) int64 centres of the windows; what leaves an image is not looked at.
        plane: (N, 3) from `fit_planes`.
        half: half side of the window, pixels.

    Returns:
        (N, 3): r^T P K (K^T P K)^-1 K^T P r in squared grey levels, K the further terms and P the
        projection that takes out brightness and plane: of white noise in r its variance times a
        chi-square variable of `FURTHER_TERMS` degrees of freedom. Then the mean squared slopes of
        the grey levels along u and v.
    """
    scores = np.empty((len(pixel), 3))
    columns = _BRIGHTNESS + len(_TERMS)
    normal, moment = np.empty((columns, columns)), np.empty(columns)
    for n in range(len(pixel)):
        square_u, square_v = _add_up(left, right, pixel[n], plane[n], half, normal, moment)
        for i in range(columns):
            normal[i, i] = normal[i, i] * (1 + _RIDGE) + _RIDGE
        scores[n] = 0.0, square_u, square_v
        if cholesky(normal, 0.0):
            solve_lower(normal, moment)
            scores[n, 0] = np.sum(moment[_KNOWN:] ** 2)
    return scores


@njit(cache=True)
def _add_up(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: np.ndarray,
    half: int,
    normal: Float,
    moment: Float,
) -> tuple[float, float]:
    """Fill in J^T J (lower half) and J^T r of a window; the mean squares of its slopes."""
    height, width = left.shape
    u, v = pixel[0], pixel[1]
    shade = float(left[v, u])  # grey levels are counted from it, as small numbers are exact
    row = np.empty((3, _SUMS))
    count, down = 0.0, 0.0
    normal[:] = 0.0
    moment[:] = 0.0
    for y in range(max(-half, -v), min(half, height - 1 - v) + 1):
        row[:] = 0.0
        above, below = max(v + y - 1, 0), min(v + y + 1, height - 1)
        start = u - plane[0] - plane[2] * y
        for x in range(max(-half, 1 - u), min(half, width - 2 - u) + 1):
            at = start + x - plane[1] * x
            if not 1 <= at < width - 2:
                continue
            own = float(left[v + y, u + x])
            residual = grey_at(right, at, v + y) - own
            own -= shade
            slope = 0.5 * (float(left[v + y, u + x + 1]) - float(left[v + y, u + x - 1]))
            normal[0, 0] += 1
            normal[1, 0] += own
            normal[1, 1] += own * own
            moment[0] += residual
            moment[1] += own * residual
            count += 1
            down += ((float(left[below, u + x]) - float(left[above, u + x])) / (below - above)) ** 2
            _add_pixel(row[1 + (x > 0) - (x < 0)], x, slope, own, residual)
        _add_row(row, y, normal, moment)
    if count == 0:
        return 0.0, 0.0
    return normal[_BRIGHTNESS, _BRIGHTNESS] / count, down / count


@njit(cache=True)
def _add_pixel(sums: Float, x: int, slope: float, own: float, residual: float) -> None:
    """Add g x^k (k to 2) times 1, L and r, and g^2 x^k (k to 4), to the sums of one side."""
    power = slope
    for k in range(3):
        sums[k] += power
        sums[3 + k] += power * own
        sums[6 + k] += power * residual
        power *= x
    power = slope * slope
    for k in range(5):
        sums[9 + k] += power
        power *= x


@njit(cache=True)
def _add_row(row: Float, y: int, normal: Float, moment: Float) -> None:
    """Add a row's sums left of the centre, at it and right of it (3, _SUMS), times powers of y.

    Of a product of two terms the signs multiply to 1, sgn or sgn^2, which is 0 at the centre.
    """
    along, down = np.empty((3, _SUMS)), np.empty((3, 5))
    side, power = (y > 0) - (y < 0), 1.0
    for k in range(_SUMS):
        along[1, k] = row[2, k] - row[0, k]
        along[2, k] = row[2, k] + row[0, k]
        along[0, k] = along[2, k] + row[1, k]
    for k in range(5):
        down[0, k], down[1, k], down[2, k] = power, side * power, side * side * power
        power *= y
    for i in range(len(_TERMS)):
        p, s, q, t = _TERMS[i]
        at = _BRIGHTNESS + i
        normal[at, 0] += along[s, p] * down[t, q]
        normal[at, 1] += along[s, 3 + p] * down[t, q]
        moment[at] += along[s, 6 + p] * down[t, q]
        for j in range(i + 1):
            pp, ss, qq, tt = _TERMS[j]
            normal[at, _BRIGHTNESS + j] += along[s + ss, 9 + p + pp] * down[t + tt, q + qq]
