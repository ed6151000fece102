"""Gaussian smoothing of pictures: values of OpenCV's `GaussianBlur`, sooner for the usual kernel.

OpenCV has the weights of a picture of bytes as multiples of 1/256, so sums are whole numbers and
exact in any order: down the columns they fit into 16 bits, and along rows, below 2^24, into
single precision.
"""

import cv2
import numpy as np

from mapfusion.kernels import kernel, kernel_part

REACH_PX = 5  # of the kernel that is ours: what OpenCV takes for 1.5 px
_SIGMAS = 3  # up to which OpenCV's kernel goes in a picture of bytes
_UNIT = 256.0  # of a weight
_HALF, _BITS = np.int32(1 << 15), np.int32(16)  # of the product of two


def smoothed(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """The picture (H, W) uint8 smoothed by a Gaussian; beyond the border it is mirrored."""
    taps = round(2 * _SIGMAS * sigma_px + 1) | 1
    if taps != 2 * REACH_PX + 1 or min(image.shape) <= REACH_PX:
        return cv2.GaussianBlur(image, (0, 0), sigma_px)
    blurred = np.empty(image.shape, dtype=np.uint8)
    _blur(np.ascontiguousarray(image), weights(taps, sigma_px), blurred)
    return blurred


def weights(taps: int, sigma_px: float) -> np.ndarray:
    """OpenCV's whole weights (taps // 2 + 1,), outermost first.

    What rounding takes from one, it hands on to the next; the middle has what is left.
    """
    exact, left = cv2.getGaussianKernel(taps, sigma_px).ravel() * _UNIT, 0.0
    found = np.empty(taps // 2 + 1, dtype=np.int32)
    for i in range(taps // 2):
        found[i] = round(exact[i] + left)
        left += exact[i] - found[i]
    found[-1] = int(_UNIT) - 2 * found[:-1].sum()
    return found


@kernel
def _blur(image: np.ndarray, weight: np.ndarray, blurred: np.ndarray) -> None:
    height, width = image.shape
    row, down = np.empty(2 * REACH_PX + 1, dtype=np.uintp), np.empty(width, dtype=np.uint16)
    wide = np.empty(width + 2 * REACH_PX, dtype=np.float32)
    for v in range(height):
        for i in range(2 * REACH_PX + 1):
            above = abs(v + i - REACH_PX)
            row[i] = min(above, 2 * (height - 1) - above)
        _add_rows(image, row, weight, down)
        for i in range(width):
            wide[np.uintp(i + REACH_PX)] = np.float32(down[i])
        for i in range(1, REACH_PX + 1):  # mirrored
            wide[REACH_PX - i] = wide[REACH_PX + i]
            wide[REACH_PX + width - 1 + i] = wide[REACH_PX + width - 1 - i]
        _add_columns(wide, weight, v, blurred)


@kernel_part
def _add_rows(image: np.ndarray, row: np.ndarray, weight: np.ndarray, down: np.ndarray) -> None:
    """Weighted sums (W,) over the rows."""
    a, b, c = np.uint16(weight[0]), np.uint16(weight[1]), np.uint16(weight[2])
    d, e, f = np.uint16(weight[3]), np.uint16(weight[4]), np.uint16(weight[5])
    r0, r1, r2, r3, r4, r5 = row[0], row[1], row[2], row[3], row[4], row[5]
    r6, r7, r8, r9, r10 = row[6], row[7], row[8], row[9], row[10]
    for i in range(image.shape[1]):
        u = np.uintp(i)
        total = a * (np.uint16(image[r0, u]) + np.uint16(image[r10, u]))
        total += b * (np.uint16(image[r1, u]) + np.uint16(image[r9, u]))
        total += c * (np.uint16(image[r2, u]) + np.uint16(image[r8, u]))
        total += d * (np.uint16(image[r3, u]) + np.uint16(image[r7, u]))
        total += e * (np.uint16(image[r4, u]) + np.uint16(image[r6, u]))
        down[u] = total + f * np.uint16(image[r5, u])


@kernel_part
def _add_columns(wide: np.ndarray, weight: np.ndarray, v: int, blurred: np.ndarray) -> None:
    """Weighted sums over columns of a row, rounded to whole grey levels."""
    a, b, c = np.float32(weight[0]), np.float32(weight[1]), np.float32(weight[2])
    d, e, f = np.float32(weight[3]), np.float32(weight[4]), np.float32(weight[5])
    for i in range(blurred.shape[1]):
        u = np.uintp(i)
        total = a * (wide[u] + wide[np.uintp(i + 10)])
        total += b * (wide[np.uintp(i + 1)] + wide[np.uintp(i + 9)])
        total += c * (wide[np.uintp(i + 2)] + wide[np.uintp(i + 8)])
        total += d * (wide[np.uintp(i + 3)] + wide[np.uintp(i + 7)])
        total += e * (wide[np.uintp(i + 4)] + wide[np.uintp(i + 6)])
        total += f * wide[np.uintp(i + 5)]
        blurred[v, u] = np.uint8((np.int32(total) + _HALF) >> _BITS)
