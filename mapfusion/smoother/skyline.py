"""Cholesky factor of a matrix that is mostly zero, its rows ordered so that it stays so.

Poses that saw no landmark in common have a zero between them. In an order in which those that did
are near each other, what is not zero lies near the diagonal, and a factor has no more than zeros
before the first entry of each row (the envelope: George and Liu 1981, "Computer Solution of Large
Sparse Positive Definite Systems", ch. 4). Such orders are that of Cuthill and McKee (1969), those of
searches like theirs that begin at other poses, spread over the log, and what comes of them when each
pose is drawn to the mean of those that it has to do with; while nothing was seen again that of time
is as good. Matrices stay dense, the work is done by blocks.

With a matrix functions take `first` (n,), the column of each row's first entry, or one before it.
"""

import mmap
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, reverse_cuthill_mckee

from mapfusion.se2 import Float

# Rows and columns that are taken at once: enough for products of matrices to be at their speed, few
# enough to follow the envelope.
_BLOCK = 48
# Members that an order is sought from, and sweeps over the best of those: more make it better by a
# tenth, and a factor with half the entries is worth some dozen milliseconds of search.
_BEGINS, _SWEEPS = 16, 4
# Bytes of a matrix whose memory the C library keeps for the next one, all of whose pages are there.
_ALL_AT_ONCE = 2**25
# LAPACK's own, without what SciPy looks at first: blocks are many and small.
_cholesky, _inverted = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)


def envelope_order(group: np.ndarray, member: np.ndarray, n_members: int) -> np.ndarray:
    """(n_members,) place of each in an order that has those of one group near each other.

    Args:
        group: (N,) numbers of groups; each of its members has to do with all others of it.
        member: (N,) who is in it.
        n_members: neighbours by number have to do with each other, too.
    """
    by_number = np.arange(n_members)
    if n_members < 2:
        return by_number
    related = _related(group, member, n_members)
    starts, column = related.indptr[:-1], related.indices.astype(np.int64)

    def work(place: np.ndarray) -> int:
        """What a factor costs: the squares of its rows' lengths."""
        return int(np.sum((place - np.minimum.reduceat(place[column], starts)) ** 2))

    begins = np.unique(np.linspace(0, n_members - 1, _BEGINS).round().astype(np.int64))
    found = [breadth_first_order(related, each, return_predecessors=False)[::-1] for each in begins]
    found.append(reverse_cuthill_mckee(related, symmetric_mode=True))
    swept = min(map(_places, found), key=work)
    orders = [by_number, swept]
    for _ in range(_SWEEPS):
        mean = related @ swept / np.diff(related.indptr)
        swept = _places(np.argsort(mean, kind="stable"))
        orders += [swept, n_members - 1 - swept]
    return min(orders, key=work)


def _related(group: np.ndarray, member: np.ndarray, n_members: int) -> csr_matrix:
    """(n_members, n_members) ones where two have to do with each other, each with itself."""
    chain = np.arange(n_members - 1)
    n_groups = int(group.max(initial=-1)) + 1
    groups = np.concatenate([group, n_groups + chain, n_groups + chain])
    members = np.concatenate([member, chain, chain + 1])
    shape = (n_members, n_groups + len(chain))
    has = csr_matrix((np.ones(len(groups)), (members, groups)), shape=shape)
    related = (has @ has.T).tocsr()
    related.data[:] = 1.0
    return related


def _places(order: np.ndarray) -> np.ndarray:
    """(n,) place of each member in an order (n,) of all members."""
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return place


def untouched_zeros(n: int) -> Float:
    """(n, n) zeros; of a large matrix memory holds the pages alone that something is written to.

    Those of `numpy.zeros` come in huge pages, or are written to once more: of a matrix with few
    entries in each row, all of it. That is faster where there is room for it.
    """
    size = n * n * np.dtype(np.float64).itemsize
    if size <= _ALL_AT_ONCE:
        return np.zeros((n, n))
    return np.frombuffer(mmap.mmap(-1, size), np.float64).reshape(n, n)


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


@dataclass(frozen=True)
class Factor:
    """The lower Cholesky factor L of a matrix (n, n).

    Attributes:
        lower: (n, n) L; what lies above the diagonal blocks means nothing.
        first: (n,) of the matrix.
        inverses: of the blocks of L on the diagonal.
    """

    lower: Float
    first: np.ndarray
    inverses: tuple[Float, ...]

    def __len__(self) -> int:
        return len(self.lower)

    def solve(self, right: Float) -> Float:
        """L^-1 right (n,) or (n, m)."""
        x = right.copy()
        for rows, start, inverse in zip(*_envelope(self.first), self.inverses, strict=True):
            done = slice(start * _BLOCK, rows.start)
            x[rows] = inverse @ (x[rows] - self.lower[rows, done] @ x[done])
        return x

    def solve_transposed(self, right: Float) -> Float:
        """L'^-1 right (n,) or (n, m)."""
        x = right.copy()
        parts = zip(*_envelope(self.first), self.inverses, strict=True)
        for rows, start, inverse in reversed(list(parts)):
            x[rows] = inverse.T @ x[rows]
            before = slice(start * _BLOCK, rows.start)
            x[before] -= self.lower[rows, before].T @ x[rows]
        return x

    def solve_both_roughly(self, right: Float) -> Float:
        """(L L')^-1 right (n,), in single precision: half as much to be read from memory."""
        x = right.astype(np.float32)
        for rows, before, L, inverse in self._single:
            x[rows] = inverse @ (x[rows] - L @ x[before])
        for rows, before, L, inverse in reversed(self._single):
            x[rows] = inverse.T @ x[rows]
            x[before] -= L.T @ x[rows]
        return x.astype(np.float64)

    @cached_property
    def _single(self) -> list[tuple[slice, slice, np.ndarray, np.ndarray]]:
        """Of each block of rows the columns before it, L there, and the inverse of its own."""
        found = []
        for rows, start, inverse in zip(*_envelope(self.first), self.inverses, strict=True):
            before = slice(start * _BLOCK, rows.start)
            L = self.lower[rows, before].astype(np.float32)
            found.append((rows, before, L, inverse.astype(np.float32)))
        return found

    def inverse(self) -> Float:
        """(n, n) the inverse of L L' where L has its envelope, or its mirror image.

        From the last block of columns on (Takahashi et al. 1973); elsewhere it is anything.
        """
        blocks, starts = _envelope(self.first)
        Z = untouched_zeros(len(self))
        for j, (columns, inverse) in reversed(
            list(enumerate(zip(blocks, self.inverses, strict=True)))
        ):
            own, runs = inverse.T @ inverse, _runs(blocks, starts, j)
            follows = [self.lower[rows, columns] @ inverse for rows in runs]
            for rows, its in zip(runs, follows, strict=True):
                with_it = Z[rows, runs[0]] @ follows[0]
                for other, that in zip(runs[1:], follows[1:], strict=True):
                    with_it += Z[rows, other] @ that
                Z[rows, columns] = np.negative(with_it, out=with_it)
                Z[columns, rows] = with_it.T
                own -= its.T @ with_it
            Z[columns, columns] = own
        return Z


def factor_in_envelope(A: Float, first: np.ndarray) -> Factor:
    """The Cholesky factor of A (n, n), in its place; of A the lower half is read.

    Raises:
        LinAlgError: A is not positive definite.
    """
    blocks, starts = _envelope(first)
    inverses = list[Float]()
    for j, columns in enumerate(blocks):
        for i, rows in enumerate(blocks[j:], start=j):
            if starts[i] > j:
                continue
            done = slice(max(starts[i], starts[j]) * _BLOCK, columns.start)
            left = A[rows, columns]
            if done.start < done.stop:
                left = left - A[rows, done] @ A[columns, done].T
            if i == j:
                A[rows, columns], failed = _cholesky(left, lower=1)
                if failed:
                    raise np.linalg.LinAlgError("the matrix is not positive definite")
                # many products with it are faster than as many times solving
                inverses.append(_inverted(A[rows, columns], lower=1)[0])
            else:
                A[rows, columns] = left @ inverses[j].T
    return Factor(A, first, tuple(inverses))


def multiply_in_envelope(A: Float, first: np.ndarray, right: Float) -> Float:
    """A right (n, m) of a symmetric A (n, n), of which the lower half is read."""
    product = np.zeros_like(right)
    for rows, start in zip(*_envelope(first), strict=True):
        before = slice(start * _BLOCK, rows.start)
        product[rows] += A[rows, before] @ right[before]
        product[before] += A[rows, before].T @ right[rows]
        lower = np.tril(A[rows, rows])
        product[rows] += (lower + np.tril(lower, -1).T) @ right[rows]
    return product


def _runs(blocks: list[slice], starts: list[int], j: int) -> list[slice]:
    """The rows below block j of columns that reach it; those of neighbouring blocks are one."""
    runs = list[slice]()
    for rows, start in zip(blocks[j + 1 :], starts[j + 1 :], strict=True):
        if start > j:
            continue
        if runs and runs[-1].stop == rows.start:
            runs[-1] = slice(runs[-1].start, rows.stop)
        else:
            runs.append(rows)
    return runs


def _envelope(first: np.ndarray) -> tuple[list[slice], list[int]]:
    """The blocks of rows, and the block of columns in which the first entry of each lies."""
    blocks = _blocks(len(first))
    return blocks, [int(first[rows].min()) // _BLOCK for rows in blocks]


def _blocks(n: int) -> list[slice]:
    return [slice(begin, min(begin + _BLOCK, n)) for begin in range(0, n, _BLOCK)]
