"""Kernels of the plane against whole matrices."""

import math

import numpy as np
import pytest

from mapfusion.geometry import se2
from tests.helpers.inner_kernels import from_python


@pytest.fixture
def motion():
    T = np.array([1.5, -2.0, 2.3])
    return T, math.cos(T[2]), math.sin(T[2])


def test_moved_point_and_residual(motion):
    T = motion[0]
    p_a, p_b = np.random.default_rng(0).normal(0, 5, (2, 7, 3))
    for i in range(7):
        moved = se2.transform_points(T, p_b[i : i + 1])[0]
        assert from_python(se2.moved_point)(*motion, p_b[i, 0], p_b[i, 1]) == pytest.approx(
            tuple(moved[:2])
        )
        expected = tuple((p_a[i] - moved)[:2])
        assert from_python(se2.residual)(*motion, p_a, p_b, i) == pytest.approx(expected)


def test_lever_is_the_derivative_by_theta(motion):
    T, cos, sin = motion
    p, step = np.random.default_rng(1).normal(0, 5, (4, 2)), np.array([0, 0, 1e-6])
    ahead, behind = (se2.transform_points(T + s, p) for s in (step, -step))
    for i in range(4):
        slope = (ahead[i] - behind[i]) / 2e-6
        assert from_python(se2.lever)(cos, sin, p, i) == pytest.approx(tuple(slope), abs=1e-8)


def test_add_turned_is_r_s_rt(motion):
    _, cos, sin = motion
    roots = np.random.default_rng(2).normal(0, 1, (2, 2, 2))
    A, B = (root @ root.T for root in roots)
    R = np.array([[cos, -sin], [sin, cos]])
    expected = A + R @ B @ R.T
    found = from_python(se2.add_turned)(
        A[0, 0], A[0, 1], A[1, 1], cos, sin, B[0, 0], B[0, 1], B[1, 1]
    )
    assert found == pytest.approx((expected[0, 0], expected[0, 1], expected[1, 1]))
