"""What the errors of the path do to all landmarks, without the large matrix that says so.

With L the factor of the poses' information, C the poses' blocks with the landmarks and A the
landmarks' covariances if the path were known, the landmarks' joint covariance is A beside Y' Y with
Y = L^-1 C A. It has as many columns as there are coordinates of landmarks; C A has few entries.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float
from mapfusion.smoother.landmark_elimination import left_couplings
from mapfusion.smoother.normal_equations import NormalEquations
from mapfusion.smoother.offsets import without_offsets
from mapfusion.smoother.sightings import Sightings
from mapfusion.smoother.skyline import Factor


@dataclass(frozen=True)
class PathErrors:
    """Y (R, 3L), of the R coordinates of the unknown poses in their order.

    Attributes:
        seen: the observations.
        factor: L.
        moved: (N, 3, 3) entries of C A, by observation.
    """

    seen: Sightings
    factor: Factor
    moved: Float

    @classmethod
    def of(
        cls, seen: Sightings, equations: NormalEquations, own_m2: Float, factor: Factor
    ) -> "PathErrors":
        """Of equations that are solved, the landmarks first: with their `own_m2` and the factor."""
        left = without_offsets(seen, equations.points)
        coupling = left_couplings(seen, equations.coupling, left)
        return cls(seen, factor, coupling @ own_m2[seen.landmark])

    def __len__(self) -> int:
        return len(self.factor)

    def rows_by_all(self, rows: np.ndarray) -> Float:
        """(R, r) columns of Y Y', those of `rows` (r,)."""
        chosen = np.zeros((len(self), len(rows)))
        chosen[rows, np.arange(len(rows))] = 1.0
        return self.gram(chosen)

    def gram(self, columns: Float) -> Float:
        """Y Y' times columns (R, c), in single precision."""
        moving = self._moving_roughly
        by_landmark = moving @ self.factor.solve_transposed(columns.astype(np.float32))
        return self.factor.solve(moving.T @ by_landmark).astype(np.float64)

    def spread(self, columns: Float) -> Float:
        """(3L, c) Y' times columns (R, c)."""
        return self._moving @ self.factor.solve_transposed(columns)

    def gathered(self, by_landmark: Float) -> Float:
        """Return (R, c) Y times columns (3L, c)."""
        return self.factor.solve(self._moving.T @ by_landmark)

    def squares(self) -> Float:
        """(L, 3, 3) blocks of Y' Y, each landmark's with itself."""
        total = np.zeros((self.seen.n_landmarks, 3, 3))
        covariance, offset = self.factor.inverse, self.factor.envelope.offset
        place = self.seen.unknown_place
        _add_squares(self.seen.starts, place, self.moved, offset, covariance, total)
        return total + np.swapaxes(total, 1, 2)

    @cached_property
    def _moving(self) -> csr_array:
        """(3L, R) A C', of which each observation is a block."""
        place, each = self.seen.unknown_place, np.arange(3)
        known = place >= 0
        rows = 3 * self.seen.landmark[known, None] + each
        columns = 3 * place[known, None] + each
        rows, columns = np.broadcast_arrays(rows[:, None, :], columns[:, :, None])
        shape = 3 * self.seen.n_landmarks, len(self)
        return csr_array((self.moved[known].ravel(), (rows.ravel(), columns.ravel())), shape)

    @cached_property
    def _moving_roughly(self) -> csr_array:
        """The same in single precision."""
        known = self._moving
        entries = known.data.astype(np.float32), known.indices, known.indptr
        return csr_array(entries, known.shape)


@kernel
def _add_squares(
    starts: np.ndarray,
    place: np.ndarray,
    moved: Float,
    offset: np.ndarray,
    Z: Float,
    total: Float,
) -> None:
    """Of each landmark what, with its transpose, is moved' Z moved of all that saw it."""
    of_pose = np.empty((3, 3))
    for j in range(len(starts) - 1):
        for i in range(starts[j], starts[j + 1]):
            if place[i] < 0:
                continue
            for r in range(3):
                for q in range(3):
                    of_pose[r, q] = 0.0
            for k in range(starts[j], i + 1):
                if place[k] >= 0:
                    share = 0.5 if k == i else 1.0
                    _add_part(Z, offset, 3 * place[i], 3 * place[k], share, moved, k, of_pose)
            for r in range(3):
                for q in range(3):
                    total[j, r, q] += (
                        moved[i, 0, r] * of_pose[0, q]
                        + moved[i, 1, r] * of_pose[1, q]
                        + moved[i, 2, r] * of_pose[2, q]
                    )


@kernel_part
def _add_part(
    Z: Float,
    offset: np.ndarray,
    row: int,
    column: int,
    share: float,
    moved: Float,
    k: int,
    total: Float,
) -> None:
    """Add a share of the poses' covariance times what moves observation k's landmark."""
    above = row < column  # its mirror image is stored
    down, across = (column, row) if above else (row, column)
    at0, at1, at2 = offset[down] + across, offset[down + 1] + across, offset[down + 2] + across
    for q in range(3):
        x, y, z = share * moved[k, 0, q], share * moved[k, 1, q], share * moved[k, 2, q]
        if above:
            for r in range(3):
                total[r, q] += Z[at0 + r] * x + Z[at1 + r] * y + Z[at2 + r] * z
        else:
            total[0, q] += Z[at0] * x + Z[at0 + 1] * y + Z[at0 + 2] * z
            total[1, q] += Z[at1] * x + Z[at1 + 1] * y + Z[at1 + 2] * z
            total[2, q] += Z[at2] * x + Z[at2 + 1] * y + Z[at2 + 2] * z
