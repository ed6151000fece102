"""Whether an answer is an alignment at all: what others' code returns is not taken on trust."""

import math
from typing import Any

import numpy as np

from mapfusion.align.result import Alignment, Status

_ANSWERS = (Status.ACCEPTED, Status.REFUSED, Status.DEGENERATE)
_ASYMMETRY = 1e-9  # relative: more than rounding leaves of a symmetric product
_LEAST_EIGENVALUE = -1e-9  # relative to the largest: rounding of a singular covariance


def why_nonsense(answer: Any, n_correspondences: int) -> str:
    """What is wrong with an aligner's answer about this many correspondences; empty for nothing.

    A motion is finite with theta in [-pi, pi], or NaN when degenerate; an accepted one has a
    covariance, symmetric and without negative variances; what was not accepted says why.
    """
    if not isinstance(answer, Alignment):
        return f"returned {type(answer).__name__}, expected Alignment"
    if answer.status not in _ANSWERS:
        return f"status is {answer.status!r:.40}, expected one of {', '.join(_ANSWERS)}"
    if not isinstance(answer.reason, str):
        return f"reason is {type(answer.reason).__name__}, expected str"
    if answer.status is not Status.ACCEPTED and not answer.reason.strip():
        return f"{answer.status} without a reason"
    if not isinstance(answer.drift_sigma_m, (float, np.floating)):
        return f"drift_sigma_m is {type(answer.drift_sigma_m).__name__}, expected float"
    return (
        _why_bad_array("T_a_b", answer.T_a_b, (3,), "f")
        or _why_bad_array("covariance", answer.covariance, (3, 3), "f")
        or _why_bad_array("inlier", answer.inlier, (n_correspondences,), "b")
        or _why_bad_motion(answer)
        or _why_bad_covariance(answer)
    )


def _why_bad_array(name: str, values: Any, shape: tuple[int, ...], kind: str) -> str:
    expected = f"expected an array {shape} of {'bool' if kind == 'b' else 'float'}"
    if not isinstance(values, np.ndarray):
        return f"{name} is {type(values).__name__}, {expected}"
    if values.shape != shape or values.dtype.kind != kind:
        return f"{name} is an array {values.shape} of {values.dtype}, {expected}"
    return ""


def _why_bad_motion(answer: Alignment) -> str:
    finite = np.isfinite(answer.T_a_b)
    if answer.status is Status.DEGENERATE:
        return "" if np.isnan(answer.T_a_b).all() else "T_a_b is not NaN, but degenerate"
    if not finite.all():
        return f"T_a_b is not finite, but {answer.status}"
    theta = float(answer.T_a_b[2])
    return "" if abs(theta) <= math.pi else f"theta is {theta:g} rad, expected -pi to pi"


def _why_bad_covariance(answer: Alignment) -> str:
    covariance = answer.covariance
    if answer.status is not Status.ACCEPTED and np.isnan(covariance).all():
        return ""
    if not np.isfinite(covariance).all():
        return "covariance is not finite"
    largest = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > _ASYMMETRY * largest:
        return "covariance is not symmetric"
    if np.linalg.eigvalsh((covariance + covariance.T) / 2)[0] < _LEAST_EIGENVALUE * largest:
        return "covariance has a negative variance"
    return ""
