"""A window of the left picture, and by what the right one differs under a plane of disparities.

The disparity of a plane is linear in the image: d(x, y) = d + a x + b y around the window's centre.

Between columns the right picture is the cubic of Catmull and Rom. Each loop does one thing: those
that only look up and those that only reckon run in the processor's vectors, one that does both does
not. And each goes over a whole window: handing over its arrays takes as long as a row takes.
"""

import numpy as np

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float

# Of a window's pixels, row by row (4, S * S) with S = 2 half + 1: grey levels of the left picture,
# their slopes along u and along v, and right - left under the plane.
LEVEL, SLOPE, DOWN, RESIDUAL = range(4)
FIELDS = 4
# On the way (2, S * S) uint32: column of the right picture before the one to the left of where a
# pixel is read, and the grey levels of four columns from there on, the bytes of one number.
_COLUMN, _LEVELS = range(2)
ROOM = 2
MOST_HALF_PX = 100  # half side of the largest window
# Sums of one product down the columns of a window have room for the widest, in whole vectors: so it
# is known how far those of two products lie apart when loops over them are compiled, and that these
# may run in the processor's vectors.
_AT_ONCE = 8
WIDE = np.uintp(-(-(2 * MOST_HALF_PX + 1) // _AT_ONCE) * _AT_ONCE)
_ONE = np.uintp(1)  # indices without a sign, which a kernel need not wrap around
_BYTE, _LOW = np.uint32(8), np.uint32(0xFF)


@kernel
def parts_inside(image: np.ndarray, u: int, v: int, half: int) -> tuple[int, int, int, int]:
    """First and last row and column, from (u, v), of a window's part with a column to spare."""
    height, width = image.shape
    return max(-half, -v), min(half, height - 1 - v), max(-half, 1 - u), min(half, width - 2 - u)


@kernel
def fill_left(left: np.ndarray, u: int, v: int, half: int, window: Float) -> None:
    """Fill in the left picture's grey levels around (u, v), and their slopes along u."""
    side = 2 * half + 1
    top, bottom, first, last = parts_inside(left, u, v, half)
    for y in range(top, bottom + 1):
        row, at = np.uintp(v + y), np.uintp((y + half) * side + half + first)
        before = np.uintp(u + first - 1)
        for i in range(last + 1 - first):
            k, m = before + np.uintp(i), at + np.uintp(i)
            slope = np.int32(left[row, k + _ONE + _ONE]) - np.int32(left[row, k])
            window[LEVEL, m], window[SLOPE, m] = left[row, k + _ONE], 0.5 * slope


@kernel_part
def fill_down(left: np.ndarray, u: int, v: int, half: int, window: Float) -> None:
    """Fill in the slopes along v; at the border that to the row inside."""
    side = 2 * half + 1
    top, bottom, first, last = parts_inside(left, u, v, half)
    for y in range(top, bottom + 1):
        above, below = np.uintp(max(v + y - 1, 0)), np.uintp(min(v + y + 1, len(left) - 1))
        share = 1 / float(below - above)
        begin, at = np.uintp(u + first), np.uintp((y + half) * side + half + first)
        for i in range(last + 1 - first):
            k = begin + np.uintp(i)
            down = np.int32(left[below, k]) - np.int32(left[above, k])
            window[DOWN, at + np.uintp(i)] = share * down


@kernel
def fill_residuals(
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    plane: Float,
    n: int,
    window: Float,
    room: np.ndarray,
    share: Float,
) -> None:
    """Fill in right - left, where `fill_left` has filled in.

    Args:
        right: (H, W) uint8.
        u: centre of the window in the left picture.
        v: likewise.
        half: side of the window.
        plane: (N, 3) of d, a, b.
        n: which of them.
        window: (FIELDS, S * S), its residuals are changed.
        room: (ROOM, S * S) uint32, on the way.
        share: (S * S,) likewise.
    """
    _find_columns(right, u, v, half, plane[n, 0], plane[n, 1], plane[n, 2], room, share)
    _look_up(right, u, v, half, room)
    _compare(window, room, share)


@kernel_part
def _find_columns(
    right: np.ndarray,
    u: int,
    v: int,
    half: int,
    d: float,
    a: float,
    b: float,
    room: np.ndarray,
    share: Float,
) -> None:
    """Where pixels are read; at the border what is beside the picture is left out by others."""
    highest, side = np.int32(right.shape[1] - 4), 2 * half + 1
    for y in range(-half, half + 1):
        start, at = u - d - b * y, np.uintp((y + half) * side)
        for i in range(side):
            x = float(i - half)
            place = start + x - a * x
            column = min(max(np.int32(place) - np.int32(1), np.int32(0)), highest)
            room[_COLUMN, at + np.uintp(i)] = column
            share[at + np.uintp(i)] = place - float(column + np.int32(1))


@kernel_part
def _look_up(right: np.ndarray, u: int, v: int, half: int, room: np.ndarray) -> None:
    side = 2 * half + 1
    for y in range(-half, half + 1):
        row, at = np.uintp(min(max(v + y, 0), len(right) - 1)), np.uintp((y + half) * side)
        for i in range(side):
            m = at + np.uintp(i)
            k = np.uintp(room[_COLUMN, m])
            levels = np.uint32(right[row, k])
            levels |= np.uint32(right[row, k + _ONE]) << _BYTE
            levels |= np.uint32(right[row, k + _ONE + _ONE]) << (_BYTE + _BYTE)
            levels |= np.uint32(right[row, k + _ONE + _ONE + _ONE]) << (_BYTE + _BYTE + _BYTE)
            room[_LEVELS, m] = levels


@kernel_part
def _compare(window: Float, room: np.ndarray, share: Float) -> None:
    for i in range(len(share)):
        levels, t = room[_LEVELS, i], share[i]
        a, b = float(levels & _LOW), float((levels >> _BYTE) & _LOW)
        c, d = float((levels >> (_BYTE + _BYTE)) & _LOW), float(levels >> (_BYTE + _BYTE + _BYTE))
        cubic = c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))
        window[RESIDUAL, i] = b + 0.5 * t * cubic - window[LEVEL, i]
