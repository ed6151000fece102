"""The process in which one method from outside runs; `experiments.methods.aligner_calls` starts it.

Nothing is taken on trust: every answer is checked and copied here, so nothing of the plug-in's
making reaches the other side. The maps are unpacked afresh for each call: whatever it does to them,
the next call sees them as they were.
"""

import faulthandler
import math
import os
import pickle
import sys
import threading
import time
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from experiments.methods.catalogue import make_method
from experiments.methods.threads import single_threaded
from mapfusion.align.method import Fit, Needs, Undetermined
from mapfusion.align.pairs import Pairs
from mapfusion.align.registration import Aligner, MethodAligner
from mapfusion.align.result import Alignment, Status, without_answer

# Past the limit this process ends even when the plug-in holds the interpreter's lock and the one
# who should have ended it is gone.
_GRACE_S = 10.0
_ANSWERS = (Status.ACCEPTED, Status.REFUSED, Status.DEGENERATE)
_ASYMMETRY = 1e-9  # relative: more than rounding leaves of a symmetric product
_TEXT_LENGTH = 200  # of what a plug-in says about itself in a table
_LEAST_EIGENVALUE = -1e-9  # relative to the largest: rounding of a singular covariance


def main(connection_fd: int, lifeline_fd: int) -> None:
    """Answer requests until the other side goes away."""
    threading.Thread(target=_end_with, args=(lifeline_fd,), daemon=True).start()
    _silence()
    connection = Connection(connection_fd)
    served = _Served()
    while True:
        try:
            request, *details, limit_s = connection.recv()
        except EOFError:
            return
        faulthandler.dump_traceback_later(limit_s + _GRACE_S, exit=True, file=2)
        answer = getattr(served, request)(*details)
        faulthandler.cancel_dump_traceback_later()
        connection.send(answer)


def _end_with(lifeline_fd: int) -> None:
    """End with the process that holds the lifeline's other end, also while the plug-in works."""
    os.read(lifeline_fd, 1)
    os._exit(1)


def _silence() -> None:
    """What plug-ins print, in Python or C++, would tear the tables and bars of the command."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)


class _Served:
    """The aligner; each method is a request."""

    aligner: Aligner
    maps: bytes

    def make(self, name: str, parameters: dict[str, Any]) -> bool | str:
        """Whether it is randomised, or why it could not be made."""
        try:
            self.aligner = _checked_aligner(make_method(name, **parameters))
        except ValueError as error:
            return _shortened(str(error))
        except BaseException as error:  # also SystemExit: it must not end this process
            return _told(error)
        single_threaded()  # after the import, which may have brought more libraries
        return self.aligner.randomised

    def align(self, maps: bytes | None, rng: np.random.Generator) -> Alignment:
        """The checked answer for new maps, or (None) for those of the last call."""
        self.maps = maps or self.maps
        map_a, map_b, correspondences = pickle.loads(self.maps)  # noqa: S301  # ours
        n = len(correspondences)
        started_s = time.perf_counter()
        try:
            answer = self.aligner.align(map_a, map_b, correspondences, rng)
        except BaseException as error:
            return without_answer(Status.FAILED, _told(error), n)
        elapsed_s = time.perf_counter() - started_s
        try:
            return _checked_answer(answer, n, elapsed_s)
        except BaseException as error:  # also an answer whose very attributes raise
            unread = "" if isinstance(error, NonsenseError) else "answer cannot be read: "
            return without_answer(Status.FAILED, unread + _told(error), n)


class NonsenseError(Exception):
    """A method, or its answer, is none; the text says what is wrong with it."""


def _checked_aligner(method: Any) -> Aligner:
    """The aligner around a method from outside; raises NonsenseError where it is none."""
    _require_type("randomised is", getattr(method, "randomised", None), "a bool", bool)
    if callable(getattr(method, "align", None)):
        return method
    if not callable(getattr(method, "find", None)):
        raise NonsenseError("has neither a method find nor a method align")
    _require_type("needs is", getattr(method, "needs", None), "Needs", Needs, type(None))
    return MethodAligner(_CheckedMethod(method))  # type: ignore[arg-type]


@dataclass(frozen=True)
class _CheckedMethod:
    method: Any

    def __getattr__(self, name: str) -> Any:
        return getattr(self.method, name)

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """What the method finds; raises NonsenseError where that is no answer."""
        found = self.method.find(pairs, rng)
        if isinstance(found, Undetermined):
            told = isinstance(found.reason, str) and found.reason.strip()
            _require(told, "Undetermined without a reason")
            return found
        _require_type("returned", found, "Fit or Undetermined", Fit)
        _require_type("refusal is", found.refusal, "str", str)
        _require_array("T_a_b", found.T_a_b, (3,))
        _require_array("inlier", found.inlier, (len(pairs),), "bool")
        no_motion = "T_a_b is not finite, expected Undetermined where there is no motion"
        _require(np.isfinite(found.T_a_b).all(), no_motion)
        _require_type("fitted is", found.fitted, "Pairs", Pairs, type(None))
        n = int(found.inlier.sum()) if found.fitted is None else len(found.fitted)
        if found.weight is not None:
            _require_array("weight", found.weight, (n,))
        if found.gain is not None:
            _require_array("gain", found.gain, (n, 3, 2))
        return found


def _checked_answer(answer: Any, n_correspondences: int, elapsed_s: float) -> Alignment:
    """An aligner's answer about this many correspondences, in arrays and texts of our own making.

    A motion is finite with theta in [-pi, pi], or NaN when degenerate; an accepted one has a
    covariance, symmetric and without negative variances; what was not accepted says why.
    NonsenseError says what else it is.
    """
    _require_type("returned", answer, "Alignment", Alignment)
    status, accepted = answer.status, answer.status is Status.ACCEPTED
    expected = f"expected one of {', '.join(_ANSWERS)}"
    _require(status in _ANSWERS, f"status is {status!r:.40}, {expected}")
    _require_type("reason is", answer.reason, "str", str)
    _require(accepted or answer.reason.strip(), f"{status} without a reason")
    _require_type("drift_sigma_m is", answer.drift_sigma_m, "float", float, np.floating)
    _require_array("T_a_b", answer.T_a_b, (3,))
    _require_array("covariance", answer.covariance, (3, 3))
    _require_array("inlier", answer.inlier, (n_correspondences,), "bool")
    T_a_b, covariance = (np.array(x, dtype="f8") for x in (answer.T_a_b, answer.covariance))
    if status is Status.DEGENERATE:
        _require(np.isnan(T_a_b).all(), "T_a_b is not NaN, but degenerate")
    else:
        _require(np.isfinite(T_a_b).all(), f"T_a_b is not finite, but {status}")
        _require(abs(T_a_b[2]) <= math.pi, f"theta is {T_a_b[2]:g} rad, expected -pi to pi")
    if accepted or not np.isnan(covariance).all():
        _require(np.isfinite(covariance).all(), "covariance is not finite")
        largest, symmetric = np.abs(covariance).max(), (covariance + covariance.T) / 2
        asymmetry = np.abs(covariance - covariance.T).max()
        _require(asymmetry <= _ASYMMETRY * largest, "covariance is not symmetric")
        least = np.linalg.eigvalsh(symmetric)[0]
        _require(least >= _LEAST_EIGENVALUE * largest, "covariance has a negative variance")
    inlier = np.array(answer.inlier, dtype=bool)
    reason, drift_sigma_m = _shortened(answer.reason), float(answer.drift_sigma_m)
    return Alignment(T_a_b, covariance, inlier, elapsed_s, Status(status), reason, drift_sigma_m)


def _require(holds: Any, wrong: str) -> None:
    if not holds:
        raise NonsenseError(wrong)


def _require_type(what: str, value: Any, expected: str, *types: type) -> None:
    _require(isinstance(value, types), f"{what} {type(value).__name__}, expected {expected}")


def _require_array(name: str, values: Any, shape: tuple[int, ...], of: str = "float") -> None:
    expected = f"an array {shape} of {of}"
    _require_type(f"{name} is", values, expected, np.ndarray)
    fits = values.shape == shape and values.dtype.kind == of[0]
    _require(fits, f"{name} is an array {values.shape} of {values.dtype}, expected {expected}")


def _told(error: BaseException) -> str:
    """What was raised, and in which line of which file; no paths, which differ by machine."""
    try:
        text = str(error)
    except BaseException:  # a plug-in's error is a plug-in's, too
        text = ""
    if isinstance(error, NonsenseError):
        return _shortened(text)
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return _shortened(f"raised {type(error).__name__}: {text}") + place


def _shortened(text: str) -> str:
    """In one line, no longer than a table can show."""
    line = " ".join(text.split())
    return line if len(line) <= _TEXT_LENGTH else line[: _TEXT_LENGTH - 3] + "..."


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
