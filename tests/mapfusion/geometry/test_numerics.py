"""Tests of `mapfusion.geometry.numerics`."""

import math
import os
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  brings a BLAS of its own
from threadpoolctl import threadpool_info, threadpool_limits

import mapfusion.fusion.joint
import mapfusion.smoother.smooth
from mapfusion.fusion.fusers import MergeParameters
from mapfusion.geometry.numerics import (
    chi_square_bound,
    cholesky,
    cofactors,
    one_blas_thread,
    solve_lower,
    solve_upper,
)


def test_two_degrees_of_freedom_have_a_closed_form() -> None:
    for probability in (0.5, 0.99, 0.999):
        assert math.isclose(chi_square_bound(probability, 2), -2 * math.log1p(-probability))


def test_share_of_draws_below() -> None:
    squares = np.random.default_rng(0).standard_normal((100_000, 3)) ** 2
    below = np.mean(squares.sum(axis=1) <= chi_square_bound(0.9, 3))
    assert abs(below - 0.9) < 4 * math.sqrt(0.9 * 0.1 / len(squares))


def blas_threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


class ReachedError(Exception):
    """Carries what was seen inside."""


def reached(*_, **__):
    raise ReachedError(blas_threads())


def test_blas_has_one_thread_inside_and_then_what_it_had():
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        inside = one_blas_thread(blas_threads)()
        assert set(inside) == {1}
        assert len(inside) >= 1
        assert blas_threads() == before


def test_smoothing_runs_on_one_thread(monkeypatch):
    monkeypatch.setattr(mapfusion.smoother.smooth, "require_shape", reached)
    nothing: Any = []
    with threadpool_limits(2, user_api="blas"), pytest.raises(ReachedError) as found:
        mapfusion.smoother.smooth.smooth(nothing, nothing, nothing, nothing)
    assert set(found.value.args[0]) == {1}


def test_joint_fusion_runs_on_one_thread(monkeypatch):
    monkeypatch.setattr(mapfusion.fusion.joint, "cluster_landmarks", reached)
    sigma: dict[str, Any] = {"drift_sigma_m": [], "height_sigma_m": []}
    component: Any = SimpleNamespace(planar=False, members=[], maps=[], pairs=[], **sigma)
    with threadpool_limits(2, user_api="blas"), pytest.raises(ReachedError) as found:
        mapfusion.fusion.joint.JointFuser().fuse(component, MergeParameters())
    assert set(found.value.args[0]) == {1}


def definite(seed, n):
    root = np.random.default_rng(seed).normal(0, 1, (n, n))
    return root @ root.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("seed", range(3))
def test_cofactors_over_the_determinant_are_the_inverse(seed):
    S = definite(seed, 3)
    upper = np.triu_indices(3)
    *adjugate, det = cofactors(*S[upper])
    assert det == pytest.approx(np.linalg.det(S))
    np.testing.assert_allclose(np.array(adjugate) / det, np.linalg.inv(S)[upper])


@pytest.mark.parametrize("n", [1, 3, 4])
def test_root_and_solutions(n):
    S, b = definite(n, n), np.arange(1.0, n + 1)
    factor, x = S.copy(), b.copy()
    assert cholesky(factor, 0.0)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(S))
    solve_lower(factor, x)
    solve_upper(factor, x)
    np.testing.assert_allclose(x, np.linalg.solve(S, b))


def test_only_the_lower_half_is_read():
    S = definite(7, 3)
    factor = np.tril(S) + np.triu(np.full((3, 3), np.nan), 1)
    assert cholesky(factor, 0.0)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(S))


def test_a_singular_matrix_is_told():
    assert not cholesky(np.ones((2, 2)), 0.0)
    nearly = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-10]])
    assert not cholesky(nearly.copy(), 1e-9)
    assert cholesky(nearly.copy(), 1e-12)


COMPILING = """
import numpy as np
from mapfusion.geometry.numerics import before_compilation, cholesky, invert

before_compilation(lambda: print("compiles"))
for _ in range(2):
    invert(np.eye(3), np.zeros((3, 3)))
cholesky(np.eye(3), 1e-9)
"""


def test_compilation_is_announced_once_and_not_for_kernels_on_the_disk(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    for announced in ("compiles\n", ""):
        run = subprocess.run(
            [sys.executable, "-c", COMPILING],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert run.stdout == announced
