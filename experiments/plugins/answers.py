"""Validation of plug-ins and of their answers, and the JSON form of an answer.

An answer is validated in the process of the plug-in and again by the process that reads it, because
a plug-in may change any library in its own process.
"""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from mapfusion.align.alignment import (
    Alignment,
    Fit,
    Needs,
    Pairs,
    Status,
    Undetermined,
    without_answer,
)
from mapfusion.errors import one_line
from mapfusion.verification.registration import Aligner, MethodAligner

_STATUSES = (Status.ACCEPTED, Status.REFUSED, Status.DEGENERATE)
_MAX_ASYMMETRY = 1e-9  # relative to the largest entry: rounding of a symmetric product
_MIN_EIGENVALUE = -1e-9  # relative to the largest entry: rounding of a singular covariance


class InvalidAnswerError(Exception):
    """A method or its answer does not follow the interface; the text says where."""


def checked_aligner(method: Any) -> Aligner:
    """Return the aligner of a plug-in's method; raise InvalidAnswerError if it is not a method."""
    _require_type("randomised is", getattr(method, "randomised", None), bool)
    if callable(getattr(method, "align", None)):
        return method
    has_find = callable(getattr(method, "find", None))
    _require(has_find, "has neither a method find nor a method align")
    needs, height = getattr(method, "needs", None), getattr(method, "height", None)
    _require_type("needs is", needs, Needs, type(None))

    def find(pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        return checked_fit(method.find(pairs, rng), len(pairs))

    checked: Any = SimpleNamespace(
        randomised=method.randomised, needs=needs, height=height, find=find
    )
    return MethodAligner(checked)


def checked_fit(found: Any, n_pairs: int) -> Fit | Undetermined:
    """Return the answer of `find` with plain arrays; raise InvalidAnswerError if it is invalid."""
    _require_type("returned", found, Fit, Undetermined)
    if isinstance(found, Undetermined):
        has_reason = isinstance(found.reason, str) and found.reason.strip()
        _require(has_reason, "Undetermined without a reason")
        return found
    _require_type("refusal is", found.refusal, str)
    _require_type("fitted is", found.fitted, Pairs, type(None))
    T_a_b = _plain_array("T_a_b", found.T_a_b, (3,))
    problem = "T_a_b is not finite, expected Undetermined where there is no motion"
    _require(np.isfinite(T_a_b).all(), problem)
    inlier = _plain_array("inlier", found.inlier, (n_pairs,), "bool")
    n = int(inlier.sum()) if found.fitted is None else len(found.fitted)
    weight = None if found.weight is None else _plain_array("weight", found.weight, (n,))
    _require(weight is None or not (weight < 0).any(), "weight is negative")
    gain = None if found.gain is None else _plain_array("gain", found.gain, (n, 3, 2))
    return replace(found, T_a_b=T_a_b, inlier=inlier, weight=weight, gain=gain)


def checked_alignment(answer: Any, n_correspondences: int, elapsed_s: float) -> Alignment:
    """Return the answer of `align` with plain arrays; raise InvalidAnswerError if it is invalid."""
    _require_type("returned", answer, Alignment)
    status, reason, drift_sigma_m = answer.status, answer.reason, answer.drift_sigma_m
    _require(status in _STATUSES, f"status is {status!r:.40}, expected {' or '.join(_STATUSES)}")
    status, accepted = Status(status), status == Status.ACCEPTED
    _require_type("reason is", reason, str)
    _require(accepted or reason.strip(), f"{status} without a reason")
    _require_type("drift_sigma_m is", drift_sigma_m, float, np.floating)
    drift_sigma_m = float(drift_sigma_m)
    valid = 0 <= drift_sigma_m < math.inf or (math.isnan(drift_sigma_m) and not accepted)
    _require(valid, f"drift_sigma_m is {drift_sigma_m:g} m, but {status}")
    T_a_b = _plain_array("T_a_b", answer.T_a_b, (3,))
    covariance = _plain_array("covariance", answer.covariance, (3, 3))
    inlier = _plain_array("inlier", answer.inlier, (n_correspondences,), "bool")
    if status is Status.DEGENERATE:
        _require(np.isnan(T_a_b).all(), "T_a_b is not NaN, but degenerate")
    else:
        _require(np.isfinite(T_a_b).all(), f"T_a_b is not finite, but {status}")
        _require(abs(T_a_b[2]) <= math.pi, f"theta is {T_a_b[2]:g} rad, expected -pi to pi")
    if accepted or not np.isnan(covariance).all():
        _require(np.isfinite(covariance).all(), "covariance is not finite")
        largest, asymmetry = np.abs(covariance).max(), np.abs(covariance - covariance.T).max()
        _require(asymmetry <= _MAX_ASYMMETRY * largest, "covariance is not symmetric")
        smallest = np.linalg.eigvalsh((covariance + covariance.T) / 2)[0]
        _require(smallest >= _MIN_EIGENVALUE * largest, "covariance has a negative variance")
    reason = one_line(str(reason))
    return Alignment(T_a_b, covariance, inlier, elapsed_s, status, reason, drift_sigma_m)


def alignment_to_json(alignment: Alignment) -> dict[str, Any]:
    """Return the fields of an alignment as JSON values."""
    arrays = {name: getattr(alignment, name).tolist() for name in ("T_a_b", "covariance", "inlier")}
    return vars(alignment) | arrays


def alignment_from_json(answer: dict[str, Any], n_correspondences: int) -> Alignment:
    """Return the alignment, or a failed one if the values hold an `error`; raise if invalid."""
    if "error" in answer:
        return without_answer(Status.FAILED, one_line(str(answer["error"])), n_correspondences)
    types = {"T_a_b": float, "covariance": float, "inlier": bool}
    arrays: dict[str, Any] = {name: np.array(answer[name], types[name]) for name in types}
    alignment = Alignment(**(answer | arrays))
    return checked_alignment(alignment, n_correspondences, float(alignment.elapsed_s))


def _require(condition: Any, problem: str) -> None:
    if not condition:
        raise InvalidAnswerError(problem)


def _require_type(name: str, value: Any, *types: type) -> None:
    expected = " or ".join("None" if each is type(None) else each.__name__ for each in types)
    _require(isinstance(value, types), f"{name} {type(value).__name__}, expected {expected}")


def _plain_array(name: str, values: Any, shape: tuple[int, ...], of: str = "float") -> np.ndarray:
    """Return a float64 or bool copy; raise InvalidAnswerError for a subclass such as masked."""
    expected, is_array = f"an array {shape} of {of}", type(values) is np.ndarray
    _require(is_array, f"{name} is {type(values).__name__}, expected {expected}")
    fits = values.shape == shape and values.dtype.kind == of[0]
    _require(fits, f"{name} is an array {values.shape} of {values.dtype}, expected {expected}")
    with np.errstate(over="ignore"):  # extended precision may overflow to infinity
        return np.array(values, dtype=of)
