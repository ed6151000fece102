"""How the harness calls a method: our own in place, others' in a process of their own.

A plug-in may raise, hang, end its process or answer nonsense: whatever happens there is a result,
and the next call starts a new process. One process serves one method with one set of parameters, so
that no method's state (OpenCV's generator, static variables in C++) depends on what other methods
ran before it. It lives on from call to call: a start costs many times what a call does.
"""

import atexit
import functools
import json
import operator
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.methods.answers import read
from experiments.methods.catalogue import Kind, KnownMethod, find_method, make_method
from experiments.methods.channel import Channel, GarbledError
from mapfusion.align.alignment import Alignment, Status, without_answer
from mapfusion.align.correspondences import Correspondences
from mapfusion.errors import one_line
from mapfusion.landmark_map import LandmarkMap
from mapfusion.registration import Aligner, as_aligner

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

Maps = tuple[LandmarkMap, LandmarkMap, Correspondences]


class ChildFailedError(Exception):
    """The process gave no answer; the text says why."""


class TimedOutError(ChildFailedError):
    """It gave none in time."""


@dataclass(frozen=True)
class Spec:
    """What a process was started for."""

    method: str
    parameters: str  # JSON

    @classmethod
    def of(cls, method: str, parameters: dict[str, Any]) -> "Spec":
        """The spec; raises ValueError for parameters that a file could not hold."""
        try:
            return cls(method, json.dumps(parameters, sort_keys=True, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise ValueError(f"parameters: {method}: {error}") from error


class Child:
    """A process that holds one aligner."""

    def __init__(self, spec: Spec) -> None:
        """Start it; raises ChildFailedError where the aligner could not be made."""
        self._maps: Maps | None = None
        ours, theirs = socket.socketpair()
        self._channel = Channel(ours)
        lifeline, self._lifeline = os.pipe()
        descriptors = (theirs.fileno(), lifeline)
        path = os.pathsep.join(filter(None, sys.path))
        self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and module
            [sys.executable, "-m", "experiments.methods.isolated_child", *map(str, descriptors)],
            env=os.environ | _ONE_THREAD | {"PYTHONPATH": path},
            pass_fds=descriptors,
            stdin=subprocess.DEVNULL,
            # not our process group: Ctrl-C is for this process to act on, and what a plug-in
            # started can be ended with it
            start_new_session=True,
        )
        theirs.close()
        os.close(lifeline)
        request = ("make", spec.method, json.loads(spec.parameters), _START_LIMIT_S)
        made = self._understood(json.loads, self._ask(*request))
        if not isinstance(made, bool):
            self.kill()
            raise ChildFailedError(one_line(str(made)))
        self.randomised = made
        self._memory_at_start = self._memory_bytes()

    def align(self, maps: Maps, rng: np.random.Generator, limit_s: float) -> Alignment:
        """The aligner's answer; raises ChildFailedError when there is none.

        Maps are sent unless they are the tuple of the call before.
        """
        known = maps is self._maps
        sent = None if known else pickle.dumps(maps, pickle.HIGHEST_PROTOCOL)
        self._maps = maps
        answer = self._ask("align", sent, rng, limit_s)
        if self._memory_bytes() > self._memory_at_start + _MOST_GROWTH_BYTES:
            self.kill()
        return self._understood(read, answer, len(maps[2]))

    def _understood(self, reader: Callable[..., Any], *answer: Any) -> Any:
        try:
            return reader(*answer)
        except Exception as error:  # its libraries are no longer as they were
            self.kill()
            raise ChildFailedError(f"answered nonsense: {one_line(str(error))}") from None

    def _ask(self, *request: Any) -> bytes:
        """The answer to a request, whose last entry is its time limit in seconds."""
        limit_s: float = request[-1]
        try:
            return self._channel.ask(pickle.dumps(request, pickle.HIGHEST_PROTOCOL), limit_s)
        except TimeoutError:
            self.kill()
            raise TimedOutError(f"gave no answer within {limit_s:g} s") from None
        except GarbledError:
            self.kill()
            raise ChildFailedError("wrote into the connection to its process") from None
        except (EOFError, OSError):
            raise ChildFailedError(self._why_ended()) from None
        except BaseException:  # Ctrl-C too: an answer to this call must not be taken for the next's
            self.kill()
            raise

    def _memory_bytes(self) -> int:
        """What the process holds; 0 where the system does not tell."""
        try:
            statm = Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii")
            return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except OSError:
            return 0

    def _why_ended(self) -> str:
        """After the connection broke."""
        deadline_s = time.monotonic() + _END_LIMIT_S
        while not (ended := self._has_ended()) and time.monotonic() < deadline_s:
            time.sleep(0.001)
        self.kill()
        code = self._process.returncode
        if not ended:
            return "closed the connection to its process"
        return f"ended its process with {_signal_name(-code) if code < 0 else f'exit code {code}'}"

    def _has_ended(self) -> bool:
        """Without collecting its exit code: until then its number is nobody else's."""
        if self._process.returncode is not None:
            return True
        how = os.WEXITED | os.WNOWAIT | os.WNOHANG
        return os.waitid(os.P_PID, self._process.pid, how) is not None

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return not self._channel.closed and not self._has_ended()

    def kill(self) -> None:
        """End the process, and those it started, at once."""
        if self._process.returncode is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._channel.close()
            os.close(self._lifeline)


def _signal_name(number: int) -> str:
    """Also of those between SIGRTMIN and SIGRTMAX, which have numbers alone."""
    names = {each.value: each.name for each in signal.Signals}
    return names.get(number, f"signal {number}")


_children: OrderedDict[Spec, Child] = OrderedDict()
# held for a whole call: a process answers one caller at a time, and none ends under another's call
_one_at_a_time = threading.RLock()


def child_for(spec: Spec) -> Child:
    """The living process for a spec, started where there is none; the one unused longest ends."""
    with _one_at_a_time:
        child = _children.pop(spec, None)
        if child is not None and not child.alive:
            child.kill()
            child = None
        child = _children[spec] = child or Child(spec)
        while len(_children) > _MAX_CHILDREN:
            _children.popitem(last=False)[1].kill()
        return child


@atexit.register
def end_children() -> None:
    """End all processes; a later call starts new ones."""
    with _one_at_a_time:
        while _children:
            _children.popitem()[1].kill()


class OutsideAligner:
    """A method from outside, in a process of its own: what goes wrong there is an answer, too."""

    def __init__(self, method: KnownMethod, spec: Spec, time_limit_s: float) -> None:
        self._absence = method.absence
        self._spec = spec
        self._time_limit_s = time_limit_s  # of one call, by the clock on the wall
        self._time_outs = self._lost = 0  # in a row; on these maps
        self._maps: Maps | None = None
        self._reason = ""

    @property
    def randomised(self) -> bool:
        """Whether another generator can give another answer; False where it cannot be made."""
        try:
            return not self._absence and child_for(self._spec).randomised
        except ChildFailedError:
            return False

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b; `failed` or `absent` where there is no answer.

        After two calls that lost the process on the same maps it is not called on them again, after
        two time-outs in a row on none.
        """
        n = len(correspondences)
        if self._absence:
            return without_answer(Status.ABSENT, self._absence, n)
        maps = (map_a, map_b, correspondences)
        if self._maps is None or not all(map(operator.is_, maps, self._maps)):
            self._maps, self._lost = maps, 0
        if self._lost == _MAX_LOST_ON_MAPS or self._time_outs == _MAX_TIME_OUTS:
            return without_answer(Status.FAILED, f"not called again: {self._reason}", n)
        try:
            with _one_at_a_time:
                found = child_for(self._spec).align(self._maps, rng, self._time_limit_s)
        except ChildFailedError as error:
            self._lost += 1
            self._time_outs = self._time_outs + 1 if isinstance(error, TimedOutError) else 0
            self._reason = str(error)
            return without_answer(Status.FAILED, self._reason, n)
        self._time_outs = self._lost = 0
        return found


def callable_aligner(method: str, parameters: dict[str, Any], time_limit_s: float) -> Aligner:
    """The aligner, ready to be called; raises ValueError for an unknown name or parameter."""
    found = find_method(method)
    if found.kind is Kind.BUILT_IN:
        return as_aligner(make_method(method, **parameters))
    return OutsideAligner(found, Spec.of(method, parameters), time_limit_s)


def require_usable(method: str, parameters: dict[str, Any]) -> None:
    """Have the method made once, a plug-in in its process; raises ValueError where it cannot be."""
    if find_method(method).kind is Kind.PLUG_IN:
        _require_made(Spec.of(method, parameters))
    else:
        make_method(method, **parameters)


@functools.cache  # a sweep validates the same few again and again
def _require_made(spec: Spec) -> None:
    try:
        child_for(spec)
    except ChildFailedError as error:
        raise ValueError(f"plug-in {spec.method}: {error}") from error
