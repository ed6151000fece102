"""Isolated processes that run plug-ins and peers, and validation of their answers.

A plug-in may raise, hang, end its process or return an invalid answer. Each of these becomes a
failed alignment with a reason, and the next call starts a new process if necessary. A process runs
one method with one set of parameters, so that static state of a library (OpenCV's generator,
variables of C++) does not depend on other methods. It serves many calls because a start takes much
longer than a call. Requests are pickles; answers are JSON, because unpickling runs any code.

An answer is validated in the process of the plug-in and again by the process that reads it, because
a plug-in may change any library in its own process.
"""

import functools
import json
import math
import os
import pickle
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mapfusion.align.aligners import Aligner, MethodAligner
from mapfusion.align.alignment import (
    Alignment,
    Fit,
    Needs,
    Pairs,
    Status,
    Undetermined,
    without_answer,
)
from mapfusion.align.correspondences import Correspondences
from mapfusion.errors import one_line
from mapfusion.landmark_map import LandmarkMap

_STATUSES = (Status.ACCEPTED, Status.REFUSED, Status.DEGENERATE)
_MAX_ASYMMETRY = 1e-9  # relative to the largest entry: rounding of a symmetric product
_MIN_EIGENVALUE = -1e-9  # relative to the largest entry: rounding of a singular covariance


class InvalidAnswerError(Exception):
    """A method or its answer does not follow the interface; the text says where."""


def checked_aligner(method: Any) -> Aligner:
    """Return the aligner of a plug-in's method; raise InvalidAnswerError if it is not a method."""
    has_align, has_find = (callable(getattr(method, name, None)) for name in ("align", "find"))
    lacking = "has no method `find(self, pairs, rng)`, which returns a Fit or an Undetermined "
    lacking += (
        "(nor `align(self, map_a, map_b, correspondences, rng)`); see `mapfusion docs plugins`"
    )
    _require(has_align or has_find, lacking)
    told = hasattr(method, "randomised")
    _require(told, "has no attribute `randomised`: set it to True if it uses `rng`, else to False")
    _require_type("randomised is", method.randomised, bool)
    if has_align:
        return method
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
    reason, lower_bound = one_line(str(reason)), bool(answer.lower_bound)
    outcome = (status, reason, drift_sigma_m, lower_bound)
    return Alignment(T_a_b, covariance, inlier, elapsed_s, *outcome)


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


_START_LIMIT_S = 120.0  # imports take about a second, much longer from a cold network disk
_END_LIMIT_S = 5.0  # from the end of a connection to the end of its process
_MAX_PROCESSES = 4  # of each worker; numerical libraries take 200 MB in each
_MAX_ANSWER_BYTES = 2**26  # enough for ten million correspondences
# A process that has grown by this much is replaced: KISS-Matcher 1.0.2 leaks 53 MB in each call
# with 5000 pairs.
_MAX_GROWTH_BYTES = 2**30
# A call that loses the process costs the time limit or a start of the process. The second one is
# for a machine that was busy.
_MAX_LOST_ON_MAPS = 2
_MAX_TIME_OUTS = 2  # in a row, on any maps
_ONE_THREAD = dict.fromkeys(  # the order of sums depends on the number of threads
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)

Maps = tuple[LandmarkMap, LandmarkMap, Correspondences]


class ProcessFailedError(Exception):
    """The process gave no valid answer; the text says why."""


class TimedOutError(ProcessFailedError):
    """The process gave no answer within the time limit."""


class IsolatedProcess:
    """Process that runs a method with parameters (JSON); it is started again after it ended."""

    def __init__(self, method: str, parameters: str) -> None:
        self._make = ("make", method, json.loads(parameters))
        self._lock = threading.Lock()
        self._start()

    @property
    def alive(self) -> bool:
        """True if the process is ready for a request."""
        return self.end.alive and self._process.poll() is None

    def align(self, maps: Maps, rng: np.random.Generator, limit_s: float) -> Alignment:
        """Return the answer of the method; raise ProcessFailedError if there is none.

        The maps are sent again only if they are another object than in the last call.
        """
        with self._lock:
            if not self.alive:
                self.end()
                self._start()
            sent = None if maps is self._maps else pickle.dumps(maps, pickle.HIGHEST_PROTOCOL)
            self._maps = maps
            read = functools.partial(alignment_from_json, n_correspondences=len(maps[2]))
            alignment = self._ask(read, limit_s, "align", sent, rng)
            if self._memory_bytes() > self._memory_at_start_bytes + _MAX_GROWTH_BYTES:
                self.end()
            return alignment

    def _start(self) -> None:
        self._maps: Maps | None = None
        self._socket, other_end = socket.socketpair()
        path = os.pathsep.join(map(os.path.abspath, sys.path))
        with other_end:
            fd = other_end.fileno()
            try:
                self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and module
                    # -P: files in the working folder must not hide the standard library
                    [sys.executable, "-P", "-m", "experiments.plugins.process_main", str(fd)],
                    env=os.environ | _ONE_THREAD | {"PYTHONPATH": path},
                    pass_fds=[fd],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C does not reach it; `_end` ends its children
                )
            except OSError as error:
                raise ProcessFailedError(f"cannot start a process: {error.strerror}") from None
        # Called on failure, when this object is no longer referenced, and at exit.
        self.end = weakref.finalize(self, _end, self._process, self._socket)
        made = self._ask(dict, _START_LIMIT_S, *self._make)
        if not isinstance(made.get("randomised"), bool):
            self.end()
            raise ProcessFailedError(one_line(str(made.get("error", "sent an invalid answer"))))
        self.randomised: bool = made["randomised"]
        self._memory_at_start_bytes = self._memory_bytes()

    def _ask(self, read: Callable[[dict[str, Any]], Any], limit_s: float, *request: Any) -> Any:
        """Return what `read` makes of the answer to a request; end the process on failure."""
        # The answer repeats the token: an answer to an earlier request is not taken for this one.
        token, deadline_s, line = secrets.token_hex(), time.monotonic() + limit_s, b""
        packed = pickle.dumps((token, limit_s, *request), pickle.HIGHEST_PROTOCOL)
        try:
            self._socket.settimeout(limit_s)
            self._socket.sendall(packed)
            while not line.endswith(b"\n"):
                self._socket.settimeout(max(deadline_s - time.monotonic(), 1e-6))
                part = self._socket.recv(2**20)
                line += part
                if not part:
                    raise EOFError
                if len(line) > _MAX_ANSWER_BYTES:
                    raise ValueError("it is too long")
            answer = json.loads(line)
            if answer.pop("token") != token:
                raise ValueError("it does not belong to the request")
            return read(answer)
        except TimeoutError:
            failure = TimedOutError(f"gave no answer within {limit_s:g} s")
        except (EOFError, OSError):
            try:
                code = self._process.wait(_END_LIMIT_S)
                # signals without a name in Python: real-time signals
                names = {-known.value: known.name for known in signal.Signals}
                cause = f"exit code {code}" if code >= 0 else names.get(code, f"signal {-code}")
                failure = ProcessFailedError(f"ended its process with {cause}")
            except subprocess.TimeoutExpired:
                failure = ProcessFailedError("closed the connection to its process")
        except Exception as error:
            failure = ProcessFailedError(f"sent an invalid answer: {one_line(str(error))}")
        except BaseException:  # Ctrl-C
            self.end()
            raise
        self.end()
        raise failure

    def _memory_bytes(self) -> int:
        """Return the resident memory of the process, 0 if the system does not tell."""
        try:
            statm = Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii")
        except OSError:
            return 0
        return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _end(process: subprocess.Popen, connection: socket.socket) -> None:
    """End a process and those that it started."""
    connection.close()
    with suppress(ProcessLookupError):  # while a process of the group lives, its number is not free
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@functools.lru_cache(_MAX_PROCESSES)
def process_for(method: str, parameters: str) -> IsolatedProcess:
    """Return the process of a method with parameters (JSON).

    Raises:
        ProcessFailedError: the method cannot be constructed.
    """
    return IsolatedProcess(method, parameters)


def end_children() -> None:
    """End all processes; a later call starts new ones."""
    process_for.cache_clear()


class IsolatedAligner:
    """Aligner that calls a method in an isolated process.

    Args:
        method: name of the method.
        parameters: its parameters as JSON.
        time_limit_s: wall-clock limit of each call.
        absence: why the method cannot run; empty if it can.
    """

    def __init__(
        self, method: str, parameters: str, time_limit_s: float, absence: str = ""
    ) -> None:
        self._method, self._parameters = method, parameters
        self._time_limit_s, self._absence = time_limit_s, absence
        self._maps: Maps | None = None
        self._lost_on_maps = self._time_outs = 0
        self._last_failure = ""

    @property
    def randomised(self) -> bool:
        """True if the answer depends on the generator; False if the method cannot be made."""
        try:
            return not self._absence and process_for(self._method, self._parameters).randomised
        except ProcessFailedError:
            return False

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b; the status is `failed` or `absent` if there is no answer.

        The method is not called again on the same maps after it lost its process twice on them, and
        on no maps after two time-outs in a row.
        """
        maps, n = (map_a, map_b, correspondences), len(correspondences)
        if self._absence:
            return without_answer(Status.ABSENT, self._absence, n)
        if self._maps is None or any(a is not b for a, b in zip(maps, self._maps, strict=True)):
            self._maps, self._lost_on_maps = maps, 0
        if self._lost_on_maps == _MAX_LOST_ON_MAPS or self._time_outs == _MAX_TIME_OUTS:
            return without_answer(Status.FAILED, f"not called again: {self._last_failure}", n)
        try:
            process = process_for(self._method, self._parameters)
            alignment = process.align(self._maps, rng, self._time_limit_s)
        except ProcessFailedError as error:
            self._lost_on_maps += 1
            self._time_outs = self._time_outs + 1 if isinstance(error, TimedOutError) else 0
            self._last_failure = str(error)
            return without_answer(Status.FAILED, self._last_failure, n)
        self._time_outs = self._lost_on_maps = 0
        return alignment
