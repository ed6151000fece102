"""Sparse Cholesky factorisation in skyline storage, and an ordering that keeps the factor sparse.

The matrix has zero blocks for poses without a common landmark. A good order has all other blocks
near the diagonal. The Cholesky factor has only zeros before the first entry of each row (the
envelope: George and Liu 1981, "Computer Solution of Large Sparse Positive Definite Systems", ch.
4). Candidates are the order of Cuthill and McKee (1969), breadth-first searches from other poses,
sweeps that move each pose to the mean place of its neighbours, and the order of time.

Rows are stored by blocks, from the first entry of the block to its diagonal block. The
factorisation consists of dense matrix products of blocks.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from mapfusion.geometry.numerics import Float

# Number of breadth-first searches, and of sweeps over the best order.
_SEARCHES, _SWEEPS = 16, 4


def envelope_order(group: np.ndarray, member: np.ndarray, n_members: int) -> np.ndarray:
    """Return the place of each member in an order with related members close together.

    Args:
        group: group numbers, shape (N,); the members of a group are related.
        member: the member in each of these groups, shape (N,).
        n_members: number of members; successive members are related, too.
    """
    by_number = np.arange(n_members)
    if n_members < 2:
        return by_number
    # matrix of ones for related members
    chain = np.arange(n_members - 1)
    n_groups = int(group.max(initial=-1)) + 1
    groups = np.concatenate([group, n_groups + chain, n_groups + chain])
    members = np.concatenate([member, chain, chain + 1])
    shape = (n_members, n_groups + len(chain))
    incidence = scipy.sparse.csr_matrix((np.ones(len(groups)), (members, groups)), shape=shape)
    related = (incidence @ incidence.T).tocsr()
    related.data[:] = 1.0
    starts, column = related.indptr[:-1], related.indices.astype(np.int64)

    def cost(position: np.ndarray) -> int:
        """Return the cost of a factor: the sum of squared row lengths."""
        return int(np.sum((position - np.minimum.reduceat(position[column], starts)) ** 2))

    begins = np.unique(np.linspace(0, n_members - 1, _SEARCHES).round().astype(np.int64))
    candidate_orders = [
        scipy.sparse.csgraph.breadth_first_order(related, each, return_predecessors=False)[::-1]
        for each in begins
    ]
    candidate_orders.append(
        scipy.sparse.csgraph.reverse_cuthill_mckee(related, symmetric_mode=True)
    )
    swept = min(map(_places, candidate_orders), key=cost)
    orders = [by_number, swept]
    for _ in range(_SWEEPS):
        mean = related @ swept / np.diff(related.indptr)
        swept = _places(np.argsort(mean, kind="stable"))
        orders += [swept, n_members - 1 - swept]
    return min(orders, key=cost)


def _places(order: np.ndarray) -> np.ndarray:
    """Return the place (n,) of each member in an order (n,) of all members."""
    position = np.empty(len(order), dtype=np.int64)
    position[order] = np.arange(len(order))
    return position


def first_entries(group: np.ndarray, member: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the first related place of each place, shape (n,); its own if there is none before.

    Args:
        group: group numbers, as in `envelope_order`.
        member: members of these groups, as in `envelope_order`.
        position: result of `envelope_order`, shape (n,).
    """
    n, at = len(position), position[member]
    first, first_of_group = np.arange(n), np.full(int(group.max(initial=-1)) + 1, n)
    np.minimum.at(first_of_group, group, at)
    np.minimum.at(first, at, first_of_group[group])
    np.minimum.at(
        first, np.maximum(position[1:], position[:-1]), np.minimum(position[1:], position[:-1])
    )
    return first


# Size of a block: large enough for fast matrix products, small enough to follow the envelope.
_BLOCK = 48


@dataclass(frozen=True)
class Envelope:
    """Storage of the lower half of a matrix (n, n).

    Attributes:
        first: column of each row's first entry, or an earlier one, shape (n,).
    """

    first: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @cached_property
    def blocks(self) -> list[slice]:
        """Blocks of rows and of columns."""
        n = len(self)
        return [slice(begin, min(begin + _BLOCK, n)) for begin in range(0, n, _BLOCK)]

    @cached_property
    def starts(self) -> list[int]:
        """Block of columns of the first entry of each block of rows."""
        return [int(self.first[rows].min()) // _BLOCK for rows in self.blocks]

    @cached_property
    def below(self) -> list[list[int]]:
        """Blocks of rows below the diagonal with entries in each block of columns."""
        n = len(self.blocks)
        return [[i for i in range(j + 1, n) if self.starts[i] <= j] for j in range(n)]

    @cached_property
    def offset(self) -> np.ndarray:
        """Offsets, shape (n + 1,): row r and column c are stored at offset[r] + c.

        offset[n] is the number of entries. Diagonal blocks are stored in full.
        """
        first_column = np.repeat(np.array(self.starts, np.int64) * _BLOCK, self._sizes)
        end = np.repeat(np.array([rows.stop for rows in self.blocks], np.int64), self._sizes)
        stored = np.concatenate([[0], np.cumsum(end - first_column)])
        return stored - np.append(first_column, 0)

    @cached_property
    def _sizes(self) -> np.ndarray:
        return np.array([rows.stop - rows.start for rows in self.blocks], np.int64)

    def zeros(self) -> Float:
        """Return zero entries, shape (E,)."""
        return np.zeros(self.offset[-1])

    def of(self, A: Float) -> Float:
        """Return the entries (E,) of a matrix (n, n); only its lower half is read."""
        entries = self.zeros()
        for rows, start, panel in self.panels(entries):
            panel[:] = A[rows, start : rows.stop]
        return entries

    def panels(self, entries: Float) -> list[tuple[slice, int, Float]]:
        """Return each block of rows with its first stored column and its entries."""
        panels = []
        for rows, start in zip(self.blocks, self.starts, strict=True):
            first, height = start * _BLOCK, rows.stop - rows.start
            panel_start = self.offset[rows.start] + first
            stored = entries[panel_start : panel_start + height * (rows.stop - first)]
            panels.append((rows, first, stored.reshape(height, -1)))
        return panels

    def where(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the indices of the entries of 3 by 3 blocks, shape (m, 3, 3).

        `rows` and `columns` (m,) are block numbers with column <= row.
        """
        each = np.arange(3)
        by_row = self.offset[3 * rows[:, None] + each]
        return by_row[:, :, None] + (3 * columns[:, None] + each)[:, None, :]

    def between(self, entries: Float, rows: np.ndarray, columns: np.ndarray) -> Float:
        """Return blocks (m, 3, 3) of a symmetric matrix by their block numbers (m,)."""
        blocks = entries[self.where(np.maximum(rows, columns), np.minimum(rows, columns))]
        return np.where((rows < columns)[:, None, None], np.swapaxes(blocks, 1, 2), blocks)


class _Part(NamedTuple):
    """Block of rows of L: columns before it, L there, and the inverse of the diagonal block."""

    rows: slice
    before: slice
    lower: np.ndarray
    inverse: np.ndarray


@dataclass(frozen=True)
class Factor:
    """Lower Cholesky factor L of a matrix (n, n).

    Attributes:
        envelope: envelope of the matrix.
        lower: entries of L; entries above the diagonal are undefined.
        inverses: inverses of the diagonal blocks of L.
    """

    envelope: Envelope
    lower: Float
    inverses: tuple[Float, ...]

    def __len__(self) -> int:
        return len(self.envelope)

    def dense(self) -> Float:
        """Return L, shape (n, n)."""
        dense = np.zeros((len(self), len(self)))
        for rows, first, L in self.envelope.panels(self.lower):
            dense[rows, first : rows.stop] = L
        return np.tril(dense)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return L^-1 right, where `right` is (n,) or (n, m), in the precision of `right`."""
        x = right.copy()
        for rows, before, L, inverse in self._parts(right):
            x[rows] = inverse @ (x[rows] - L @ x[before])
        return x

    def solve_transposed(self, right: np.ndarray) -> np.ndarray:
        """Return L'^-1 right, where `right` is (n,) or (n, m), in the precision of `right`."""
        x = right.copy()
        for rows, before, L, inverse in reversed(self._parts(right)):
            x[rows] = inverse.T @ x[rows]
            x[before] -= L.T @ x[rows]
        return x

    def _parts(self, right: np.ndarray) -> list[_Part]:
        """Return the blocks of rows in the precision of `right`."""
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
        """Entries of the inverse of L L' in the envelope; diagonal blocks are symmetric.

        Computed from the last block of columns to the first (Takahashi et al. 1973).
        """
        columns_of_inverse = np.empty_like(self.lower)
        lower, panels = self.envelope.panels(self.lower), self.envelope.panels(columns_of_inverse)
        for j, below in reversed(list(enumerate(self.envelope.below))):
            (columns, first, _), inverse = lower[j], self.inverses[j]
            block = inverse.T @ inverse
            if below:
                # rows after this block; zero for rows without entries in these columns
                follows = np.zeros((lower[below[-1]][0].stop - columns.stop, len(inverse)))
                with_it = np.zeros_like(follows)
                for i in below:
                    at, L = _of_columns(lower[i], columns)
                    np.matmul(L, inverse, out=follows[at])
                for i in below:
                    rows, start, Z = panels[i]
                    at, right = _after(rows, columns), Z[:, columns.stop - start :]
                    with_it[at] += right @ follows[: at.stop]
                    with_it[: at.start] += right[:, : at.start].T @ follows[at]
                for i in below:
                    at, Z = _of_columns(panels[i], columns)
                    np.negative(with_it[at], out=Z)
                block += follows.T @ with_it
            panels[j][2][:, columns.start - first :] = block
        return columns_of_inverse


def _of_columns(panel: tuple[slice, int, Float], columns: slice) -> tuple[slice, Float]:
    """Return the rows of a panel relative to the end of a block of columns, and their entries."""
    rows, first, entries = panel
    return _after(rows, columns), entries[:, columns.start - first : columns.stop - first]


def _after(rows: slice, columns: slice) -> slice:
    return slice(rows.start - columns.stop, rows.stop - columns.stop)


def factor_in_envelope(entries: Float, envelope: Envelope) -> Factor:
    """Factor a matrix in place.

    Args:
        entries: entries of the matrix, which are overwritten.
        envelope: their envelope.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """
    panels, inverses = envelope.panels(entries), list[Float]()
    for j, below in enumerate(envelope.below):
        columns, first_too, others = panels[j]
        for i in (j, *below):
            _, first, panel = panels[i]
            done = max(first, first_too)
            left = panel[:, columns.start - first : columns.stop - first]
            if done < columns.start:
                done_columns = panel[:, done - first : columns.start - first]
                product = done_columns @ others[:, done - first_too : columns.start - first_too].T
                left -= product
            if i == j:
                # LAPACK without SciPy's checks: blocks are many and small
                left[:], failed = scipy.linalg.lapack.dpotrf(left, lower=1)
                if failed:
                    raise np.linalg.LinAlgError("the matrix is not positive definite")
                # products with the inverse are faster than triangular solutions
                inverses.append(scipy.linalg.lapack.dtrtri(left, lower=1)[0])
            else:
                left[:] = left @ inverses[j].T
    return Factor(envelope, entries, tuple(inverses))
