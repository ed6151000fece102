"""Whether others' methods and their answers are what they claim: nothing is taken on trust."""

import math
from typing import Any

import numpy as np

from mapfusion.align.correspondences import HeightGate
from mapfusion.align.method import Fit, Needs, Undetermined
from mapfusion.align.pairs import Pairs
from mapfusion.align.registration import Aligner, as_aligner
from mapfusion.align.result import Alignment, Status

_ANSWERS = (Status.ACCEPTED, Status.REFUSED, Status.DEGENERATE)
_ASYMMETRY = 1e-9  # relative: more than rounding leaves of a symmetric product
_LEAST_EIGENVALUE = -1e-9  # relative to the largest: rounding of a singular covariance


class NonsenseError(Exception):
    """A method answered what is no answer; the text says what is wrong with it."""


def why_unusable(method: Any) -> str:
    """Why an object is no method; empty when it is one."""
    randomised = getattr(method, "randomised", None)
    if not isinstance(randomised, bool):
        return f"randomised is {type(randomised).__name__}, expected a bool"
    if not (callable(getattr(method, "align", None)) or callable(getattr(method, "find", None))):
        return "has neither a method find nor a method align"
    needs = getattr(method, "needs", None)
    if needs is not None and not isinstance(needs, Needs) and not hasattr(method, "align"):
        return f"needs is {type(needs).__name__}, expected Needs"
    return ""


def checked(method: Any) -> Aligner:
    """The aligner around a method from outside, whose every `Fit` is looked at first."""
    around: Any = method if hasattr(method, "align") else _CheckedMethod(method)
    return as_aligner(around)


class _CheckedMethod:
    def __init__(self, method: Any) -> None:
        self.randomised: bool = method.randomised
        self.needs: Needs = getattr(method, "needs", None) or Needs()
        height = getattr(method, "height", None)
        self.height = height if isinstance(height, HeightGate) else None
        self._find = method.find

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """What the method finds; raises NonsenseError where that is no answer."""
        found = self._find(pairs, rng)
        wrong = why_no_fit(found, len(pairs))
        if wrong:
            raise NonsenseError(wrong)
        return found


def why_no_fit(found: Any, n_pairs: int) -> str:
    """What is wrong with what a method found among this many pairs; empty for nothing."""
    if isinstance(found, Undetermined):
        told = isinstance(found.reason, str) and found.reason.strip()
        return "" if told else "Undetermined without a reason"
    if not isinstance(found, Fit):
        return f"returned {type(found).__name__}, expected Fit or Undetermined"
    if not isinstance(found.refusal, str):
        return f"refusal is {type(found.refusal).__name__}, expected str"
    wrong = _why_bad_array("T_a_b", found.T_a_b, (3,), "f")
    wrong = wrong or _why_bad_array("inlier", found.inlier, (n_pairs,), "b")
    if wrong:
        return wrong
    if not np.isfinite(found.T_a_b).all():
        return "T_a_b is not finite, expected Undetermined where there is no motion"
    if found.fitted is not None and not isinstance(found.fitted, Pairs):
        return f"fitted is {type(found.fitted).__name__}, expected Pairs"
    n_fitted = int(found.inlier.sum()) if found.fitted is None else len(found.fitted)
    for name, values, shape in (
        ("weight", found.weight, (n_fitted,)),
        ("gain", found.gain, (n_fitted, 3, 2)),
    ):
        if values is not None:
            wrong = wrong or _why_bad_array(name, values, shape, "f")
    return wrong


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
