"""Products with a matrix solve for what it turns into a right side, and tell when they cannot."""

import numpy as np
import pytest

from mapfusion.geometry.numerics import Float
from mapfusion.smoother.elimination import solved_by_products

N = 40


def positive_definite(rng: np.random.Generator) -> Float:
    """(N, N), its eigenvalues four orders of magnitude apart."""
    turn = np.linalg.qr(rng.standard_normal((N, N)))[0]
    return turn @ np.diag(np.logspace(-2, 2, N)) @ turn.T


@pytest.mark.parametrize("share", [1e-3, 1e-8])
def test_is_off_by_no_more_than_was_asked(share: float) -> None:
    rng = np.random.default_rng(0)
    A = positive_definite(rng)
    root = rng.standard_normal((N, 3))
    near = np.linalg.inv(A + root @ root.T)  # of the matrix and three more directions
    right = rng.standard_normal(N)
    calls = []

    def times(x: Float) -> Float:
        calls.append(x)
        return A @ x

    x = solved_by_products(times, lambda rest: near @ rest, right, share, most=12)
    assert x is not None
    true = np.linalg.solve(A, right)
    assert (x - true) @ A @ (x - true) <= (share**2) * (true @ A @ true)
    assert len(calls) <= 5  # as many as there are different eigenvalues, and one for rounding


def test_gives_up_after_so_many_products() -> None:
    rng = np.random.default_rng(1)
    A, right = positive_definite(rng), rng.standard_normal(N)
    assert solved_by_products(lambda x: A @ x, np.copy, right, 1e-8, most=5) is None


@pytest.mark.parametrize("fault", [-1.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_is_told(fault: float) -> None:
    A = np.diag([1.0, 2.0, fault])
    assert solved_by_products(lambda x: A @ x, np.copy, np.ones(3), 1e-8, most=50) is None


def test_of_nothing_is_nothing() -> None:
    found = solved_by_products(lambda x: x, np.copy, np.zeros((4, 3)), 1e-8, most=1)
    np.testing.assert_array_equal(found, np.zeros((4, 3)))
