"""Whether a window shows a silhouette: each of its halves is held against the plane of the whole.

Where two surfaces meet in the image and nothing in the world, one half is not on the plane.
"""

import numpy as np
from numba import njit

from mapfusion.vision.plane_fit import grey_at


@njit(cache=True)
def disagrees(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: np.ndarray,
    half: int,
    noise: float,
    max_misfit: float,
    max_rows: float,
) -> np.ndarray:
    """Whether any half (left, right, upper, lower) of each window does not fit the plane.

    An error e in disparity changes the grey level by g e, g its slope along u, and rows that are
    off by f change it by h f, h its slope along v. So a half fits when
    sum r^2 <= n 2 noise^2 + max_misfit^2 sum g^2 + max_rows^2 sum h^2.

    Args:
        left: (H, W) uint8.
        right: (H, W) uint8.
        pixel: (N, 2) int64 centres of the windows; what leaves an image is not looked at.
        plane: (N, 3) from `fit_planes`.
        half: half side of the window, pixels.
        noise: standard deviation of one image's grey levels.
        max_misfit: e, pixels.
        max_rows: f, pixels.

    Returns:
        (N,) bool.
    """
    verdict = np.empty(len(pixel), dtype=np.bool_)
    square = np.empty((4, 4))
    for n in range(len(pixel)):
        _halves(left, right, pixel[n], plane[n], half, square)
        verdict[n] = False
        for k in range(4):
            tolerated = square[k, 0] * 2 * noise**2 + max_misfit**2 * square[k, 2]
            if square[k, 1] > tolerated + max_rows**2 * square[k, 3]:
                verdict[n] = True
    return verdict


@njit(cache=True)
def half_squares(
    left: np.ndarray, right: np.ndarray, pixel: np.ndarray, plane: np.ndarray, half: int
) -> np.ndarray:
    """What `disagrees` looks at, of each half of each window (N, 4, 4).

    In the last axis: pixels, sum of squared residuals, of squared slopes along u and along v.
    """
    squares = np.empty((len(pixel), 4, 4))
    for n in range(len(pixel)):
        _halves(left, right, pixel[n], plane[n], half, squares[n])
    return squares


@njit(cache=True)
def _halves(
    left: np.ndarray,
    right: np.ndarray,
    pixel: np.ndarray,
    plane: np.ndarray,
    half: int,
    squares: np.ndarray,
) -> None:
    """Fill in (4, 4), see `half_squares`; residuals without the window's offset in brightness."""
    height, width = left.shape
    u, v = pixel[0], pixel[1]
    residuals = np.zeros(4)  # their sums: left, right, upper, lower
    squares[:] = 0.0
    for y in range(max(-half, -v), min(half, height - 1 - v) + 1):
        above, below = max(v + y - 1, 0), min(v + y + 1, height - 1)
        for x in range(max(-half, 1 - u), min(half, width - 2 - u) + 1):
            at = u + x - plane[0] - plane[1] * x - plane[2] * y
            if not 1 <= at < width - 2:
                continue
            residual = grey_at(right, at, v + y) - float(left[v + y, u + x])
            slope = 0.5 * (float(left[v + y, u + x + 1]) - float(left[v + y, u + x - 1]))
            down = (float(left[below, u + x]) - float(left[above, u + x])) / (below - above)
            for k in range(4):
                if (x < 0, x > 0, y < 0, y > 0)[k]:
                    residuals[k] += residual
                    squares[k, 0] += 1
                    squares[k, 1] += residual**2
                    squares[k, 2] += slope**2
                    squares[k, 3] += down**2
    count = squares[2, 0] + squares[3, 0]
    offset = (residuals[2] + residuals[3]) / count if count > 0 else 0.0  # in brightness
    for k in range(4):
        squares[k, 1] += squares[k, 0] * offset**2 - 2 * offset * residuals[k]
