"""Whether a pair is rectified, and the right way round: where corners lie in the other image.

Corners of either image are found and described alone, without any use of rows, and matched by their
descriptors: so a pair that is turned, shifted or scaled shows it.
"""

import numpy as np

from mapfusion.se2 import Float
from mapfusion.vision.harris import HarrisParameters, detect
from mapfusion.vision.usurf import describe

_SCALE_PX = 2.0  # of the descriptors: windows of 40 px, which small turns do not change much
_LARGEST_SHARE = 0.06  # of the height, up and down: a head that is not rectified is off by less
_MAX_DISTANCE = 0.3  # of two descriptors of one point, as tracks have it
_MAX_RATIO = 0.8  # of the nearest descriptor's distance over the second's (Lowe 2004)


def offsets(left: np.ndarray, right: np.ndarray, parameters: HarrisParameters) -> Float:
    """Columns and rows (N, 2) by which matched corners lie farther right and lower on the right.

    Images are (H, W) uint8. One false match in several is to be expected: use the median.
    """
    corners = [detect(image, parameters) for image in (left, right)]
    if min(map(len, corners)) < 2:
        return np.empty((0, 2))
    looks = [
        describe(image, uv, np.full(len(uv), _SCALE_PX))
        for image, uv in zip((left, right), corners, strict=True)
    ]
    shift = corners[1][None, :, :2] - corners[0][:, None, :2]
    squared = 2.0 - 2.0 * (looks[0] @ looks[1].T).astype(np.float64)
    squared[np.abs(shift[:, :, 1]) > _LARGEST_SHARE * len(left)] = np.inf
    nearest, back = np.argmin(squared, axis=1), np.argmin(squared, axis=0)
    rows = np.arange(len(nearest))
    best = squared[rows, nearest]
    second = np.partition(squared, 1, axis=1)[:, 1]
    kept = (back[nearest] == rows) & (best <= _MAX_DISTANCE**2)
    kept &= best <= _MAX_RATIO**2 * second
    return shift[rows, nearest][kept]
