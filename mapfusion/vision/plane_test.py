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
_FLAT = 6  # of a window: 1, L, L^2, r, L r and h^2


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
    first, last = max(-half, 1 - u), min(half, width - 2 - u)
    grid, row, flat = np.zeros((3, 5, 3, _SUMS)), np.empty((3, _SUMS)), np.zeros(_FLAT)
    for y in range(max(-half, -v), min(half, height - 1 - v) + 1):
        start = u - plane[0] - plane[2] * y
        for side in range(3):
            begin = max(first, (first, 0, 1)[side])
            end = min(last, (-1, 0, last)[side])
            _sum_up(left, right, u, v, y, begin, end, start, plane[1], row[side], flat)
        power = 1.0
        for q in range(5):
            lifted = grid[1 + (y > 0) - (y < 0), q]
            for side in range(3):
                for k in range(_SUMS):
                    lifted[side, k] += power * row[side, k]
            power *= y
    _fold(grid)
    _fill_in(grid, normal, moment)
    normal[0, 0], normal[1, 0], normal[1, 1], moment[0], moment[1] = flat[:5]
    count = max(flat[0], 1.0)
    return normal[_BRIGHTNESS, _BRIGHTNESS] / count, flat[5] / count


@njit(cache=True)
def _sum_up(
    left: np.ndarray,
    right: np.ndarray,
    u: int,
    v: int,
    y: int,
    begin: int,
    end: int,
    start: float,
    lean: float,
    sums: Float,
    flat: Float,
) -> None:
    """Sums over the pixels `begin` to `end` of a row.

    Fills `sums`: g x^k (k to 2) times 1, L and r, and g^2 x^k (k to 4); adds to `flat`: 1, L, L^2,
    r, L r and h^2, with h the slope of the grey levels L along v.
    """
    above, below = max(v + y - 1, 0), min(v + y + 1, len(left) - 1)
    shade = float(left[v, u])  # grey levels are counted from it: small numbers lose less
    g0 = g1 = g2 = l0 = l1 = l2 = r0 = r1 = r2 = s0 = s1 = s2 = s3 = s4 = 0.0
    count = own = own2 = off = own_off = down2 = 0.0
    for x in range(begin, end + 1):
        at = start + x - lean * x
        if not 1 <= at < left.shape[1] - 2:
            continue
        L = float(left[v + y, u + x])
        r = grey_at(right, at, v + y) - L
        L -= shade
        g = 0.5 * (float(left[v + y, u + x + 1]) - float(left[v + y, u + x - 1]))
        h = (float(left[below, u + x]) - float(left[above, u + x])) / (below - above)
        gx, gxx = g * x, g * x * x
        g0, g1, g2 = g0 + g, g1 + gx, g2 + gxx
        l0, l1, l2 = l0 + g * L, l1 + gx * L, l2 + gxx * L
        r0, r1, r2 = r0 + g * r, r1 + gx * r, r2 + gxx * r
        s0, s1, s2, s3, s4 = s0 + g * g, s1 + g * gx, s2 + gx * gx, s3 + gx * gxx, s4 + gxx * gxx
        count, own, own2, down2 = count + 1.0, own + L, own2 + L * L, down2 + h * h
        off, own_off = off + r, own_off + L * r
    for k, value in enumerate((g0, g1, g2, l0, l1, l2, r0, r1, r2, s0, s1, s2, s3, s4)):
        sums[k] = value
    for k, value in enumerate((count, own, own2, off, own_off, down2)):
        flat[k] += value


@njit(cache=True)
def _fold(grid: Float) -> None:
    """From sums (3, 5, 3, _SUMS) by the side of y and of x to sums with signs, in place.

    Along either axis: first of all pixels, then with the sign sgn, then with sgn^2, which is 0 at
    the centre.
    """
    for q in range(5):
        for k in range(_SUMS):
            for j in range(3):
                below, at, beyond = grid[0, q, j, k], grid[1, q, j, k], grid[2, q, j, k]
                grid[0, q, j, k] = below + at + beyond
                grid[1, q, j, k] = beyond - below
                grid[2, q, j, k] = beyond + below
            for i in range(3):
                below, at, beyond = grid[i, q, 0, k], grid[i, q, 1, k], grid[i, q, 2, k]
                grid[i, q, 0, k] = below + at + beyond
                grid[i, q, 1, k] = beyond - below
                grid[i, q, 2, k] = beyond + below


@njit(cache=True)
def _fill_in(grid: Float, normal: Float, moment: Float) -> None:
    """The entries of the disparities' terms: of a product signs and powers add up."""
    for i in range(len(_TERMS)):
        p, s, q, t = _TERMS[i]
        at = _BRIGHTNESS + i
        normal[at, 0] = grid[t, q, s, p]
        normal[at, 1] = grid[t, q, s, 3 + p]
        moment[at] = grid[t, q, s, 6 + p]
        for j in range(i + 1):
            pp, ss, qq, tt = _TERMS[j]
            normal[at, _BRIGHTNESS + j] = grid[t + tt, q + qq, s + ss, 9 + p + pp]
