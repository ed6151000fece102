"""Whether a window shows a silhouette: each of its halves is held against the plane of the whole.

Where two surfaces meet in the image and nothing in the world, one half is not on the plane.
"""

import numpy as np

from mapfusion.kernels import kernel_part
from mapfusion.se2 import Float

_COUNT, _OFF, _SLOPE_2, _DOWN_2, _OFF_2 = 0, 3, 5, 6, 7  # of a part of a window, see `window_sums`


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
def fill_in_halves(parts: Float, squares: Float, n: int) -> None:
    """Fill in the halves (4, 4) of window n, see `window_sums`; residuals less their own mean."""
    count = off = 0.0
    for side in range(3):
        count += parts[0, side, _COUNT] + parts[2, side, _COUNT]
        off += parts[0, side, _OFF] + parts[2, side, _OFF]
    offset = off / count if count > 0 else 0.0  # in brightness
    for k in range(4):
        pixels = residuals = square = slopes = downs = 0.0
        for i in range(3):
            part, side = (i, k * 2) if k < 2 else ((k - 2) * 2, i)
            pixels += parts[part, side, _COUNT]
            residuals += parts[part, side, _OFF]
            square += parts[part, side, _OFF_2]
            slopes += parts[part, side, _SLOPE_2]
            downs += parts[part, side, _DOWN_2]
        squares[n, k, 0], squares[n, k, 2], squares[n, k, 3] = pixels, slopes, downs
        squares[n, k, 1] = square + pixels * offset**2 - 2 * offset * residuals
