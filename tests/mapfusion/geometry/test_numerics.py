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
from scipy.stats import pearsonr
from threadpoolctl import threadpool_info, threadpool_limits

import mapfusion.fusion.joint
import mapfusion.smoother.smooth
from mapfusion.fusion.fusers import MergeParameters
from mapfusion.geometry.numerics import (
    chi_square_bound,
    cholesky,
    cofactors,
    generator,
    one_blas_thread,
    require_no_twins,
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


def draw(seed: int, *purpose: str | int) -> list[float]:
    return generator(seed, *purpose).standard_normal(4).tolist()


def test_a_generator_depends_on_its_seed_and_purpose_alone() -> None:
    first = draw(1, "odometry", "R1")
    draw(1, "odometry", "R2")
    np.random.default_rng(1).random(100)
    assert draw(1, "odometry", "R1") == first
    others = [draw(2, "odometry", "R1"), draw(1, "odometry", "R2"), draw(1, "R1", "odometry")]
    others += [draw(1, "odometry"), draw(1, "odometry", "R1", 0), draw(1, "slam", "R1")]
    assert first not in others
    assert len({tuple(other) for other in others}) == len(others)


def test_generators_do_not_correlate() -> None:
    """Frames of one robot, neighbours among the purposes: |r| stays below 4 / sqrt(n)."""
    n = 20_000
    streams = [generator(0, "radiometry", "R1", k).standard_normal(n) for k in range(6)]
    for i, first in enumerate(streams):
        for second in streams[i + 1 :]:
            assert abs(pearsonr(first, second).statistic) < 4 / np.sqrt(n)


def test_purposes_are_hashed_the_same_in_every_process() -> None:
    """Python's own hash of text differs from process to process; these numbers may not."""
    assert generator(7, "slam", "R1").integers(0, 10**6, 3).tolist() == [315144, 477990, 873372]


@pytest.mark.parametrize("named", [[0, 1, 2, 3], [0, 0, 1, 1], [0, 0, 0, 0]])
def test_rows_are_twins_only_where_all_columns_are_the_same(named: list[int]) -> None:
    name, points = np.array(named), np.array([[1.0, 2.0], [1.0, 3.0], [4.0, 2.0], [4.0, 3.0]])
    require_no_twins("points", name, points)
    twice = np.array([0, 1, 2, 3, 1])
    with pytest.raises(ValueError, match="points: row 4 repeats row 1"):
        require_no_twins("points", name[twice], points[twice])


def test_rows_that_are_not_numbers_are_no_twins() -> None:
    require_no_twins("points", np.full(3, np.nan), np.full((3, 2), np.nan))
