"""Upright SURF descriptor (Bay, Ess, Tuytelaars and Van Gool 2008), without orientation.

A window of side 20 s around the keypoint is sampled 20x20 times, s apart. At each sample two Haar
wavelets of side 2 s respond to the change of brightness in u and v, weighted by a Gaussian of 3.3 s
around the keypoint. Each of 4x4 cells (5x5 samples) gives (sum dx, sum dy, sum |dx|, sum |dy|); the
64 numbers are scaled to unit length.

Wavelet corners lie on one 22x22 grid, s apart, and neighbours share them. Each node is interpolated
bilinearly in the integral image once. The interpolation is exact for pixels of constant brightness,
at any fractional position and scale. Beyond the border it becomes an extrapolation, which is exact
for an image with repeated border pixels.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np

from mapfusion.geometry.numerics import Float, kernel, require_finite, require_shape
from mapfusion.parameters import Range, require_at_least, require_in_range

CELLS = 4
SAMPLES_PER_CELL = 5
SAMPLES = CELLS * SAMPLES_PER_CELL  # per side; also the side of the window in units of the scale
NODES = SAMPLES + 2  # a wavelet spans two intervals
GAUSSIAN_SIGMA = 3.3  # in units of the scale
LENGTH = 4 * CELLS * CELLS
# A window with a smaller norm (grey levels, mean over half a wavelet) is flat. Rounding errors are
# below 1e-9; one grey level at one pixel in the middle of a 40 px window gives 0.1.
FLAT_NORM = 1e-4


@dataclass(frozen=True)
class USurfParameters:
    """Parameters of the descriptor's window.

    Attributes:
        window: "pixels" for the same scale at all keypoints; "metric" for a window that covers the
            same area of a wall at any distance, which needs the depth.
        scale_px: scale s of "pixels".
        side_m: side of the window of "metric" at the keypoint's depth Z; s = f side_m / (20 Z).
        min_scale_px: lower bound of "metric"; below one pixel no pixels are averaged.
        max_scale_px: upper bound of "metric"; a window near the image's size is mostly border.
    """

    window: Literal["pixels", "metric"] = "metric"
    scale_px: Annotated[float, Range(0.1, 200, "px")] = 2.0
    side_m: Annotated[float, Range(0.01, 10, "m")] = 0.6
    min_scale_px: Annotated[float, Range(0.1, 200, "px")] = 1.0
    max_scale_px: Annotated[float, Range(0.1, 200, "px")] = 30.0

    def __post_init__(self) -> None:
        if self.window not in ("pixels", "metric"):
            raise ValueError(f'window: is "{self.window}", expected "pixels" or "metric"')
        require_in_range(self)
        require_at_least(self.min_scale_px, self, "max_scale_px")

    def scales_px(self, depth_m: Float, focal_px: float) -> Float:
        """Return the scales (N,) of keypoints at depths (N,)."""
        if self.window == "pixels":
            return np.full(len(depth_m), self.scale_px)
        metric = focal_px * self.side_m / (SAMPLES * np.asarray(depth_m))
        return np.clip(metric, self.min_scale_px, self.max_scale_px)


_OFFSET = np.arange(SAMPLES) - (SAMPLES - 1) / 2
_FALLOFF = np.exp(-(_OFFSET**2) / (2 * GAUSSIAN_SIGMA**2))
_WEIGHTS = np.outer(_FALLOFF, _FALLOFF)  # of the samples; the scaling cancels in normalisation


def describe(image: np.ndarray, uv_px: Float, scale_px: Float) -> np.ndarray:
    """Compute the descriptors of keypoints.

    Args:
        image: shape (H, W) uint8.
        uv_px: fractional keypoints, shape (N, 2); the centre of the top left pixel is (0, 0).
        scale_px: scale s of each keypoint, shape (N,); the window's side is 20 s.

    Returns:
        Descriptors of unit length, shape (N, 64) float32; zero where the window is flat. A window
        that leaves the image sees the border pixels repeated.

    Raises:
        ValueError: wrong shape, type or value; names the argument.
    """
    if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(f"image: is {image.dtype} {image.shape}, expected uint8 (H, W)")
    if image.size * 255 > np.iinfo(np.int32).max:
        raise ValueError(f"image: {image.size} pixels overflow a 32-bit integral image")
    uv = np.ascontiguousarray(uv_px, dtype=np.float64)
    scale = np.ascontiguousarray(scale_px, dtype=np.float64)
    require_shape("uv_px", uv, (None, 2))
    require_finite("uv_px", uv)
    require_shape("scale_px", scale, (len(uv),))
    if not np.all((scale > 0) & np.isfinite(scale)):
        raise ValueError("scale_px: must be positive and finite")
    return _describe(cv2.integral(image, sdepth=cv2.CV_32S), uv, scale)


@kernel
def _describe(integral: np.ndarray, uv: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Compute the descriptors of keypoints from the integral image.

    Args:
        integral: integral image, shape (H + 1, W + 1) int32.
        uv: keypoints in px, shape (N, 2).
        scale: scale of each keypoint in px, shape (N,).

    Returns:
        Descriptors of unit length, shape (N, 64) float32; zero where the window is flat.
    """
    descriptor = np.empty((len(uv), LENGTH), np.float32)
    node, sums = np.empty((NODES, NODES)), np.empty((4, SAMPLES))
    column, fraction_u = np.empty(NODES, np.int64), np.empty(NODES)
    for n in range(len(uv)):
        # Interpolate the integral image at the wavelets' corners.
        u = uv[n, 0]
        v = uv[n, 1]
        own_scale = scale[n]
        height, width = integral.shape[0] - 1, integral.shape[1] - 1
        middle = (NODES - 1) / 2
        for j in range(NODES):
            # the integral image counts from the pixel's corner
            x = u + 0.5 + (j - middle) * own_scale
            column[j] = min(max(int(np.floor(x)), 0), width - 1)
            fraction_u[j] = x - column[j]
        for i in range(NODES):
            y = v + 0.5 + (i - middle) * own_scale
            row = min(max(int(np.floor(y)), 0), height - 1)
            fraction_v = y - row
            for j in range(NODES):
                x = column[j]
                top_left, top_right = integral[row, x], integral[row, x + 1]
                low_left, low_right = integral[row + 1, x], integral[row + 1, x + 1]
                top = top_left + fraction_u[j] * (top_right - top_left)
                low = low_left + fraction_u[j] * (low_right - low_left)
                node[i, j] = top + fraction_v * (low - top)
        norm_squared = 0.0
        for cell_row in range(CELLS):
            # Column sums of weighted dx, dy, |dx|, |dy| over the sample rows of a row of cells.
            first_row = cell_row * SAMPLES_PER_CELL
            sums[:] = 0.0
            for i in range(first_row, first_row + SAMPLES_PER_CELL):
                for j in range(SAMPLES):
                    left = node[i + 2, j] - node[i, j]
                    centre = node[i + 2, j + 1] - node[i, j + 1]
                    right = node[i + 2, j + 2] - node[i, j + 2]
                    second_difference_left = node[i, j] - 2.0 * node[i + 1, j] + node[i + 2, j]
                    second_difference_right = (
                        node[i, j + 2] - 2.0 * node[i + 1, j + 2] + node[i + 2, j + 2]
                    )
                    dx = _WEIGHTS[i, j] * (left - 2.0 * centre + right)
                    dy = _WEIGHTS[i, j] * (second_difference_right - second_difference_left)
                    sums[0, j] += dx
                    sums[1, j] += dy
                    sums[2, j] += abs(dx)
                    sums[3, j] += abs(dy)
            for cell_column in range(CELLS):
                first = cell_column * SAMPLES_PER_CELL
                for k in range(4):
                    total = 0.0
                    for j in range(first, first + SAMPLES_PER_CELL):
                        total += sums[k, j]
                    descriptor[n, 4 * (CELLS * cell_row + cell_column) + k] = total
                    norm_squared += total * total
        # a wavelet's two halves have an area of 2 s^2 each
        flat = np.sqrt(norm_squared) < FLAT_NORM * 2 * scale[n] ** 2
        factor = 0.0 if flat else 1.0 / np.sqrt(norm_squared)
        for k in range(LENGTH):
            descriptor[n, k] *= factor
    return descriptor
