"""Harris corners (Harris and Stephens 1988), the strongest of each part of the image."""

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
    """Which corners to take.

    Attributes:
        max_corners: at most so many an image.
        smoothing_px: standard deviation of the Gaussian that the image is smoothed with first;
            noise and the staircase edges of unfiltered textures make corners of their own. Too much
            pulls corners inwards by a share of the window, which is another point of the wall as
            the robot draws near; too little loses corners.
        min_distance_px: no two corners nearer than this, before the sub-pixel step.
        cell_px: side of the squares of the grid that share `max_corners` evenly, so that one rich
            poster does not take all.
        block_px: side of the square over which the structure tensor is averaged.
        k: Harris' constant, 0.04 to 0.06 by custom.
        min_slope: grey levels per pixel; a corner whose brightness changes by this (RMS) in every
            direction is the weakest that counts. The Sobel slope of white noise of n grey levels is
            0.43 n, so the default stands clear of a noise of 2 levels.
        border_px: margin in which no corners are taken; the stereo windows must fit.
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
    """Corners (N, 2), u and v in pixels at sub-pixel precision, strongest first.

    Raises:
        ValueError: the image has another shape or type.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image: is {image.dtype} {image.shape}, expected uint8 (H, W)")
    if min(image.shape) <= 2 * parameters.border_px:
        return np.zeros((0, 2))
    smooth = cv2.GaussianBlur(image, (0, 0), parameters.smoothing_px)
    response = harris_response(smooth, parameters)
    pixels = _strongest(response, parameters)
    if len(pixels) == 0:
        return np.zeros((0, 2))
    return _peak(response, pixels)


def harris_response(image: np.ndarray, parameters: HarrisParameters) -> np.ndarray:
    """Compute the Harris response (H, W) float32 of an image (H, W)."""
    return cv2.cornerHarris(image, parameters.block_px, _SOBEL_APERTURE_PX, parameters.k)


def _strongest(response: np.ndarray, parameters: HarrisParameters) -> np.ndarray:
    """Pixels (N, 2) int64 of the corners to keep, strongest first."""
    maxima = local_maxima(response, parameters.border_px, parameters.min_response)
    u, v = maxima.T
    candidates = maxima[np.argsort(-response[v, u], kind="stable")]
    height, width = response.shape
    cells = -(-height // parameters.cell_px) * -(-width // parameters.cell_px)
    share = -(-parameters.max_corners // cells)
    return candidates[
        spread(
            candidates,
            response.shape,
            parameters.min_distance_px,
            parameters.cell_px,
            share,
            parameters.max_corners,
        )
    ]


def local_maxima(response: np.ndarray, border: int, least: float) -> np.ndarray:
    """Return the pixels (N, 2) int64 of the local maxima of a response (H, W), row by row.

    A local maximum exceeds `least` and no response of its 3 x 3 neighbourhood exceeds it. Pixels
    within `border` of the image's edge are left out.
    """
    inner = (slice(border, -border), slice(border, -border))
    highest = cv2.dilate(response, np.ones((3, 3), np.uint8))[inner]
    v, u = np.nonzero((response[inner] == highest) & (response[inner] > least))
    return np.stack([u, v], -1) + border


def spread(
    candidates: np.ndarray,
    size: tuple[int, ...],
    min_distance: int,
    cell: int,
    per_cell: int,
    most: int,
) -> np.ndarray:
    """Which candidates (N, 2) of an image, sorted by strength, a greedy choice keeps (N,) bool.

    A first pass fills each cell up to its share, a second hands what poor cells left over to the
    strongest remaining. No two are nearer than `min_distance`.
    """
    taken, blocked = np.zeros(len(candidates), dtype=np.bool_), np.zeros(size, dtype=np.uint8)
    filled = np.zeros((size[0] // cell + 1, size[1] // cell + 1), dtype=np.int64)
    _choose(candidates, min_distance, cell, per_cell, most, blocked, filled, taken)
    return taken


# What kernels of this file need room for is made by their callers: that is not compiled.


@kernel
def _choose(
    candidates: np.ndarray,
    min_distance: int,
    cell: int,
    per_cell: int,
    most: int,
    blocked: np.ndarray,
    filled: np.ndarray,
    taken: np.ndarray,
) -> None:
    count, (height, width) = 0, blocked.shape
    for share in (per_cell, most):
        for n in range(len(candidates)):
            u, v = candidates[n, 0], candidates[n, 1]
            if count == most:
                return
            if taken[n] or blocked[v, u] or filled[v // cell, u // cell] >= share:
                continue
            taken[n] = True
            count += 1
            filled[v // cell, u // cell] += 1
            for y in range(max(v - min_distance + 1, 0), min(v + min_distance, height)):
                for x in range(max(u - min_distance + 1, 0), min(u + min_distance, width)):
                    if (x - u) * (x - u) + (y - v) * (y - v) < min_distance * min_distance:
                        blocked[y, x] = 1


def _peak(response: np.ndarray, pixels: np.ndarray) -> Float:
    """Sub-pixel maxima (N, 2) of the response, from the parabola through three pixels each way."""
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
