"""What tests of a window ask for: sums over its pixels, by powers and sides of x and y.

They are taken in two steps: down the columns, with powers of y, apart above the middle row, in it
and below; then along x. Only the first goes over all pixels, in the processor's vectors.
"""

from functools import cache

import numpy as np

from mapfusion.se2 import Float

# Products that are summed down the columns: with L the grey levels of the left picture, g and h
# their slopes along u and v, r = right - left. Those of g also times y and its square, g^2 times
# all powers up to the fourth.
GG, G, GL, GR = 0, 5, 8, 11
L, LL, R, LR, HH, RR, ONE = range(14, 21)
N_PRODUCTS = 21
# How the rows above the middle, in it and below count, and likewise columns: all, by their sign and
# by its square; what is above (or to the left) alone, and what is below.
SIDES = np.array([[1, 1, 1], [-1, 0, 1], [1, 0, 1], [1, 0, 0], [0, 0, 1]], dtype=np.float64)
ALL = 0
ABOVE = LEFT = 3
BELOW = RIGHT = 4
_SQUARED = 2  # place in it of the signs squared
_POWERS = 5  # from 0 on

Moment = tuple[int, int, int]  # a product times a power of y, how rows count, how columns do


def moment(product: int, p: int = 0, s: int = ALL, q: int = 0, t: int = ALL) -> Moment:
    """The sum of a product times x^p y^q, where columns count as `SIDES` s and rows as t."""
    # what has the sign's square as well as a power loses nothing without it
    s, t = (ALL if power and side == _SQUARED else side for power, side in ((p, s), (q, t)))
    return product + q, t, s * _POWERS + p


@cache
def column_weights(half: int) -> Float:
    """How the columns of a window count (S, 2 half + 1), by the last number of a moment."""
    x = np.arange(-half, half + 1)
    powers = np.vander(x.astype(np.float64), _POWERS, increasing=True).T
    weights = (SIDES[:, None, np.sign(x) + 1] * powers).reshape(-1, len(x))
    weights.setflags(write=False)
    return weights
