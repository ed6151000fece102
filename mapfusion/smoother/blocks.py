"""Blocks of three by three in kernels."""

import numpy as np

from mapfusion.kernels import kernel
from mapfusion.se2 import Float


# Of tables of blocks they take all and a row: views of rows are counted, which takes longer than
# the sums.
@kernel
def put_along(A: Float, row: int, x: Float, product: Float) -> None:
    """A[row] x."""
    for r in range(3):
        product[r] = A[row, r, 0] * x[0] + A[row, r, 1] * x[1] + A[row, r, 2] * x[2]


@kernel
def add_along(A: Float, row: int, x: Float, total: Float) -> None:
    """Add A[row] x."""
    for r in range(3):
        total[r] += A[row, r, 0] * x[0] + A[row, r, 1] * x[1] + A[row, r, 2] * x[2]


@kernel
def put_inverse(A: Float, inverse: Float) -> bool:
    """Inverse of a symmetric positive definite A = L D L', of which the lower half is read.

    Returns:
        False when A is not positive definite.
    """
    d0 = A[0, 0]
    if not d0 > 0:
        return False
    l10, l20 = A[1, 0] / d0, A[2, 0] / d0
    d1 = A[1, 1] - l10 * A[1, 0]
    if not d1 > 0:
        return False
    rest = A[2, 1] - l20 * A[1, 0]
    l21 = rest / d1
    d2 = A[2, 2] - l20 * A[2, 0] - l21 * rest
    if not d2 > 0:
        return False
    m20 = l10 * l21 - l20  # of L^-1, whose other entries are -l10 and -l21
    inverse[2, 2] = 1 / d2
    inverse[1, 2] = inverse[2, 1] = -l21 / d2
    inverse[0, 2] = inverse[2, 0] = m20 / d2
    inverse[1, 1] = 1 / d1 + l21 * l21 / d2
    inverse[0, 1] = inverse[1, 0] = -l10 / d1 - m20 * l21 / d2
    inverse[0, 0] = 1 / d0 + l10 * l10 / d1 + m20 * m20 / d2
    return True


def inverses(blocks: Float) -> Float:
    """(N, D, D) inverses of symmetric positive definite blocks (N, D, D), D two or three.

    Raises:
        LinAlgError: one is not positive definite.
    """
    found = np.empty(blocks.shape)
    if not _put_inverses(np.ascontiguousarray(blocks), found):
        raise np.linalg.LinAlgError("a block is not positive definite")
    return found


@kernel
def _put_inverses(blocks: Float, inverses: Float) -> bool:
    n, d = blocks.shape[0], blocks.shape[1]
    block, inverse = np.eye(3), np.empty((3, 3))
    for i in range(n):
        for r in range(d):
            for q in range(d):
                block[r, q] = blocks[i, r, q]
        if not put_inverse(block, inverse):
            return False
        for r in range(d):
            for q in range(d):
                inverses[i, r, q] = inverse[r, q]
    return True
