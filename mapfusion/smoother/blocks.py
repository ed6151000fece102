"""Blocks of three by three."""

from typing import Any

import numpy as np

from mapfusion.kernels import inner_kernel, source_of
from mapfusion.se2 import Float


# Of tables of blocks they take all and a row: views of rows are counted, which takes longer than
# the sums.
@inner_kernel
def put_along(A: Float, row: int, x: Float, product: Float) -> None:
    """A[row] x."""
    for r in range(3):
        product[r] = A[row, r, 0] * x[0] + A[row, r, 1] * x[1] + A[row, r, 2] * x[2]


@inner_kernel
def add_along(A: Float, row: int, x: Float, total: Float) -> None:
    """Add A[row] x."""
    for r in range(3):
        total[r] += A[row, r, 0] * x[0] + A[row, r, 1] * x[1] + A[row, r, 2] * x[2]


@inner_kernel
def put_inverse(A: Float, inverse: Float) -> bool:
    """Inverse of a symmetric positive definite A = L D L', of which the lower half is read.

    Returns:
        False when A is not positive definite.
    """
    positive, entries = _inverse_entries(A[0, 0], A[1, 0], A[1, 1], A[2, 0], A[2, 1], A[2, 2])
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = entries[0], entries[2], entries[5]
    inverse[0, 1] = inverse[1, 0] = entries[1]
    inverse[0, 2] = inverse[2, 0] = entries[3]
    inverse[1, 2] = inverse[2, 1] = entries[4]
    return positive


@inner_kernel(error_model="numpy")
def _inverse_entries(a00: Any, a10: Any, a11: Any, a20: Any, a21: Any, a22: Any) -> Any:
    """Whether A = L D L' is positive definite, and the lower half of its inverse, row by row.

    Of one matrix, or in NumPy of as many as there are in arrays of entries.
    """
    l10, l20 = a10 / a00, a20 / a00
    d1 = a11 - l10 * a10
    rest = a21 - l20 * a10
    l21 = rest / d1
    d2 = a22 - l20 * a20 - l21 * rest
    m20 = l10 * l21 - l20  # of L^-1, whose other entries are -l10 and -l21
    entries = (
        1 / a00 + l10 * l10 / d1 + m20 * m20 / d2,
        -l10 / d1 - m20 * l21 / d2,
        1 / d1 + l21 * l21 / d2,
        m20 / d2,
        -l21 / d2,
        1 / d2,
    )
    return (a00 > 0) & (d1 > 0) & (d2 > 0), entries


def inverses(blocks: Float) -> Float:
    """(N, D, D) inverses of symmetric positive definite blocks (N, D, D), D two or three.

    Raises:
        LinAlgError: one is not positive definite.
    """
    n, dimensions = blocks.shape[:2]
    entries = np.zeros((6, n))  # the lower half of each, of two dimensions with a third by itself
    entries[5] = 1.0
    pairs = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
    for k, (r, q) in enumerate(pairs):
        if r < dimensions:
            entries[k] = blocks[:, r, q]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        positive, inverse = source_of(_inverse_entries)(*entries)
    if not positive.all():
        raise np.linalg.LinAlgError("a block is not positive definite")
    found = np.empty(blocks.shape)
    for (r, q), entry in zip(pairs, inverse, strict=True):
        if r < dimensions:
            found[:, r, q] = found[:, q, r] = entry
    return found
