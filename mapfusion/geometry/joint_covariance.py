"""Joint covariance of a map's landmarks: block diagonal plus low rank.

The errors of all landmarks are correlated by the drift of the path, which has few dominant
directions. So the error of a landmark is modelled as an error of its own plus the effect of a few
shared, independent, standard normal variables z: x_i = m_i + C_i' z + e_i, with e_i of covariance
`own_m2`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy

from mapfusion.geometry.numerics import Float, require_finite, require_shape

# Number of shared variables that are kept. A log has three per frame, but their variances fall
# fast; the remainder is added to the landmarks' own covariances.
RANK = 100
# Number of shared variables that dominate a map: shift, turn and bends of the path.
LEADING = 20
# Oversampling and iterations of the subspace iteration. In each iteration the unwanted directions
# shrink by the ratio of their variance to the wanted ones.
_OVERSAMPLING, _ITERATIONS = 20, 3
# Sine of the angle between a direction and those before it, below which CholeskyQR is inaccurate.
_DEPENDENT = 1e-6
# Largest number of rows for which computing Y Y' costs no more than its products with columns by
# way of Y' in all iterations.
_FEW = 2 * _ITERATIONS * (RANK + _OVERSAMPLING)


@dataclass(frozen=True)
class JointCovariance:
    """Joint covariance of N landmarks by R shared variables.

    Attributes:
        own_m2: covariance of each landmark's own error, shape (N, 3, 3).
        common_m: C_i, displacement of each landmark by one sigma of each shared variable, shape
            (N, R, 3).
        complete: False if shared errors of a last part of the path are missing.
    """

    own_m2: Float
    common_m: Float
    complete: bool = True

    def __post_init__(self) -> None:
        n = len(self.own_m2)
        require_shape("own_m2", self.own_m2, (n, 3, 3))
        require_shape("common_m", self.common_m, (n, self.rank, 3))
        require_finite("own_m2", self.own_m2)
        require_finite("common_m", self.common_m)

    def __len__(self) -> int:
        return len(self.own_m2)

    def __getitem__(self, rows: np.ndarray | slice) -> "JointCovariance":
        return JointCovariance(self.own_m2[rows], self.common_m[rows], self.complete)

    @property
    def rank(self) -> int:
        """Number R of shared variables."""
        return self.common_m.shape[1]

    @property
    def marginal_m2(self) -> Float:
        """Marginal covariance of each landmark, shape (N, 3, 3)."""
        return self.own_m2 + _squares(self.common_m)

    @cached_property
    def leading(self) -> "JointCovariance":
        """The joint covariance by the `LEADING` shared variables that move the landmarks most.

        The effect of the others is added to the landmarks' own covariances.
        """
        by_effect = np.argsort(-np.sum(self.common_m**2, axis=(0, 2)), kind="stable")
        kept, others = (self.common_m[:, by] for by in np.split(by_effect, [LEADING]))
        return JointCovariance(self.own_m2 + _squares(others), kept, self.complete)

    def dense_m2(self) -> Float:
        """Return the dense covariance, shape (3N, 3N), for small maps."""
        n, each = len(self), np.arange(len(self))
        stacked = self.common_m.transpose(1, 0, 2).reshape(self.rank, 3 * n)
        joint = stacked.T @ stacked
        joint.reshape(n, 3, n, 3)[each, :, each, :] += self.own_m2
        return joint


class SharedErrors(Protocol):
    """Matrix Y (R, 3N): displacement of N landmarks by R independent standard normal variables."""

    def __len__(self) -> int:
        """Return R."""
        ...

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """Return the columns `rows` (r,) of Y Y', shape (R, r)."""
        ...

    def gram(self, columns: Float) -> Float:
        """Return Y Y' times columns (R, c)."""
        ...

    def spread(self, columns: Float) -> Float:
        """Return Y' times columns (R, c), shape (3N, c)."""
        ...

    def gathered(self, by_landmark: Float) -> Float:
        """Return Y times columns (3N, c), shape (R, c)."""
        ...

    def squares(self) -> Float:
        """Return the diagonal blocks of Y' Y, shape (N, 3, 3)."""
        ...


@dataclass(frozen=True)
class KnownErrors:
    """Shared errors by the matrix Y itself; methods as in `SharedErrors`."""

    common: Float

    def __len__(self) -> int:
        return len(self.common)

    @cached_property
    def _gram(self) -> Float:
        """Y Y', shape (R, R)."""
        return self.common @ self.common.T

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """Return the columns `rows` (r,) of Y Y', shape (R, r)."""
        if len(self) <= _FEW:
            return self._gram[:, rows]
        return self.common @ np.ascontiguousarray(self.common[rows].T)

    def gram(self, columns: Float) -> Float:
        """Return Y Y' times columns (R, c)."""
        if len(self) <= _FEW:
            return self._gram @ columns
        return self.common @ self.spread(columns)

    def spread(self, columns: Float) -> Float:
        """Return Y' times columns (R, c), shape (3N, c)."""
        return self.common.T @ columns

    def gathered(self, by_landmark: Float) -> Float:
        """Return Y times columns (3N, c), shape (R, c)."""
        return self.common @ by_landmark

    def squares(self) -> Float:
        """Return the diagonal blocks of Y' Y, shape (N, 3, 3)."""
        return _squares(_by_landmark(self.common))


@dataclass(frozen=True)
class StackedErrors:
    """Shared errors followed by a few known ones, independent of the first.

    Methods as in `SharedErrors`.
    """

    first: SharedErrors
    known: KnownErrors

    def __len__(self) -> int:
        return len(self.first) + len(self.known)

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """Return the columns `rows` (r,) of Y Y', shape (R, r)."""
        chosen = np.zeros((len(self), len(rows)))
        chosen[rows, np.arange(len(rows))] = 1.0
        return self.gram(chosen)

    def gram(self, columns: Float) -> Float:
        """Return Y Y' times columns (R, c)."""
        upper, lower = columns[: len(self.first)], columns[len(self.first) :]
        of_first = self.first.gram(upper) + self._cross @ lower
        return np.concatenate([of_first, self._cross.T @ upper + self.known.gram(lower)])

    def spread(self, columns: Float) -> Float:
        """Return Y' times columns (R, c), shape (3N, c)."""
        upper, lower = columns[: len(self.first)], columns[len(self.first) :]
        return self.first.spread(upper) + self.known.spread(lower)

    def gathered(self, by_landmark: Float) -> Float:
        """Return Y times columns (3N, c), shape (R, c)."""
        return np.concatenate([self.first.gathered(by_landmark), self.known.gathered(by_landmark)])

    def squares(self) -> Float:
        """Return the diagonal blocks of Y' Y, shape (N, 3, 3)."""
        return self.first.squares() + self.known.squares()

    @cached_property
    def _cross(self) -> Float:
        """Block of Y Y' between the first and the known errors."""
        return self.first.gathered(self.known.common.T)


def reduce_rank(own_m2: Float, common: Float | SharedErrors, rank: int = RANK) -> JointCovariance:
    """Reduce the shared variables of a joint covariance to the `rank` of largest variance.

    Subspace iteration (Halko, Martinsson, Tropp 2011, alg. 4.4). It starts from rows of `common`
    evenly spread over the path, since the rows belong to frames. The marginal covariances stay the
    same: the neglected part is added to the landmarks' own covariances.

    Args:
        own_m2: covariances of the landmarks' own errors, shape (N, 3, 3).
        common: displacements by the shared variables, shape (R, 3N).
        rank: largest number of remaining shared variables.
    """
    if isinstance(common, np.ndarray):
        common = KnownErrors(common)
    if len(common) > rank:
        n_start = min(rank + _OVERSAMPLING, len(common))
        rows = np.linspace(0, len(common) - 1, n_start).round().astype(int)
        # first iteration: columns of the identity select rows
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
    """Return an orthonormal basis of columns (n, m) by CholeskyQR2.

    The second pass reduces the error to rounding (Yamamoto et al. 2015, "Roundoff error analysis of
    the CholeskyQR2 algorithm"). Nearly dependent columns use Householder reflections instead, which
    take several times as long.
    """
    length = np.linalg.norm(columns, axis=0)
    basis = columns / np.where(length > 0, length, 1.0)
    for _ in range(2):
        factor, failed = scipy.linalg.lapack.dpotrf(basis.T @ basis, lower=1)
        if failed or not np.diagonal(factor).min() > _DEPENDENT:
            return np.linalg.qr(columns)[0]
        basis = scipy.linalg.solve_triangular(factor, basis.T, lower=True, check_finite=False).T
    return basis


def _squares(by_landmark: Float) -> Float:
    """Return the covariances (N, 3, 3) of landmarks by displacements (N, R, 3)."""
    return np.swapaxes(by_landmark, 1, 2) @ by_landmark


def _by_landmark(common: Float) -> Float:
    """Rearrange displacements (R, 3N) to (N, R, 3)."""
    return np.ascontiguousarray(
        common.reshape(len(common), common.shape[1] // 3, 3).transpose(1, 0, 2)
    )
