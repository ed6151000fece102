"""Whether a window shows one plane: a score test of its disparity for steps, creases and bends.

Where a window shows two surfaces the plane that fits best lies between them, in every picture
again: many observations do not average that out. Under the plane d + a x + b y residuals are noise;
where the disparity has further terms, each leaves its derivative times the slope g of the grey
levels. The score test (Rao 1948; Breusch and Pagan 1980) asks for all of them without a second fit.
"""

import numpy as np

from mapfusion.kernels import kernel_part
from mapfusion.se2 import Float
from mapfusion.symmetric import cholesky, solve_lower

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
COLUMNS = _BRIGHTNESS + len(_TERMS)
FURTHER_TERMS = len(_FURTHER)
# Share of each term's square that stands against it: terms that the texture does not tell from
# others then count nothing.
_RIDGE = 1e-6
SQUARES = 9  # of the sums of a row the first of g^2
SUMS = 14  # of a row: g times 1, L and r, each with x^0 to x^2, and g^2 with x^0 to x^4


@kernel_part
def score(grid: Float, whole: Float, normal: Float, moment: Float) -> float:
    """What a window holds against one plane.

    Args:
        grid: (3, 5, 3, SUMS) of `window_sums`, changed.
        whole: sums over the window: of 1, L, L^2, r and L r, with L its grey levels and r what the
            right picture differs by.
        normal: (COLUMNS, COLUMNS), on the way.
        moment: (COLUMNS,), likewise.

    Returns:
        r^T P K (K^T P K)^-1 K^T P r in squared grey levels, K the further terms and P the
        projection that takes out brightness and plane: of white noise in r its variance times a
        chi-square variable of `FURTHER_TERMS` degrees of freedom.
    """
    _fold(grid)
    _fill_in(grid, normal, moment)
    normal[0, 0], normal[1, 0], normal[1, 1] = whole[0], whole[1], whole[2]
    moment[0], moment[1] = whole[3], whole[4]
    for i in range(COLUMNS):
        normal[i, i] = normal[i, i] * (1 + _RIDGE) + _RIDGE
    against = 0.0
    if cholesky(normal, 0.0):
        solve_lower(normal, moment)
        for i in range(_KNOWN, COLUMNS):
            against += moment[i] ** 2
    return against


@kernel_part
def _fold(grid: Float) -> None:
    """From sums (3, 5, 3, SUMS) by the side of y and of x to sums with signs, in place.

    Along either axis: first of all pixels, then with the sign sgn, then with sgn^2, which is 0 at
    the centre.
    """
    for q in range(5):
        for k in range(SUMS):
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


@kernel_part
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
