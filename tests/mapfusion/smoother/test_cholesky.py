"""Factors of matrices with zeros, against LAPACK's of the dense matrix."""

import numpy as np
import pytest
import scipy.linalg
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from mapfusion.smoother import cholesky
from mapfusion.smoother.cholesky import (
    Envelope,
    Factor,
    envelope_order,
    factor_in_envelope,
    first_entries,
)


def entries_seen(A: np.ndarray) -> Envelope:
    """By the column of each row's first entry."""
    return Envelope(np.argmax(A != 0, axis=1))


def factor_of(A: np.ndarray) -> Factor:
    """Return the lower half of a matrix in its own envelope."""
    envelope = entries_seen(A)
    return factor_in_envelope(envelope.of(A), envelope)


def stored(envelope: Envelope, entries: np.ndarray) -> np.ndarray:
    """(n, n) the lower half by its entries one by one, zero where there are none."""
    n = len(envelope)
    found = np.zeros((n, n))
    for row in range(n):
        for column in range(envelope.first[row], row + 1):
            found[row, column] = entries[envelope.offset[row] + column]
    return found


def matrix_of_groups(rng: np.random.Generator, n: int, n_groups: int) -> np.ndarray:
    """Positive definite (n, n): each group is of three members that have to do with each other."""
    A = np.eye(n)
    for _ in range(n_groups):
        vector = np.zeros(n)
        vector[rng.choice(n, 3, replace=False)] = rng.normal(size=3)
        A += np.outer(vector, vector)
    return A


@pytest.mark.parametrize("n", [1, 95, 96, 97, 300])
@pytest.mark.parametrize("n_groups", [0, 40, 3000])
def test_factor_is_that_of_the_dense_matrix(n, n_groups):
    A = matrix_of_groups(np.random.default_rng(n), n, n_groups if n > 2 else 0)
    given = A.copy()
    given[np.triu_indices(n, cholesky._BLOCK)] = 0  # only the lower half is read
    factor = factor_of(given)
    found = factor.dense()
    np.testing.assert_array_equal(
        stored(factor.envelope, factor.lower)[found != 0], found[found != 0]
    )
    np.testing.assert_allclose(found, scipy.linalg.cholesky(A, lower=True), atol=1e-12)
    right = np.random.default_rng(0).normal(size=(n, 7))
    for some in (right, right[:, 0]):
        np.testing.assert_allclose(found @ factor.solve(some), some, atol=1e-12)
        np.testing.assert_allclose(found.T @ factor.solve_transposed(some), some, atol=1e-12)
    rough = factor.solve(right.astype(np.float32))
    assert rough.dtype == np.float32
    exact = scipy.linalg.solve_triangular(found, right, lower=True)
    np.testing.assert_allclose(rough, exact, rtol=0, atol=1e-4 * np.abs(exact).max())


@pytest.mark.parametrize("n", [1, 47, 48, 49, 300])
@pytest.mark.parametrize("n_groups", [0, 40, 3000])
def test_inverse_is_that_of_the_dense_matrix(n, n_groups):
    A = matrix_of_groups(np.random.default_rng(n), n, n_groups if n > 2 else 0)
    A[-1, 0] = A[0, -1] = 0.5 * A[0, -1] + 0.5 * (n > 2)  # far apart, rows between reach neither
    envelope = entries_seen(np.tril(A))
    inverse = stored(envelope, factor_in_envelope(envelope.of(A), envelope).inverse)
    rows, columns = np.indices(A.shape)
    within = (columns <= rows) & (columns >= envelope.first[rows])
    np.testing.assert_allclose(inverse[within], np.linalg.inv(A)[within], rtol=0, atol=1e-12)


@pytest.mark.parametrize("n_groups", [40, 3000])
def test_blocks_of_three_are_found(n_groups):
    n, rng = 100, np.random.default_rng(0)
    A = np.kron(matrix_of_groups(rng, n, n_groups), np.ones((3, 3)))
    A *= 1 + rng.random(A.shape)
    A = np.tril(A) + np.tril(A, -1).T
    envelope = Envelope(np.argmax(A != 0, axis=1))
    rows, columns = np.nonzero(A[::3, ::3])
    found = envelope.between(envelope.of(A), rows, columns)
    np.testing.assert_array_equal(found, A.reshape(n, 3, n, 3)[rows, :, columns])


def test_nothing_has_a_factor():
    nothing = Envelope(np.empty(0, dtype=np.int64))
    factor = factor_in_envelope(nothing.of(np.empty((0, 0))), nothing)
    assert factor.dense().shape == (0, 0)
    assert factor.solve_transposed(factor.solve(np.empty(0))).shape == (0,)
    assert factor.inverse.size == 0


def test_rows_that_are_zero_for_long_stay_so():
    A = 2 * np.eye(400)
    A[399, 250] = A[250, 399] = 1.0
    assert not np.tril(factor_of(A).dense(), -1)[:, :250].any()


@pytest.mark.parametrize("n_groups", [0, 1, 60])
def test_first_entries_are_those_of_what_has_to_do_with_each_other(n_groups):
    rng, n = np.random.default_rng(n_groups), 150
    group, member = np.repeat(np.arange(n_groups), 3), rng.integers(0, n, 3 * n_groups)
    place = envelope_order(group, member, n)
    A = np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1)
    for each in range(n_groups):
        own = member[group == each]
        A[np.ix_(own, own)] = 1
    ordered = np.empty_like(A)
    ordered[np.ix_(place, place)] = A
    first = first_entries(group, member, place)
    np.testing.assert_array_equal(first, np.argmax(ordered != 0, axis=1))


def test_a_matrix_that_is_not_positive_definite_is_refused():
    A = np.eye(200)
    A[150, 150] = -1
    with pytest.raises(np.linalg.LinAlgError):
        factor_of(A)


def test_order_brings_those_together_that_have_to_do_with_each_other():
    """A circle driven twice: the second lap's poses see what the first lap's did."""
    n = 100
    pose = np.arange(2 * n)
    group, member = np.concatenate([pose % n, (pose + 1) % n]), np.tile(pose, 2)
    place = envelope_order(group, member, 2 * n)
    assert sorted(place) == pose.tolist()
    apart = np.abs(place[:, None] - place)[np.abs(pose[:, None] - pose) == n]
    assert apart.max() <= 6  # 100 in the order in which they were driven


def windows(n: int, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups and members of a drive that sees each thing for `reach` poses and never again."""
    first = np.arange(n - reach + 1)
    return np.repeat(first, reach), (first[:, None] + np.arange(reach)).ravel()


def lengths(group: np.ndarray, member: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(n,) of the rows of a factor."""
    return np.arange(len(place)) - first_entries(group, member, place)


@pytest.mark.parametrize("reach", [2, 10, 30])
def test_while_nothing_is_seen_again_the_order_of_time_stays(reach):
    group, member = windows(60, reach)
    np.testing.assert_array_equal(envelope_order(group, member, 60), np.arange(60))


def test_a_factor_costs_less_than_in_other_orders():
    """Drives that return to five places at different times cost little more than the least."""
    n, costs = 300, []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        group, member = windows(n, 8)
        again = rng.integers(0, n - 20, (5, 2))[:, :, None] + np.arange(20)
        groups = group.max() + 1 + np.tile(np.arange(100).reshape(5, 1, 20), (1, 2, 1))
        group = np.concatenate([group, groups.ravel()])
        member = np.concatenate([member, again.ravel()])
        has = csr_matrix((np.ones(len(group)), (member, group)))
        by_degree = reverse_cuthill_mckee((has @ has.T).tocsr(), symmetric_mode=True).argsort()
        orders = envelope_order(group, member, n), by_degree, np.arange(n)
        found, *others = (np.sum(lengths(group, member, each) ** 2) for each in orders)
        costs.append(found / min(others))
    assert max(costs) <= 1
    assert np.mean(costs) < 0.8


@pytest.mark.parametrize("n_members", [0, 1, 2])
def test_few_members_without_a_group(n_members):
    none = np.empty(0, dtype=np.int64)
    assert sorted(envelope_order(none, none, n_members)) == list(range(n_members))
