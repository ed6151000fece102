"""Small matrices against LAPACK."""

import numpy as np
import pytest

from mapfusion.geometry.numerics import cholesky, cofactors, solve_lower, solve_upper
from tests.helpers.inner_kernels import from_python


def definite(seed, n):
    root = np.random.default_rng(seed).normal(0, 1, (n, n))
    return root @ root.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("seed", range(3))
def test_cofactors_over_the_determinant_are_the_inverse(seed):
    S = definite(seed, 3)
    upper = np.triu_indices(3)
    *adjugate, det = from_python(cofactors)(*S[upper])
    assert det == pytest.approx(np.linalg.det(S))
    np.testing.assert_allclose(np.array(adjugate) / det, np.linalg.inv(S)[upper])


@pytest.mark.parametrize("n", [1, 3, 4])
def test_root_and_solutions(n):
    S, b = definite(n, n), np.arange(1.0, n + 1)
    factor, x = S.copy(), b.copy()
    assert from_python(cholesky)(factor, 0.0)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(S))
    from_python(solve_lower)(factor, x)
    from_python(solve_upper)(factor, x)
    np.testing.assert_allclose(x, np.linalg.solve(S, b))


def test_only_the_lower_half_is_read():
    S = definite(7, 3)
    factor = np.tril(S) + np.triu(np.full((3, 3), np.nan), 1)
    assert from_python(cholesky)(factor, 0.0)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(S))


def test_a_singular_matrix_is_told():
    assert not from_python(cholesky)(np.ones((2, 2)), 0.0)
    nearly = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-10]])
    assert not from_python(cholesky)(nearly.copy(), 1e-9)
    assert from_python(cholesky)(nearly.copy(), 1e-12)
