"""Tests of `mapfusion.geometry.se2`."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mapfusion.geometry import se2


@pytest.fixture
def motion():
    T = np.array([1.5, -2.0, 2.3])
    return T, math.cos(T[2]), math.sin(T[2])


def test_moved_point_and_residual(motion):
    T = motion[0]
    p_a, p_b = np.random.default_rng(0).normal(0, 5, (2, 7, 3))
    for i in range(7):
        moved = se2.transform_points(T, p_b[i : i + 1])[0]
        assert se2.moved_point(*motion, p_b[i, 0], p_b[i, 1]) == pytest.approx(tuple(moved[:2]))
        expected = tuple((p_a[i] - moved)[:2])
        assert se2.residual(*motion, p_a, p_b, i) == pytest.approx(expected)


def test_lever_is_the_derivative_by_theta(motion):
    T, cos, sin = motion
    p, step = np.random.default_rng(1).normal(0, 5, (4, 2)), np.array([0, 0, 1e-6])
    ahead, behind = (se2.transform_points(T + s, p) for s in (step, -step))
    for i in range(4):
        slope = (ahead[i] - behind[i]) / 2e-6
        assert se2.lever(cos, sin, p, i) == pytest.approx(tuple(slope), abs=1e-8)


def test_add_turned_is_r_s_rt(motion):
    _, cos, sin = motion
    roots = np.random.default_rng(2).normal(0, 1, (2, 2, 2))
    A, B = (root @ root.T for root in roots)
    R = np.array([[cos, -sin], [sin, cos]])
    expected = A + R @ B @ R.T
    found = se2.add_turned(A[0, 0], A[0, 1], A[1, 1], cos, sin, B[0, 0], B[0, 1], B[1, 1])
    assert found == pytest.approx((expected[0, 0], expected[0, 1], expected[1, 1]))


metres = st.floats(-100, 100)
# whole turns and their neighbourhood included
radians = st.floats(-10, 10) | st.sampled_from([0.0, 1e-9, np.pi, -np.pi, np.pi - 1e-9, 3 * np.pi])
motions = st.tuples(metres, metres, radians).map(np.array)
batches = hnp.array_shapes(min_dims=1, max_dims=3, max_side=4).flatmap(
    lambda shape: hnp.arrays(np.float64, (*shape, 3), elements=metres)
)


def matrix(T):
    c, s = np.cos(T[2]), np.sin(T[2])
    return np.array([[c, -s, T[0]], [s, c, T[1]], [0, 0, 1]])


def assert_same(T, other):
    np.testing.assert_allclose(T[..., :2], other[..., :2], atol=1e-9)
    np.testing.assert_allclose(se2.wrap(T[..., 2] - other[..., 2]), 0, atol=1e-9)


@given(motions, motions)
def test_compose_is_the_product_of_matrices(T_a_b, T_b_c):
    composed = se2.compose(T_a_b, T_b_c)
    np.testing.assert_allclose(matrix(composed), matrix(T_a_b) @ matrix(T_b_c), atol=1e-9)
    assert -np.pi <= composed[2] < np.pi


@given(motions)
def test_inverse_is_the_inverse_matrix(T_a_b):
    np.testing.assert_allclose(matrix(se2.inverse(T_a_b)) @ matrix(T_a_b), np.eye(3), atol=1e-9)


@given(motions)
def test_identity(T_a_b):
    assert_same(se2.compose(T_a_b, se2.IDENTITY), T_a_b)
    assert_same(se2.compose(se2.IDENTITY, T_a_b), T_a_b)
    assert_same(se2.compose(T_a_b, se2.inverse(T_a_b)), se2.IDENTITY)


@given(motions, motions, motions)
def test_associative(T_a_b, T_b_c, T_c_d):
    assert_same(
        se2.compose(se2.compose(T_a_b, T_b_c), T_c_d),
        se2.compose(T_a_b, se2.compose(T_b_c, T_c_d)),
    )


@given(motions, motions)
def test_between_undoes_compose(T_w_a, T_a_b):
    assert_same(se2.between(T_w_a, se2.compose(T_w_a, T_a_b)), T_a_b)


@given(batches)
def test_batches_are_their_elements(T):
    assert se2.inverse(T).shape == se2.compose(T, T).shape == T.shape
    for index in np.ndindex(T.shape[:-1]):
        assert_same(se2.inverse(T)[index], se2.inverse(T[index]))
        assert_same(se2.compose(T, T[..., ::-1])[index], se2.compose(T[index], T[index][::-1]))
        np.testing.assert_array_equal(se2.rotation(T[..., 2])[index], se2.rotation(T[index][2]))


@given(radians)
def test_wrap(angle):
    wrapped = se2.wrap(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


@given(motions, hnp.arrays(np.float64, (5, 3), elements=metres))
def test_points_move_as_under_the_matrix_and_keep_their_height(T_a_b, p_b):
    before = p_b.copy()
    p_a = se2.transform_points(T_a_b, p_b)
    homogeneous = np.column_stack([p_b[:, :2], np.ones(5)])
    np.testing.assert_allclose(p_a[:, :2], (homogeneous @ matrix(T_a_b).T)[:, :2], atol=1e-9)
    np.testing.assert_array_equal(p_a[:, 2], p_b[:, 2])
    np.testing.assert_array_equal(p_b, before)
    np.testing.assert_allclose(se2.transform_points(T_a_b, p_b[:, :2]), p_a[:, :2], atol=1e-9)


def test_a_quarter_turn_is_counter_clockwise():
    T_a_b = np.array([1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(
        se2.transform_points(T_a_b, np.array([[1.0, 0.0, 5.0]])), [[1.0, 3.0, 5.0]], atol=1e-12
    )
    turned = se2.transform_covariances(T_a_b, np.diag([4.0, 1.0, 9.0])[None])
    np.testing.assert_allclose(turned[0], np.diag([1.0, 4.0, 9.0]), atol=1e-12)


def test_covariance_moves_as_samples_do():
    T_a_b = np.array([3.0, -2.0, 0.6])
    S = np.array([[0.5, 0.2, 0.1], [0.2, 0.3, 0.0], [0.1, 0.0, 0.2]])
    p = np.random.default_rng(0).multivariate_normal([1, 2, 3], S, 200_000)
    expected = se2.transform_covariances(T_a_b, S[None])[0]
    np.testing.assert_allclose(np.cov(se2.transform_points(T_a_b, p).T), expected, atol=0.01)


def test_stated_sigma_is_the_rms_of_what_is_drawn():
    S = np.array([[0.5, 0.2, 0.1], [0.2, 0.3, 0.0], [0.1, 0.0, 0.2]])
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(3), S, 200_000)
    sigma_m, sigma_rad = se2.motion_sigma(S)
    assert sigma_m == pytest.approx(np.sqrt(np.mean(np.sum(drawn[:, :2] ** 2, axis=1))), rel=0.01)
    assert sigma_rad == pytest.approx(np.sqrt(np.mean(drawn[:, 2] ** 2)), rel=0.01)
