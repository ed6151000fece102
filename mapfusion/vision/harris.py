"""Harris corner detector (Harris and Stephens 1988) with an even spread over the image."""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from mapfusion.geometry.numerics import Float, kernel
from mapfusion.parameters import Range, require_in_range

_SOBEL_APERTURE_PX = 3
_SOBEL_GAIN = 2.0  # OpenCV divides its Sobel sum, 8 times the slope per pixel, by 4


@dataclass(frozen=True)
class HarrisParameters:
    """Parameters of the corner detector.

    Attributes:
        max_corners: largest number of corners per image.
        smoothing_px: standard deviation of the Gaussian that smooths the image first. Noise and
            aliased edges cause false corners. Strong smoothing displaces corners inwards by a share
            of the window, so the corner changes with the distance. Weak smoothing loses corners.
        min_distance_px: smallest distance between two corners, before the sub-pixel step.
        cell_px: side of the grid cells that share `max_corners` evenly. One rich texture then does
            not take all corners.
        block_px: side of the square over which the structure tensor is averaged.
        k: Harris' constant, 0.04 to 0.06 by custom.
        min_slope: smallest RMS slope of the grey levels of a corner in every direction. The Sobel
            slope of white noise of n grey levels is 0.43 n, so the default exceeds the slope of a
            noise of 2 levels.
        border_px: margin without corners; the stereo windows must fit.
    """

    max_corners: Annotated[int, Range(1, 5000, "corners")] = 110
    smoothing_px: Annotated[float, Range(0.1, 50, "px")] = 1.5
    min_distance_px: Annotated[int, Range(1, 1000, "px")] = 10
    cell_px: Annotated[int, Range(8, 4096, "px")] = 160
    block_px: Annotated[int, Range(1, 99, "px")] = 3
    k: Annotated[float, Range(1e-4, 0.2499, "1")] = 0.04
    min_slope: Annotated[float, Range(1e-3, 1000, "grey levels/px")] = 2.5
    border_px: Annotated[int, Range(1, 2048, "px")] = 12

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def min_response(self) -> float:
        """OpenCV's response of a corner with `min_slope` in every direction.

        det M - k (trace M)^2 with both eigenvalues of M equal; OpenCV scales grey levels to 0..1.
        """
        eigenvalue = (_SOBEL_GAIN * self.min_slope / 255) ** 2
        return eigenvalue**2 * (1 - 4 * self.k)


def detect(image: np.ndarray, parameters: HarrisParameters) -> Float:
    """Detect the corners (N, 2), u and v in pixels at sub-pixel precision, strongest first.

    Raises:
        ValueError: the image has another shape or type.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image: is {image.dtype} {image.shape}, expected uint8 (H, W)")
    if min(image.shape) <= 2 * parameters.border_px:
        return np.zeros((0, 2))
    smooth = cv2.GaussianBlur(image, (0, 0), parameters.smoothing_px)
    response = cv2.cornerHarris(smooth, parameters.block_px, _SOBEL_APERTURE_PX, parameters.k)
    pixels = strongest_maxima(response, parameters)
    if len(pixels) == 0:
        return np.zeros((0, 2))

    # Sub-pixel maximum: vertex of the parabola through three pixels along each axis.
    u, v = pixels.T
    top = response[v, u].astype(np.float64)
    offset = np.empty((len(pixels), 2))
    for axis, (du, dv) in enumerate(((1, 0), (0, 1))):
        before = response[v - dv, u - du].astype(np.float64)
        after = response[v + dv, u + du].astype(np.float64)
        curvature = before - 2 * top + after
        # a maximum lies within half a pixel; a plateau stays where it is
        offset[:, axis] = np.where(
            curvature < 0, (before - after) / np.where(curvature < 0, 2 * curvature, 1), 0
        )
    return pixels + offset


def strongest_maxima(response: np.ndarray, parameters: HarrisParameters) -> np.ndarray:
    """Select local maxima of a response (H, W): pixels (N, 2) int64, strongest first."""
    maxima = local_maxima(response, parameters.border_px, parameters.min_response)
    u, v = maxima.T
    candidates = maxima[np.argsort(-response[v, u], kind="stable")]
    height, width = response.shape
    cells = -(-height // parameters.cell_px) * -(-width // parameters.cell_px)
    per_cell = -(-parameters.max_corners // cells)
    is_selected = spread(
        candidates,
        response.shape,
        parameters.min_distance_px,
        parameters.cell_px,
        per_cell,
        parameters.max_corners,
    )
    return candidates[is_selected]


def local_maxima(response: np.ndarray, border: int, least: float) -> np.ndarray:
    """Return the pixels (N, 2) int64 of the local maxima of a response (H, W), row by row.

    A local maximum exceeds `least` and no response of its 3 x 3 neighbourhood exceeds it. Pixels
    within `border` of the image's edge are left out.
    """
    inner = (slice(border, -border), slice(border, -border))
    highest = cv2.dilate(response, np.ones((3, 3), np.uint8))[inner]
    v, u = np.nonzero((response[inner] == highest) & (response[inner] > least))
    return np.stack([u, v], -1) + border


@kernel
def spread(
    candidates: np.ndarray,
    size: tuple[int, ...],
    min_distance: int,
    cell: int,
    per_cell: int,
    most: int,
) -> np.ndarray:
    """Select candidates greedily, evenly spread over the image.

    The first pass fills each cell up to its share. The second pass gives the share that poor cells
    leave over to the strongest remaining candidates. No two selected candidates are nearer to each
    other than `min_distance`.

    Args:
        candidates: pixels (u, v), shape (N, 2), strongest first.
        size: height and width of the image.
        min_distance: smallest distance between two selected candidates, pixels.
        cell: side of a cell, pixels.
        per_cell: share of each cell, candidates.
        most: largest number of selected candidates.

    Returns:
        Shape (N,) bool, True for the selected candidates.
    """
    selected, blocked = np.zeros(len(candidates), np.bool_), np.zeros(size, np.uint8)
    filled = np.zeros((size[0] // cell + 1, size[1] // cell + 1), np.int64)
    count, (height, width) = 0, size
    for share in (per_cell, most):
        for n in range(len(candidates)):
            u, v = candidates[n, 0], candidates[n, 1]
            if count == most:
                return selected
            if selected[n] or blocked[v, u] or filled[v // cell, u // cell] >= share:
                continue
            selected[n] = True
            count += 1
            filled[v // cell, u // cell] += 1
            for y in range(max(v - min_distance + 1, 0), min(v + min_distance, height)):
                for x in range(max(u - min_distance + 1, 0), min(u + min_distance, width)):
                    if (x - u) * (x - u) + (y - v) * (y - v) < min_distance * min_distance:
                        blocked[y, x] = 1
    return selected
