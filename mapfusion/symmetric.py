"""Small symmetric matrices in kernels, where LAPACK's wrappers would take seconds to compile."""

import math

from mapfusion.kernels import inner_kernel
from mapfusion.se2 import Float

_SINGULAR = 1e-12  # determinant of a matrix scaled to a unit diagonal that is rounding error


@inner_kernel
def cofactors(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float, float]:
    """Cofactors (six upper entries) and determinant of a symmetric 3x3 matrix."""
    axx, axy, axz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    ayy, ayz, azz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return axx, axy, axz, ayy, ayz, azz, xx * axx + xy * axy + xz * axz


@inner_kernel
def invert(matrix: Float, inverse: Float) -> bool:
    """Fill the inverse (3, 3) of a symmetric matrix; False unless positive definite."""
    a, d, f = matrix[0, 0], matrix[1, 1], matrix[2, 2]
    axx, axy, axz, ayy, ayz, azz, det = cofactors(a, matrix[0, 1], matrix[0, 2], d, matrix[1, 2], f)
    positive = a > 0 and azz > 0  # with det > 0 the leading minors (Sylvester)
    if not (positive and det > _SINGULAR * a * d * f):
        return False
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = axx / det, ayy / det, azz / det
    inverse[0, 1] = inverse[1, 0] = axy / det
    inverse[0, 2] = inverse[2, 0] = axz / det
    inverse[1, 2] = inverse[2, 1] = ayz / det
    return True


@inner_kernel
def copy_lower(matrix: Float, copy: Float) -> None:
    """Put the lower half of a matrix into another, which Numba's `copy[:] = matrix` would, too.

    That compiles what says in words how shapes differ, which takes seconds.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            copy[i, j] = matrix[i, j]


@inner_kernel
def cholesky(matrix: Float, singular: float) -> bool:
    """Lower factor of a symmetric matrix in place, of which the lower half is read.

    Returns:
        False when it is not positive definite: a pivot is `singular` of its diagonal entry or less.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > singular * matrix[i, i]:
                matrix[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@inner_kernel
def solve_lower(factor: Float, x: Float) -> None:
    """Solve factor y = x in place."""
    for i in range(len(x)):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]


@inner_kernel
def solve_upper(factor: Float, x: Float) -> None:
    """Solve factor^T y = x in place."""
    for i in range(len(x) - 1, -1, -1):
        for k in range(i + 1, len(x)):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
