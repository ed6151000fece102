"""Features of one stereo pair, as arrays."""

from dataclasses import dataclass

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.parameters import require_finite, require_shape
from mapfusion.tables import DESCRIPTOR_LENGTH

_PATCH_HALF_PX = 17  # room for a fit's window when what it shows has grown by half
PATCH_SIDE_PX = 2 * _PATCH_HALF_PX + 1


def cut_patches(image: np.ndarray, uv_px: Float) -> np.ndarray:
    """What is around the pixels nearest to points (N, 2), (N, P, P); outside the border repeats."""
    middle, around = np.rint(uv_px).astype(np.int64), np.arange(PATCH_SIDE_PX) - _PATCH_HALF_PX
    u, v = (middle[:, axis, None] + around for axis in (0, 1))
    rows, columns = (np.clip(at, 0, n - 1) for at, n in zip((v, u), image.shape, strict=True))
    return image[rows[:, :, None], columns[:, None, :]]


@dataclass(frozen=True)
class Features:
    """Matched and described corners of one frame, the strongest corner first.

    Attributes:
        uv_px: (N, 2) in the left image.
        disparity_px: (N,) positive.
        sigma_disparity_px: (N,) standard deviation of the disparity.
        descriptor: (N, 64) float32, unit length.
        slope: (N, 2) change of the disparity along u and v, on the corner's surface; None: none.
        patch: (N, P, P) uint8, what the left image shows around the pixel nearest to the corner,
            see `cut_patches`; None: corners are followed by their own places.
    """

    uv_px: Float
    disparity_px: Float
    sigma_disparity_px: Float
    descriptor: np.ndarray
    slope: Float | None = None
    patch: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.uv_px)
        require_shape("uv_px", self.uv_px, (n, 2))
        require_shape("disparity_px", self.disparity_px, (n,))
        require_shape("sigma_disparity_px", self.sigma_disparity_px, (n,))
        require_shape("descriptor", self.descriptor, (n, DESCRIPTOR_LENGTH))
        if self.slope is not None:
            require_shape("slope", self.slope, (n, 2))
            require_finite("slope", self.slope)
        if self.patch is not None:
            require_shape("patch", self.patch, (n, PATCH_SIDE_PX, PATCH_SIDE_PX))
        for name in ("uv_px", "disparity_px", "sigma_disparity_px", "descriptor"):
            require_finite(name, getattr(self, name))
        if np.any(self.disparity_px <= 0):
            raise ValueError("disparity_px: must be positive")

    def __len__(self) -> int:
        return len(self.uv_px)
