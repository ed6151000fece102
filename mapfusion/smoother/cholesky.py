"""Sparse Cholesky factorisation in skyline storage, and an ordering that keeps it sparse.

Poses that saw no landmark in common have a zero between them. In such an order what is not zero
lies near the diagonal, and a factor has no more than zeros before the first entry of each row (the
envelope: George and Liu 1981, "Computer Solution of Large Sparse Positive Definite Systems", ch.
4). Orders are that of Cuthill and McKee (1969), those of searches like theirs that begin at other
poses, spread over the log, and what comes of them when each pose is drawn to the mean of those that
it has to do with; while nothing was seen again that of time is as good.

A factor has no more than zeros before the first entry of each row (the envelope, see
`envelope_order.py`). Rows are stored by blocks, each from the first entry of its rows on to its
diagonal block, and the work is done by products of parts of them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, reverse_cuthill_mckee

from mapfusion.geometry.numerics import Float

# Members that an order is sought from, and sweeps over the best of those: more make it better by a
# tenth, and a factor with half the entries is worth some dozen milliseconds of search.
_BEGINS, _SWEEPS = 16, 4


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


# Rows and columns that are taken at once: enough for products of matrices to be at their speed, few
# enough to follow the envelope.
_BLOCK = 48
# LAPACK's own, without what SciPy looks at first: blocks are many and small.
_cholesky, _inverted = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)


@dataclass(frozen=True)
class Envelope:
    """Where the entries of the lower half of a matrix (n, n) are stored.

    Attributes:
        first: (n,) the column of each row's first entry, or one before it.
    """

    first: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @cached_property
    def blocks(self) -> list[slice]:
        """The blocks of rows, and of columns."""
        n = len(self)
        return [slice(begin, min(begin + _BLOCK, n)) for begin in range(0, n, _BLOCK)]

    @cached_property
    def starts(self) -> list[int]:
        """Of each block of rows the block of columns in which their first entry lies."""
        return [int(self.first[rows].min()) // _BLOCK for rows in self.blocks]

    @cached_property
    def below(self) -> list[list[int]]:
        """Of each block of columns the blocks of rows below the diagonal that reach it."""
        n = len(self.blocks)
        return [[i for i in range(j + 1, n) if self.starts[i] <= j] for j in range(n)]

    @cached_property
    def offset(self) -> np.ndarray:
        """(n + 1,) the entry in row r and column c is stored at offset[r] + c; of n, their number.

        Those of a block on the diagonal are stored all.
        """
        first_column = np.repeat(np.array(self.starts, np.int64) * _BLOCK, self._sizes)
        end = np.repeat(np.array([rows.stop for rows in self.blocks], np.int64), self._sizes)
        stored = np.concatenate([[0], np.cumsum(end - first_column)])
        return stored - np.append(first_column, 0)

    @cached_property
    def _sizes(self) -> np.ndarray:
        return np.array([rows.stop - rows.start for rows in self.blocks], np.int64)

    def zeros(self) -> Float:
        """Entries (E,) as they are stored, all zero."""
        return np.zeros(self.offset[-1])

    def of(self, A: Float) -> Float:
        """The entries (E,) of a matrix (n, n) in the envelope, of which the lower half is read."""
        entries = self.zeros()
        for rows, start, panel in self.panels(entries):
            panel[:] = A[rows, start : rows.stop]
        return entries

    def panels(self, entries: Float) -> list[tuple[slice, int, Float]]:
        """Each block of rows, the first column stored of it, and its entries from there on."""
        found = []
        for rows, start in zip(self.blocks, self.starts, strict=True):
            first, height = start * _BLOCK, rows.stop - rows.start
            begin = self.offset[rows.start] + first
            stored = entries[begin : begin + height * (rows.stop - first)]
            found.append((rows, first, stored.reshape(height, -1)))
        return found

    def where(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """(m, 3, 3) where blocks of three by three are stored, by their numbers (m,).

        No column's number is above the row's.
        """
        each = np.arange(3)
        by_row = self.offset[3 * rows[:, None] + each]
        return by_row[:, :, None] + (3 * columns[:, None] + each)[:, None, :]

    def between(self, entries: Float, rows: np.ndarray, columns: np.ndarray) -> Float:
        """(m, 3, 3) blocks of three by three of a symmetric matrix, by their numbers (m,)."""
        found = entries[self.where(np.maximum(rows, columns), np.minimum(rows, columns))]
        return np.where((rows < columns)[:, None, None], np.swapaxes(found, 1, 2), found)


class _Part(NamedTuple):
    """Of a block of rows of L the columns before it, L there, and the inverse of its own block."""

    rows: slice
    before: slice
    lower: np.ndarray
    inverse: np.ndarray


@dataclass(frozen=True)
class Factor:
    """The lower Cholesky factor L of a matrix (n, n).

    Attributes:
        envelope: of the matrix.
        lower: entries of L; what lies above the diagonal means nothing.
        inverses: of the blocks of L on the diagonal.
    """

    envelope: Envelope
    lower: Float
    inverses: tuple[Float, ...]

    def __len__(self) -> int:
        return len(self.envelope)

    def dense(self) -> Float:
        """(n, n) L."""
        found = np.zeros((len(self), len(self)))
        for rows, first, L in self.envelope.panels(self.lower):
            found[rows, first : rows.stop] = L
        return np.tril(found)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """L^-1 right (n,) or (n, m), in the precision of `right`."""
        x = right.copy()
        for rows, before, L, inverse in self._parts(right):
            x[rows] = inverse @ (x[rows] - L @ x[before])
        return x

    def solve_transposed(self, right: np.ndarray) -> np.ndarray:
        """L'^-1 right (n,) or (n, m), in the precision of `right`."""
        x = right.copy()
        for rows, before, L, inverse in reversed(self._parts(right)):
            x[rows] = inverse.T @ x[rows]
            x[before] -= L.T @ x[rows]
        return x

    def solve_both_roughly(self, right: Float) -> Float:
        """(L L')^-1 right (n,), in single precision: half as much to be read from memory."""
        found = self.solve_transposed(self.solve(right.astype(np.float32)))
        return found.astype(np.float64)

    def _parts(self, right: np.ndarray) -> list[_Part]:
        """In the precision of `right`."""
        return self._single if right.dtype == np.float32 else self._double

    @cached_property
    def _double(self) -> list[_Part]:
        panels = self.envelope.panels(self.lower)
        return [
            _Part(rows, slice(first, rows.start), L[:, : rows.start - first], inverse)
            for (rows, first, L), inverse in zip(panels, self.inverses, strict=True)
        ]

    @cached_property
    def _single(self) -> list[_Part]:
        single = np.float32
        return [
            _Part(rows, before, L.astype(single), inverse.astype(single))
            for rows, before, L, inverse in self._double
        ]

    @cached_property
    def inverse(self) -> Float:
        """Entries of the inverse of L L'; those of the blocks on the diagonal are symmetric.

        From the last block of columns on (Takahashi et al. 1973).
        """
        found = np.empty_like(self.lower)
        lower, panels = self.envelope.panels(self.lower), self.envelope.panels(found)
        for j, below in reversed(list(enumerate(self.envelope.below))):
            (columns, first, _), inverse = lower[j], self.inverses[j]
            own = inverse.T @ inverse
            if below:
                # of the rows from the next block on; zero where they do not reach these columns
                follows = np.zeros((lower[below[-1]][0].stop - columns.stop, len(inverse)))
                with_it = np.zeros_like(follows)
                for i in below:
                    at, L = _of_columns(lower[i], columns)
                    np.matmul(L, inverse, out=follows[at])
                for i in below:
                    rows, begin, Z = panels[i]
                    at, right = _after(rows, columns), Z[:, columns.stop - begin :]
                    with_it[at] += right @ follows[: at.stop]
                    with_it[: at.start] += right[:, : at.start].T @ follows[at]
                for i in below:
                    at, Z = _of_columns(panels[i], columns)
                    np.negative(with_it[at], out=Z)
                own += follows.T @ with_it
            panels[j][2][:, columns.start - first :] = own
        return found


def _of_columns(panel: tuple[slice, int, Float], columns: slice) -> tuple[slice, Float]:
    """Where the rows of a panel lie after a block of columns, and their entries in it."""
    rows, first, entries = panel
    return _after(rows, columns), entries[:, columns.start - first : columns.stop - first]


def _after(rows: slice, columns: slice) -> slice:
    return slice(rows.start - columns.stop, rows.stop - columns.stop)


def factor_in_envelope(entries: Float, envelope: Envelope) -> Factor:
    """The Cholesky factor of a matrix by its entries, in their place.

    Raises:
        LinAlgError: it is not positive definite.
    """
    panels, inverses = envelope.panels(entries), list[Float]()
    for j, below in enumerate(envelope.below):
        columns, first_too, others = panels[j]
        for i in (j, *below):
            _, first, own = panels[i]
            done, left = max(first, first_too), own[:, columns.start - first : columns.stop - first]
            if done < columns.start:
                before = own[:, done - first : columns.start - first]
                product = before @ others[:, done - first_too : columns.start - first_too].T
                left -= product
            if i == j:
                left[:], failed = _cholesky(left, lower=1)
                if failed:
                    raise np.linalg.LinAlgError("the matrix is not positive definite")
                # many products with it are faster than as many times solving
                inverses.append(_inverted(left, lower=1)[0])
            else:
                left[:] = left @ inverses[j].T
    return Factor(envelope, entries, tuple(inverses))
