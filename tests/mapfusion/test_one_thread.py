"""Linear algebra in small blocks runs on one thread, whatever the caller has set."""

from types import SimpleNamespace
from typing import Any

import pytest
import scipy.linalg  # noqa: F401  brings a BLAS of its own
from threadpoolctl import threadpool_info, threadpool_limits

import mapfusion.fusion.joint
import mapfusion.smoother.smooth
from mapfusion.fusion.fused_map import MergeParameters
from mapfusion.geometry.numerics import one_blas_thread


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
    monkeypatch.setattr(mapfusion.fusion.joint, "_inliers", reached)
    component: Any = SimpleNamespace(planar=False, drift_sigma_m=[], members=[], maps=[])
    with threadpool_limits(2, user_api="blas"), pytest.raises(ReachedError) as found:
        mapfusion.fusion.joint.JointFuser().fuse(component, MergeParameters())
    assert set(found.value.args[0]) == {1}
