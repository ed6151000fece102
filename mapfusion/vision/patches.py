"""Cut-outs of pictures around corners, by which tracks follow them."""

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.se2 import Float

_PATCH_HALF_PX = 17  # room for a fit's window when what it shows has grown by half
PATCH_SIDE_PX = 2 * _PATCH_HALF_PX + 1


def cut_patches(image: np.ndarray, uv_px: Float) -> np.ndarray:
    """What is around the pixels nearest to points (N, 2), (N, P, P); outside the border repeats."""
    patch = np.empty((len(uv_px), PATCH_SIDE_PX, PATCH_SIDE_PX), dtype=image.dtype)
    _cut(image, np.rint(uv_px).astype(np.int64), patch)
    return patch


@kernel
def _cut(image: np.ndarray, pixel: np.ndarray, patch: np.ndarray) -> None:
    bottom, right = image.shape[0] - 1, image.shape[1] - 1
    for n in range(len(pixel)):
        left, top = pixel[n, 0] - _PATCH_HALF_PX, pixel[n, 1] - _PATCH_HALF_PX
        for y in range(PATCH_SIDE_PX):
            row = min(max(top + y, 0), bottom)
            for x in range(PATCH_SIDE_PX):
                patch[n, y, x] = image[row, min(max(left + x, 0), right)]
