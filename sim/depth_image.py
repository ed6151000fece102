"""Depth between the pixels of a depth image."""

import numpy as np

from mapfusion.se2 import Float

SAME_SURFACE = 0.02  # neighbouring pixels whose depths differ by more belong to two surfaces


def depth_at(depth_m: np.ndarray, uv_px: Float) -> Float:
    """Depths (N,) of an image (H, W) at pixels (N, 2); NaN where nothing is.

    Between pixels of one surface the inverse depth is interpolated (it is linear in the image for a
    plane); at the edge of a surface the nearest pixel's depth counts.
    """
    height, width = depth_m.shape
    uv = np.clip(uv_px, 0, [width - 1, height - 1])
    low = np.minimum(uv.astype(np.intp), [width - 2, height - 2])
    share = uv - low
    u, v = low.T
    corners = np.stack(
        [depth_m[v, u], depth_m[v, u + 1], depth_m[v + 1, u], depth_m[v + 1, u + 1]], -1
    ).astype(np.float64)
    a, b = share.T
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], -1)
    smooth = 1 / np.sum(weights / corners, axis=-1)
    nearest = corners[np.arange(len(uv)), np.argmax(weights, axis=-1)]
    # comparisons with NaN are false, so a pixel of the background makes an edge too
    one_surface = corners.max(axis=-1) - corners.min(axis=-1) <= SAME_SURFACE * nearest
    return np.where(one_surface, smooth, nearest)
