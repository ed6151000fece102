"""The process in which one method from outside runs; `experiments.methods.aligner_calls` starts it.

Nothing is taken on trust: every answer is checked and copied here, so nothing of the plug-in's
making reaches the other side. The maps are unpacked afresh for each call: whatever it does to them,
the next call sees them as they were.
"""

import faulthandler
import json
import os
import pickle
import socket
import sys
import threading
import time
import traceback
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.methods.answers import (
    NonsenseError,
    array,
    checked_answer,
    require,
    require_type,
    written,
)
from experiments.methods.catalogue import make_method
from experiments.methods.channel import Channel
from experiments.methods.threads import single_threaded
from mapfusion.align.alignment import Alignment, Pairs, Status, without_answer
from mapfusion.align.method import Fit, Needs, Undetermined
from mapfusion.errors import one_line
from mapfusion.registration import Aligner, MethodAligner

# Past the limit this process ends even when the plug-in holds the interpreter's lock and the one
# who should have ended it is gone.
_GRACE_S = 10.0


def main(connection_fd: int, lifeline_fd: int) -> None:
    """Answer requests until the other side goes away."""
    threading.Thread(target=_end_with, args=(lifeline_fd,), daemon=True).start()
    _silence()
    channel = Channel(socket.socket(fileno=connection_fd))
    served = _Served()
    while True:
        try:
            secret, packed = channel.next_request()
        except EOFError:
            return
        request, *details, limit_s = pickle.loads(packed)  # noqa: S301  # ours
        faulthandler.dump_traceback_later(limit_s + _GRACE_S, exit=True, file=2)
        answer = getattr(served, request)(*details)
        faulthandler.cancel_dump_traceback_later()
        channel.answer(secret, answer.encode("ascii"))


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

    def make(self, name: str, parameters: dict[str, Any]) -> str:
        """Whether it is randomised, or the text why it could not be made, in JSON."""
        try:
            self.aligner = _checked_aligner(make_method(name, **parameters))
            randomised = bool(self.aligner.randomised)
        except ValueError as error:
            return json.dumps(one_line(str(error)))
        except BaseException as error:  # also SystemExit: it must not end this process
            return json.dumps(_told(error))
        single_threaded()  # after the import, which may have brought more libraries
        return json.dumps(randomised)

    def align(self, maps: bytes | None, rng: np.random.Generator) -> str:
        """The checked answer for new maps, or (None) for those of the last call, in JSON."""
        return written(self._aligned(maps, rng))

    def _aligned(self, maps: bytes | None, rng: np.random.Generator) -> Alignment:
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
            return checked_answer(answer, n, elapsed_s)
        except BaseException as error:  # also an answer whose very attributes raise
            unread = "" if isinstance(error, NonsenseError) else "answer cannot be read: "
            return without_answer(Status.FAILED, unread + _told(error), n)


def _checked_aligner(method: Any) -> Aligner:
    """The aligner around a method from outside; raises NonsenseError where it is none."""
    require_type("randomised is", getattr(method, "randomised", None), "a bool", bool)
    if callable(getattr(method, "align", None)):
        return method
    if not callable(getattr(method, "find", None)):
        raise NonsenseError("has neither a method find nor a method align")
    require_type("needs is", getattr(method, "needs", None), "Needs", Needs, type(None))
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
            require(told, "Undetermined without a reason")
            return found
        require_type("returned", found, "Fit or Undetermined", Fit)
        require_type("refusal is", found.refusal, "str", str)
        T_a_b = array("T_a_b", found.T_a_b, (3,))
        inlier = array("inlier", found.inlier, (len(pairs),), "bool")
        no_motion = "T_a_b is not finite, expected Undetermined where there is no motion"
        require(np.isfinite(T_a_b).all(), no_motion)
        require_type("fitted is", found.fitted, "Pairs", Pairs, type(None))
        n = int(inlier.sum()) if found.fitted is None else len(found.fitted)
        weight = None if found.weight is None else array("weight", found.weight, (n,))
        require(weight is None or not (weight < 0).any(), "weight is negative")
        gain = None if found.gain is None else array("gain", found.gain, (n, 3, 2))
        return replace(found, T_a_b=T_a_b, inlier=inlier, weight=weight, gain=gain)


def _told(error: BaseException) -> str:
    """What was raised, and in which line of which file; no paths, which differ by machine."""
    try:
        text = str(error)
    except BaseException:  # a plug-in's error is a plug-in's, too
        text = ""
    if isinstance(error, NonsenseError):
        return one_line(text)
    frames = traceback.extract_tb(error.__traceback__)
    what = one_line(f"raised {type(error).__name__}: {text}")
    if not frames:
        return what
    return f"{what} ({one_line(os.path.basename(frames[-1].filename))}:{frames[-1].lineno})"


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
