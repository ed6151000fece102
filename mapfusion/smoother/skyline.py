"""Cholesky factor of a matrix that is mostly zero, its rows ordered so that it stays so.

Poses that saw no landmark in common have a zero between them. In the order of reverse Cuthill and
McKee (1969) what is not zero lies near the diagonal, and a factor has no more than zeros before the
first entry of each row (the envelope: George and Liu 1981, "Computer Solution of Large Sparse
Positive Definite Systems", ch. 4). Matrices stay dense, the work is done by blocks.

With a matrix functions take `first` (n,), the column of each row's first entry, or one before it.
"""

import mmap

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf
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


def untouched_zeros(n: int) -> Float:
    """(n, n) zeros, of which memory holds the pages alone that something is written to.

    Those of `numpy.zeros` come in huge pages: of a matrix with few entries in each row, all of it.
    """
    room = mmap.mmap(-1, n * n * np.dtype(np.float64).itemsize)
    return np.frombuffer(room, np.float64).reshape(n, n)


def first_entries(group: np.ndarray, member: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(n,) by place: the first place that each has to do with, its own if there is none before it.

    Groups and members are those of `envelope_order`, `place` (n,) is what it gave.
    """
    n, at = len(place), place[member]
    first, least = np.arange(n), np.full(int(group.max(initial=-1)) + 1, n)
    np.minimum.at(least, group, at)
    np.minimum.at(first, at, least[group])
    np.minimum.at(first, np.maximum(place[1:], place[:-1]), np.minimum(place[1:], place[:-1]))
    return first


def entries_seen(L: Float) -> np.ndarray:
    """`first` (n,) of a factor L (n, n), or its last rows and columns, from what it holds.

    Slower than what one knows of the matrix, but some rows begin later than they might.
    """
    first = np.empty(len(L), np.int64)
    for rows in _blocks(len(L)):
        first[rows] = np.argmax(L[rows].any(axis=0))
    return first


def cholesky_in_envelope(A: Float, first: np.ndarray) -> Float:
    """The lower Cholesky factor of A (n, n), in its place; of A the lower half is read.

    What lies above the diagonal blocks stays as it is.

    Raises:
        LinAlgError: A is not positive definite.
    """
    blocks, starts = _envelope(first)
    for j, columns in enumerate(blocks):
        for i, rows in enumerate(blocks[j:], start=j):
            if starts[i] > j:
                continue
            done = slice(max(starts[i], starts[j]) * _BLOCK, columns.start)
            A[rows, columns] -= A[rows, done] @ A[columns, done].T
            if i == j:
                own, failed = dpotrf(A[columns, columns], lower=1)
                if failed:
                    raise np.linalg.LinAlgError("the matrix is not positive definite")
                A[columns, columns] = own
            else:  # what is transposed lies in memory as LAPACK wants it
                A[rows, columns] = dtrsm(1.0, own, A[rows, columns].T, lower=1).T
    return A


def solve_in_envelope(L: Float, first: np.ndarray, right: Float) -> Float:
    """L^-1 right (n,) or (n, m) of a lower factor (n, n)."""
    x = right.copy()
    for rows, start in zip(*_envelope(first), strict=True):
        done = slice(start * _BLOCK, rows.start)
        x[rows] = _solved(L[rows, rows], x[rows] - L[rows, done] @ x[done])
    return x


def solve_transposed_in_envelope(L: Float, first: np.ndarray, right: Float) -> Float:
    """L'^-1 right (n,) or (n, m) of a lower factor (n, n)."""
    x = right.copy()
    for rows, start in reversed(list(zip(*_envelope(first), strict=True))):
        x[rows] = _solved(L[rows, rows], x[rows], transposed=True)
        before = slice(start * _BLOCK, rows.start)
        x[before] -= L[rows, before].T @ x[rows]
    return x


def _envelope(first: np.ndarray) -> tuple[list[slice], list[int]]:
    """The blocks of rows, and the block of columns in which the first entry of each lies."""
    blocks = _blocks(len(first))
    return blocks, [int(first[rows].min()) // _BLOCK for rows in blocks]


def _blocks(n: int) -> list[slice]:
    return [slice(begin, min(begin + _BLOCK, n)) for begin in range(0, n, _BLOCK)]


def _solved(L: Float, right: Float, transposed: bool = False) -> Float:
    return dtrsm(1.0, L, right, lower=1, trans_a=int(transposed)).reshape(right.shape)
