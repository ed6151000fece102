"""Depth between the pixels of a depth image."""

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.se2 import Float

SAME_SURFACE = 0.02  # neighbouring pixels whose depths differ by more belong to two surfaces


def depth_at(depth_m: np.ndarray, uv_px: Float) -> Float:
    """Depths (N,) of an image (H, W) at pixels (N, 2); NaN where nothing is.

    Between pixels of one surface the inverse depth is interpolated (it is linear in the image for a
    plane); at the edge of a surface the nearest pixel's depth counts.
    """
    uv = np.ascontiguousarray(uv_px, dtype=np.float64)
    found = np.empty(len(uv))
    _read(depth_m, uv, found)
    return found


@kernel(error_model="numpy")  # one over a depth of zero is infinite
def _read(depth_m: np.ndarray, uv: Float, found: Float) -> None:
    height, width = depth_m.shape
    for n in range(len(uv)):
        u = min(max(uv[n, 0], 0.0), width - 1.0)
        v = min(max(uv[n, 1], 0.0), height - 1.0)
        i, j = min(int(v), height - 2), min(int(u), width - 2)
        a, b = u - j, v - i
        p, q = float(depth_m[i, j]), float(depth_m[i, j + 1])
        r, s = float(depth_m[i + 1, j]), float(depth_m[i + 1, j + 1])
        at_p, at_q, at_r, at_s = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        nearest, most = p, at_p
        for depth, weight in ((q, at_q), (r, at_r), (s, at_s)):
            if weight > most:
                nearest, most = depth, weight
        found[n] = nearest
        # comparisons with NaN are false, so a pixel of the background makes an edge too
        apart = max(p, q, r, s) - min(p, q, r, s)
        if p + q + r + s > 0 and apart <= SAME_SURFACE * nearest:
            found[n] = 1 / (at_p / p + at_q / q + at_r / r + at_s / s)
