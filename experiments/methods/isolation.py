"""Aligners of others' making, each in a process of its own: whatever happens there is a result.

A plug-in may raise, hang, end its process or answer nonsense; the answer then is an Alignment with
the status `failed` and a reason, and the next call starts a new process. One process serves one
method with one set of parameters, so that no method's state (OpenCV's generator, static variables
in C++) depends on what other methods ran before it. It lives on from call to call: a start costs
many times what a call does.
"""

import atexit
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.result import Alignment, Status, without_answer
from mapfusion.landmark_map import LandmarkMap

_START_LIMIT_S = 120.0  # imports take a second, many times that from a cold network disk
_END_LIMIT_S = 5.0  # from a broken connection to the end of the process behind it
_MAX_CHILDREN = 4  # kept alive by one process: 200 MB each with the numerical libraries
# A process that has grown by this much is replaced before the next call: KISS-Matcher 1.0.2 keeps
# 53 MB of each call with 5000 pairs for ever.
_MOST_GROWTH_BYTES = 2**30
# A plug-in that always hangs or dies would else cost its limit, or the start of a process, for each
# repetition on each map; the second chance is for a machine that was busy.
_MAX_LOST_ON_MAPS = 2
_MAX_TIME_OUTS = 2  # in a row, on whatever maps
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_MAIN = """
import sys
from experiments.methods.isolated_child import main
main(*map(int, sys.argv[1:]))
"""


class ChildFailedError(Exception):
    """The process gave no answer; the text says why."""


class TimedOutError(ChildFailedError):
    """The process gave no answer in time."""


@dataclass(frozen=True)
class Spec:
    """What a process was started for."""

    method: str
    parameters: str  # JSON


def spec_of(method: str, parameters: dict[str, Any]) -> Spec:
    """The spec; raises ValueError for parameters that a file could not hold."""
    try:
        return Spec(method, json.dumps(parameters, sort_keys=True, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"parameters: {method}: {error}") from error


class Child:
    """A process that holds one aligner."""

    def __init__(self, spec: Spec) -> None:
        """Start it and have the aligner made.

        Raises:
            ChildFailedError: the aligner could not be made.
        """
        self._maps: tuple[object, ...] = ()
        self._connection, theirs = Pipe()
        lifeline, self._lifeline = os.pipe()
        self._process = _start(theirs, lifeline)
        theirs.close()
        os.close(lifeline)
        made = self._ask("make", spec.method, json.loads(spec.parameters), _START_LIMIT_S)
        kind, detail, self._memory_at_start = made
        if kind != "made":
            self.kill()
            raise ChildFailedError(detail)
        self.randomised: bool = detail

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
        limit_s: float,
    ) -> Alignment:
        """The aligner's answer; raises ChildFailedError when there is none."""
        maps = (map_a, map_b, correspondences)
        if not _same(maps, self._maps):
            self._send("maps", pickle.dumps(maps, pickle.HIGHEST_PROTOCOL))
            self._maps = maps  # held, so that another object cannot come to the same identity
        kind, detail, memory_bytes = self._ask("align", rng, limit_s)
        if memory_bytes > self._memory_at_start + _MOST_GROWTH_BYTES:
            self.kill()
        if kind == "failed":
            return without_answer(Status.FAILED, detail, len(correspondences))
        return Alignment(
            np.array(detail["T_a_b"]),
            np.array(detail["covariance"]),
            np.array(detail["inlier"], dtype=bool),
            detail["elapsed_s"],
            Status(detail["status"]),
            detail["reason"],
            detail["drift_sigma_m"],
        )

    def _send(self, *request: Any) -> None:
        try:
            self._connection.send(request)
        except OSError:  # ended between two calls
            raise ChildFailedError(self._why_ended()) from None

    def _ask(self, *request: Any) -> tuple[str, Any, int]:
        """Send a request, whose last entry is its time limit in seconds; returns the answer."""
        limit_s: float = request[-1]
        try:
            self._send(*request)
            if not self._connection.poll(limit_s):
                self.kill()
                raise TimedOutError(f"gave no answer within {limit_s:g} s")
            return self._connection.recv()
        except (EOFError, OSError):
            raise ChildFailedError(self._why_ended()) from None
        except BaseException:  # Ctrl-C too: an answer to this call must not be taken for the next's
            self.kill()
            raise

    def _why_ended(self) -> str:
        """After the connection broke."""
        deadline_s = time.monotonic() + _END_LIMIT_S
        while not (ended := self._has_ended()) and time.monotonic() < deadline_s:
            time.sleep(0.001)
        self.kill()
        code = self._process.returncode
        if not ended:
            return "closed the connection to its process"
        if code < 0:
            return f"ended its process with {signal.Signals(-code).name}"
        return f"ended its process with exit code {code}"

    def _has_ended(self) -> bool:
        """Without collecting its exit code: until then its number is nobody else's."""
        if self._process.returncode is not None:
            return True
        how = os.WEXITED | os.WNOWAIT | os.WNOHANG
        return os.waitid(os.P_PID, self._process.pid, how) is not None

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return not self._connection.closed and not self._has_ended()

    def kill(self) -> None:
        """End the process, and those it started, at once."""
        if self._process.returncode is not None:
            return
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._connection.close()
        os.close(self._lifeline)


def _same(maps: tuple[object, ...], others: tuple[object, ...]) -> bool:
    """Whether they are the very same objects."""
    return bool(others) and all(a is b for a, b in zip(maps, others, strict=True))


def _start(connection: Connection, lifeline: int) -> subprocess.Popen:
    environment = os.environ | _ONE_THREAD | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    descriptors = (connection.fileno(), lifeline)
    return subprocess.Popen(  # noqa: S603  # our own interpreter and module
        [sys.executable, "-c", _MAIN, *map(str, descriptors)],
        env=environment,
        pass_fds=descriptors,
        stdin=subprocess.DEVNULL,
        # not our process group: Ctrl-C is for this process to act on, and what a plug-in started
        # can be ended with it
        start_new_session=True,
    )


_children: OrderedDict[Spec, Child] = OrderedDict()
# held for a whole call: a process answers one caller at a time, and none ends under another's call
_one_at_a_time = threading.RLock()


def child_for(spec: Spec) -> Child:
    """The living process for a spec, started where there is none; the one unused longest ends.

    Raises:
        ChildFailedError: the aligner could not be made.
    """
    with _one_at_a_time:
        child = _children.pop(spec, None)
        if child is None or not child.alive:
            if child is not None:
                child.kill()
            child = Child(spec)
        _children[spec] = child
        while len(_children) > _MAX_CHILDREN:
            _children.popitem(last=False)[1].kill()
        return child


@atexit.register
def end_children() -> None:
    """End all processes; a later call starts new ones."""
    with _one_at_a_time:
        while _children:
            _children.popitem()[1].kill()


class IsolatedAligner:
    """An aligner by name that runs in a process of its own.

    Args:
        method: its name.
        parameters: JSON-able.
        time_limit_s: most for one call, by the clock on the wall.
    """

    def __init__(self, method: str, parameters: dict[str, Any], time_limit_s: float) -> None:
        self._spec = spec_of(method, parameters)
        self._time_limit_s = time_limit_s
        self._time_outs = 0
        self._lost_on: tuple[object, ...] = ()  # maps
        self._lost = 0
        self._reason = ""

    @property
    def randomised(self) -> bool:
        """Whether another generator can give another answer; False where it cannot be made."""
        try:
            return child_for(self._spec).randomised
        except ChildFailedError:
            return False

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b; whatever goes wrong is an answer with the status `failed`.

        After two calls that lost the process on the same maps it is not called on them again, after
        two time-outs in a row on none.
        """
        n = len(correspondences)
        maps = (map_a, map_b, correspondences)
        if not _same(maps, self._lost_on):
            self._lost_on, self._lost = maps, 0
        if self._lost == _MAX_LOST_ON_MAPS or self._time_outs == _MAX_TIME_OUTS:
            return without_answer(Status.FAILED, f"not called again: {self._reason}", n)
        try:
            with _one_at_a_time:
                child = child_for(self._spec)
                found = child.align(*maps, rng, self._time_limit_s)
        except ChildFailedError as error:
            self._lost += 1
            self._time_outs = self._time_outs + 1 if isinstance(error, TimedOutError) else 0
            self._reason = str(error)
            return without_answer(Status.FAILED, self._reason, n)
        self._time_outs = self._lost = 0
        return found
