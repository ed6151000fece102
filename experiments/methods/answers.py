"""What an answer from outside must be, how it is written down, and how it is read again.

It is judged twice: in the plug-in's process, where it may have changed any library, and by the one
who asked. Between the two it is JSON.
"""

import json
import math
from typing import Any

import numpy as np

from mapfusion.align.alignment import Alignment, Status, without_answer
from mapfusion.errors import one_line

_ANSWERS = (Status.ACCEPTED, Status.REFUSED, Status.DEGENERATE)
_ASYMMETRY = 1e-9  # relative: more than rounding leaves of a symmetric product
_LEAST_EIGENVALUE = -1e-9  # relative to the largest: rounding of a singular covariance


class NonsenseError(Exception):
    """A method, or its answer, is none; the text says what is wrong with it."""


def checked_answer(answer: Any, n_correspondences: int, elapsed_s: float) -> Alignment:
    """An aligner's answer about this many correspondences, in arrays and texts of our own making.

    A motion is finite with theta in [-pi, pi], or NaN when degenerate; an accepted one has a
    drift and a covariance, symmetric and without negative variances; what was not accepted says
    why. NonsenseError says what else it is.
    """
    require_type("returned", answer, "Alignment", Alignment)
    status, reason, drift = answer.status, answer.reason, answer.drift_sigma_m
    expected = f"expected one of {', '.join(_ANSWERS)}"
    require(status in _ANSWERS, f"status is {status!r:.40}, {expected}")
    status, accepted = Status(status), status == Status.ACCEPTED
    require_type("reason is", reason, "str", str)
    require(accepted or reason.strip(), f"{status} without a reason")
    require_type("drift_sigma_m is", drift, "float", float, np.floating)
    drift_sigma_m = float(drift)
    known = 0 <= drift_sigma_m < math.inf or (math.isnan(drift_sigma_m) and not accepted)
    require(known, f"drift_sigma_m is {drift_sigma_m:g} m, but {status}")
    T_a_b = array("T_a_b", answer.T_a_b, (3,))
    covariance = array("covariance", answer.covariance, (3, 3))
    inlier = array("inlier", answer.inlier, (n_correspondences,), "bool")
    if status is Status.DEGENERATE:
        require(np.isnan(T_a_b).all(), "T_a_b is not NaN, but degenerate")
    else:
        require(np.isfinite(T_a_b).all(), f"T_a_b is not finite, but {status}")
        require(abs(T_a_b[2]) <= math.pi, f"theta is {T_a_b[2]:g} rad, expected -pi to pi")
    if accepted or not np.isnan(covariance).all():
        _require_covariance(covariance)
    reason = one_line(str(reason))
    return Alignment(T_a_b, covariance, inlier, elapsed_s, status, reason, drift_sigma_m)


def _require_covariance(values: np.ndarray) -> None:
    require(np.isfinite(values).all(), "covariance is not finite")
    largest, symmetric = np.abs(values).max(), (values + values.T) / 2
    asymmetry = np.abs(values - values.T).max()
    require(asymmetry <= _ASYMMETRY * largest, "covariance is not symmetric")
    least = np.linalg.eigvalsh(symmetric)[0]
    require(least >= _LEAST_EIGENVALUE * largest, "covariance has a negative variance")


def require(holds: Any, wrong: str) -> None:
    """Raise NonsenseError, which says what is wrong, unless it holds."""
    if not holds:
        raise NonsenseError(wrong)


def require_type(what: str, value: Any, expected: str, *types: type) -> None:
    """Raise NonsenseError unless a value is of one of the types."""
    require(isinstance(value, types), f"{what} {type(value).__name__}, expected {expected}")


def array(name: str, values: Any, shape: tuple[int, ...], of: str = "float") -> np.ndarray:
    """A copy as plain float64 or bool; raises NonsenseError for what is no plain array of these.

    Masked arrays and others that behave as they like are none; a longdouble may become infinite.
    """
    expected = f"an array {shape} of {of}"
    require(type(values) is np.ndarray, f"{name} is {type(values).__name__}, expected {expected}")
    fits = values.shape == shape and values.dtype.kind == of[0]
    require(fits, f"{name} is an array {values.shape} of {values.dtype}, expected {expected}")
    with np.errstate(over="ignore"):
        return np.array(values, dtype=of)


def written(answer: Alignment) -> str:
    """An alignment, or what is said in place of one, as `read` understands it."""
    numbers = {"T_a_b": answer.T_a_b.tolist(), "covariance": answer.covariance.tolist()}
    bits = {"inlier": np.packbits(answer.inlier).tobytes().hex(), "status": answer.status}
    spoken = {"reason": answer.reason, "drift_sigma_m": answer.drift_sigma_m}
    return json.dumps(numbers | bits | spoken | {"elapsed_s": answer.elapsed_s})


def read(text: bytes, n_correspondences: int) -> Alignment:
    """An answer about this many correspondences; NonsenseError where it is none."""
    said = json.loads(text)
    if said["status"] == Status.FAILED:
        return without_answer(Status.FAILED, one_line(str(said["reason"])), n_correspondences)
    bits = np.frombuffer(bytes.fromhex(said["inlier"]), np.uint8)
    said["inlier"] = np.unpackbits(bits, count=n_correspondences).astype(bool)
    said |= {name: np.array(said[name], dtype=float) for name in ("T_a_b", "covariance")}
    return checked_answer(Alignment(**said), n_correspondences, float(said["elapsed_s"]))
