"""Whether a window shows a silhouette: each of its halves is held against the plane of the whole.

Where two surfaces meet in the image and nothing in the world, one half is not on the plane.
"""

import numpy as np

from mapfusion.kernels import kernel_part
from mapfusion.se2 import Float
from mapfusion.vision.window_moments import (
    ABOVE,
    ALL,
    BELOW,
    GG,
    HH,
    LEFT,
    ONE,
    RIGHT,
    RR,
    R,
    moment,
)

_OF_A_HALF = (ONE, R, RR, GG, HH)
_EACH = len(_OF_A_HALF)
# How columns and rows of the left half, the right, the upper and the lower one count.
_HALVES = ((LEFT, ALL), (RIGHT, ALL), (ALL, ABOVE), (ALL, BELOW))
ASKED = tuple(moment(product, s=s, t=t) for s, t in _HALVES for product in _OF_A_HALF)


def disagrees(squares: Float, noise: float, max_misfit: float, max_rows: float) -> np.ndarray:
    """Whether any half (left, right, upper, lower) of each window does not fit the plane (N,) bool.

    An error e in disparity changes the grey level by g e, g its slope along u, and rows that are
    off by f change it by h f, h its slope along v. So a half fits when
    sum r^2 <= n 2 noise^2 + max_misfit^2 sum g^2 + max_rows^2 sum h^2.

    Args:
        squares: (N, 4, 4) from `window_sums`.
        noise: standard deviation of one image's grey levels.
        max_misfit: e, pixels.
        max_rows: f, pixels.
    """
    tolerated = squares[..., [0, 2, 3]] @ [2 * noise**2, max_misfit**2, max_rows**2]
    return np.any(squares[..., 1] > tolerated, axis=1)


@kernel_part
def fill_in_halves(sums: Float, place: np.ndarray, squares: Float, n: int) -> None:
    """Fill in the halves (4, 4) of window n, see `window_sums`; residuals less their own mean.

    `place` is that of the sums that are `ASKED` for.
    """
    first, second = 2 * _EACH, 3 * _EACH  # the upper half and the lower one
    count = sums[place[first]] + sums[place[second]]
    off = sums[place[first + 1]] + sums[place[second + 1]]
    offset = off / count if count > 0 else 0.0  # in brightness
    for k in range(4):
        at = k * _EACH
        pixels, residuals, square = sums[place[at]], sums[place[at + 1]], sums[place[at + 2]]
        squares[n, k, 0] = pixels
        squares[n, k, 1] = square + pixels * offset**2 - 2 * offset * residuals
        squares[n, k, 2], squares[n, k, 3] = sums[place[at + 3]], sums[place[at + 4]]
