"""Cholesky factor of a matrix that is mostly zero, its rows ordered so that it stays so.

Poses that saw no landmark in common have a zero between them. In the order of reverse Cuthill and
McKee (1969) what is not zero lies near the diagonal, and a factor has no more than zeros before the
first entry of each row (the envelope: George and Liu 1981, "Computer Solution of Large Sparse
Positive Definite Systems", ch. 4). Matrices stay dense in memory, the work is done by blocks.
"""

import numpy as np
import scipy.linalg
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from mapfusion.se2 import Float

# Rows and columns that are taken at once: enough for LAPACK to be at its speed, few enough to
# follow the envelope.
_BLOCK = 96


def envelope_order(group: np.ndarray, member: np.ndarray, n_members: int) -> np.ndarray:
    """(n_members,) place of each in an order that has those of one group near each other.

    Args:
        group: (N,) numbers of groups; each of its members has to do with all others of it.
        member: (N,) who is in it.
        n_members: neighbours by number have to do with each other, too.
    """
    if n_members < 2:
        return np.arange(n_members)
    chain = np.arange(n_members - 1)
    n_groups = int(group.max(initial=-1)) + 1
    group = np.concatenate([group, n_groups + chain, n_groups + chain])
    member = np.concatenate([member, chain, chain + 1])
    shape = (n_members, n_groups + len(chain))
    has = csr_matrix((np.ones(len(group), np.float32), (member, group)), shape=shape)
    order = reverse_cuthill_mckee((has @ has.T).tocsr(), symmetric_mode=True)
    place = np.empty(n_members, dtype=np.int64)
    place[order] = np.arange(n_members)
    return place


def cholesky_in_envelope(A: Float) -> Float:
    """The lower Cholesky factor of A (n, n), in its place; of A the lower half is read.

    What lies above the diagonal blocks stays as it is.

    Raises:
        LinAlgError: A is not positive definite.
    """
    blocks, starts = _envelope(A)
    for j, columns in enumerate(blocks):
        for i, rows in enumerate(blocks[j:], start=j):
            if starts[i] > j:
                continue
            done = slice(max(starts[i], starts[j]) * _BLOCK, columns.start)
            A[rows, columns] -= A[rows, done] @ A[columns, done].T
            own = A[columns, columns]
            if i == j:
                own[:] = scipy.linalg.cholesky(own, lower=True, check_finite=False)
            else:
                A[rows, columns] = _solved(own, A[rows, columns].T).T
    return A


def solve_in_envelope(L: Float, right: Float) -> Float:
    """L^-1 right (n,) or (n, m) of a lower factor (n, n)."""
    x = right.copy()
    for rows, start in zip(*_envelope(L), strict=True):
        done = slice(start * _BLOCK, rows.start)
        x[rows] = _solved(L[rows, rows], x[rows] - L[rows, done] @ x[done])
    return x


def solve_transposed_in_envelope(L: Float, right: Float) -> Float:
    """L'^-1 right (n,) or (n, m) of a lower factor (n, n)."""
    x = right.copy()
    for rows, start in reversed(list(zip(*_envelope(L), strict=True))):
        x[rows] = _solved(L[rows, rows], x[rows], transposed=True)
        before = slice(start * _BLOCK, rows.start)
        x[before] -= L[rows, before].T @ x[rows]
    return x


def _envelope(A: Float) -> tuple[list[slice], list[int]]:
    """The blocks of rows, and the block of columns in which the first entry of each lies."""
    n = len(A)
    blocks = [slice(begin, min(begin + _BLOCK, n)) for begin in range(0, n, _BLOCK)]
    return blocks, [int(np.argmax(A[rows].any(axis=0))) // _BLOCK for rows in blocks]


def _solved(L: Float, right: Float, transposed: bool = False) -> Float:
    trans = int(transposed)
    return scipy.linalg.solve_triangular(L, right, trans, lower=True, check_finite=False)
