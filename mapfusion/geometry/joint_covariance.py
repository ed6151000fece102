"""Joint covariance of a map's landmarks: block diagonal plus low rank.

What landmarks have in common, the drift of the path that saw them, has few directions that count.
So a landmark is its estimate plus an error of its own plus what a few shared, independent, standard
normal variables z do to all of them: x_i = m_i + C_i' z + e_i, with e_i of covariance `own_m2`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg

from mapfusion.geometry.numerics import Float
from mapfusion.parameters import require_finite, require_shape

# Of the shared variables that a log gives, three a frame, as many are kept: their variances fall
# fast, and what they leave goes to the landmarks' own part.
RANK = 100
# The subspace of the largest variances is found by iteration, with so many directions to spare; at
# each what is not wanted shrinks by the ratio of its variance to the wanted ones.
_TO_SPARE, _ITERATIONS = 20, 3
# Sine of a direction's angle to those before it, below which products of both tell nothing of it.
_DEPENDENT = 1e-6
# Of so many rows all products of Y Y' cost no more than those with some columns by way of Y' do in
# all iterations.
_FEW = 2 * _ITERATIONS * (RANK + _TO_SPARE)

(_cholesky,) = scipy.linalg.get_lapack_funcs(("potrf",), dtype=np.float64)


@dataclass(frozen=True)
class JointCovariance:
    """Of N landmarks and R shared variables.

    Attributes:
        own_m2: (N, 3, 3) of what is each landmark's own.
        common_m: (N, R, 3) C_i: how far one sigma of each shared variable moves the landmark.
    """

    own_m2: Float
    common_m: Float

    def __post_init__(self) -> None:
        n = len(self.own_m2)
        require_shape("own_m2", self.own_m2, (n, 3, 3))
        require_shape("common_m", self.common_m, (n, self.rank, 3))
        require_finite("own_m2", self.own_m2)
        require_finite("common_m", self.common_m)

    def __len__(self) -> int:
        return len(self.own_m2)

    def __getitem__(self, rows: np.ndarray | slice) -> "JointCovariance":
        return JointCovariance(self.own_m2[rows], self.common_m[rows])

    @property
    def rank(self) -> int:
        """R."""
        return self.common_m.shape[1]

    @property
    def marginal_m2(self) -> Float:
        """(N, 3, 3) covariance of each landmark for itself."""
        return self.own_m2 + _squares(self.common_m)

    def dense_m2(self) -> Float:
        """(3N, 3N), for small maps."""
        n, each = len(self), np.arange(len(self))
        stacked = self.common_m.transpose(1, 0, 2).reshape(self.rank, 3 * n)
        joint = stacked.T @ stacked
        joint.reshape(n, 3, n, 3)[each, :, each, :] += self.own_m2
        return joint


class SharedErrors(Protocol):
    """Y (R, 3N): what R independent, standard normal variables do to N landmarks."""

    def __len__(self) -> int:
        """R."""
        ...

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """(R, r) columns of Y Y', those of `rows` (r,)."""
        ...

    def gram(self, columns: Float) -> Float:
        """Y Y' times columns (R, c)."""
        ...

    def spread(self, columns: Float) -> Float:
        """(3N, c) Y' times columns (R, c)."""
        ...

    def gathered(self, by_landmark: Float) -> Float:
        """Return (R, c) Y times columns (3N, c)."""
        ...

    def squares(self) -> Float:
        """(N, 3, 3) blocks of Y' Y, each landmark's with itself."""
        ...


@dataclass(frozen=True)
class KnownErrors:
    """Y as it is."""

    common: Float

    def __len__(self) -> int:
        return len(self.common)

    @cached_property
    def _by_all(self) -> Float:
        """(R, R) Y Y'."""
        return self.common @ self.common.T

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """(R, r) columns of Y Y', those of `rows` (r,)."""
        if len(self) <= _FEW:
            return self._by_all[:, rows]
        return self.common @ np.ascontiguousarray(self.common[rows].T)

    def gram(self, columns: Float) -> Float:
        """Y Y' times columns (R, c)."""
        if len(self) <= _FEW:
            return self._by_all @ columns
        return self.common @ self.spread(columns)

    def spread(self, columns: Float) -> Float:
        """(3N, c) Y' times columns (R, c)."""
        return self.common.T @ columns

    def gathered(self, by_landmark: Float) -> Float:
        """Return (R, c) Y times columns (3N, c)."""
        return self.common @ by_landmark

    def squares(self) -> Float:
        """(N, 3, 3) blocks of Y' Y, each landmark's with itself."""
        return _squares(_by_landmark(self.common))


@dataclass(frozen=True)
class StackedErrors:
    """Y of the rows of one and, after them, of few known others, independent of the first."""

    first: SharedErrors
    known: KnownErrors

    def __len__(self) -> int:
        return len(self.first) + len(self.known)

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """(R, r) columns of Y Y', those of `rows` (r,)."""
        chosen = np.zeros((len(self), len(rows)))
        chosen[rows, np.arange(len(rows))] = 1.0
        return self.gram(chosen)

    def gram(self, columns: Float) -> Float:
        """Y Y' times columns (R, c)."""
        upper, lower = columns[: len(self.first)], columns[len(self.first) :]
        of_first = self.first.gram(upper) + self._between @ lower
        return np.concatenate([of_first, self._between.T @ upper + self.known.gram(lower)])

    def spread(self, columns: Float) -> Float:
        """(3N, c) Y' times columns (R, c)."""
        upper, lower = columns[: len(self.first)], columns[len(self.first) :]
        return self.first.spread(upper) + self.known.spread(lower)

    def gathered(self, by_landmark: Float) -> Float:
        """Return (R, c) Y times columns (3N, c)."""
        return np.concatenate([self.first.gathered(by_landmark), self.known.gathered(by_landmark)])

    def squares(self) -> Float:
        """(N, 3, 3) blocks of Y' Y, each landmark's with itself."""
        return self.first.squares() + self.known.squares()

    @cached_property
    def _between(self) -> Float:
        """Rows of the first times those that are known."""
        return self.first.gathered(self.known.common.T)


def reduce_rank(own_m2: Float, common: Float | SharedErrors, rank: int = RANK) -> JointCovariance:
    """A joint covariance of own (N, 3, 3) and common (R, 3N), by its largest `rank` directions.

    Marginal covariances stay as they are: what is left out is counted as the landmarks' own.
    Subspace iteration (Halko, Martinsson, Tropp 2011, alg. 4.4), from rows of `common`, which are
    of frames, evenly spread over the path.
    """
    if isinstance(common, np.ndarray):
        common = KnownErrors(common)
    if len(common) > rank:
        n_start = min(rank + _TO_SPARE, len(common))
        rows = np.linspace(0, len(common) - 1, n_start).round().astype(int)
        # onto single rows: common' times columns of the identity
        basis = _orthonormal(common.rows_by_all(np.unique(rows)))
        for _ in range(_ITERATIONS - 1):
            basis = _orthonormal(common.gram(basis))
        within = common.spread(basis).T
        largest = np.linalg.eigh(within @ within.T).eigenvectors[:, ::-1][:, :rank]
        kept = largest.T @ within
    else:
        kept = common.spread(np.eye(len(common))).T
    moved = _by_landmark(kept)
    return JointCovariance(own_m2 + common.squares() - _squares(moved), moved)


def _orthonormal(columns: Float) -> Float:
    """(n, m) columns that span the same, by the Cholesky factor of their products.

    That leaves them orthonormal but for the square of their condition, and a second time but for
    rounding (Yamamoto et al. 2015, "Roundoff error analysis of the CholeskyQR2 algorithm"): tall
    ones take a fifth of what reflections take. Those that are too near to each other take these.
    """
    length = np.linalg.norm(columns, axis=0)
    basis = columns / np.where(length > 0, length, 1.0)
    for _ in range(2):
        factor, failed = _cholesky(basis.T @ basis, lower=1)
        if failed or not np.diagonal(factor).min() > _DEPENDENT:
            return np.linalg.qr(columns)[0]
        basis = scipy.linalg.solve_triangular(factor, basis.T, lower=True, check_finite=False).T
    return basis


def _squares(by_landmark: Float) -> Float:
    """(N, 3, 3) covariance that each landmark has of what shared variables do to it (N, R, 3)."""
    return np.swapaxes(by_landmark, 1, 2) @ by_landmark


def _by_landmark(common: Float) -> Float:
    """(N, R, 3) of (R, 3N)."""
    return np.ascontiguousarray(
        common.reshape(len(common), common.shape[1] // 3, 3).transpose(1, 0, 2)
    )
