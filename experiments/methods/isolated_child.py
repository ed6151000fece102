"""The process in which one method from outside runs; `experiments.methods.isolation` starts it.

Every answer is checked here and sent as plain numbers, so nothing of the plug-in's making reaches
the other side. The maps are unpacked afresh for each call: whatever it does to them, the next call
sees them as they were.
"""

import faulthandler
import os
import pickle
import threading
import time
import traceback
from multiprocessing.connection import Connection
from typing import Any

_TEXT_LENGTH = 200  # of what a plug-in says about itself in a table
# Past the limit this process ends even when the plug-in holds the interpreter's lock and the one
# who should have ended it is gone.
_GRACE_S = 10.0


def main(connection_fd: int, lifeline_fd: int) -> None:
    """Answer requests until the other side goes away."""
    _watch(lifeline_fd)
    _silence()
    connection = Connection(connection_fd)
    aligner: Any = None
    maps = b""
    while True:
        try:
            request, *details = connection.recv()
        except EOFError:
            return
        if request == "maps":
            (maps,) = details
            continue
        limit_s = details.pop()
        faulthandler.dump_traceback_later(limit_s + _GRACE_S, exit=True, file=2)
        if request == "make":
            aligner, answer = _make(*details)
        else:
            answer = _align(aligner, maps, *details)
        faulthandler.cancel_dump_traceback_later()
        connection.send((*answer, _memory_bytes()))


def _watch(lifeline_fd: int) -> None:
    """End with the process that holds the lifeline's other end, also while the plug-in works."""

    def wait() -> None:
        os.read(lifeline_fd, 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _silence() -> None:
    """What plug-ins print, in Python or C++, would tear the tables and bars of the command."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)


def _memory_bytes() -> int:
    """What this process holds; 0 where the system does not tell."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _make(name: str, parameters: dict[str, Any]) -> tuple[Any, tuple[str, Any]]:
    """The aligner (or None) and the answer: ("made", randomised) or ("refused", why)."""
    from experiments.methods.answers import checked, why_unusable
    from experiments.methods.catalogue import make_method
    from experiments.methods.threads import single_threaded

    try:
        method = make_method(name, **parameters)
        wrong = why_unusable(method)
    except ValueError as error:
        return None, ("refused", _one_line(str(error)))
    except BaseException as error:  # also SystemExit: it must not end this process
        return None, ("refused", _told(error))
    single_threaded()  # after the import, which may have brought more libraries
    if wrong:
        return None, ("refused", wrong)
    return checked(method), ("made", method.randomised)


def _align(aligner: Any, maps: bytes, rng: Any) -> tuple[str, Any]:
    """("aligned", fields of the Alignment) or ("failed", why)."""
    from experiments.methods.answers import NonsenseError, why_nonsense

    map_a, map_b, correspondences = pickle.loads(maps)  # noqa: S301  # ours, from the harness
    n = len(correspondences)
    try:
        started_s = time.perf_counter()
        answer = aligner.align(map_a, map_b, correspondences, rng)
        elapsed_s = time.perf_counter() - started_s
    except NonsenseError as error:
        return "failed", _one_line(str(error))
    except BaseException as error:
        return "failed", _told(error)
    try:
        wrong = why_nonsense(answer, n)
        if wrong:
            return "failed", _one_line(wrong)
        return "aligned", {
            "T_a_b": answer.T_a_b.astype("f8").tolist(),
            "covariance": answer.covariance.astype("f8").tolist(),
            "inlier": answer.inlier.tolist(),
            "elapsed_s": elapsed_s,
            "status": str(answer.status),
            "reason": _one_line(answer.reason),
            "drift_sigma_m": float(answer.drift_sigma_m),
        }
    except BaseException as error:  # an answer whose very attributes raise
        return "failed", f"answer cannot be read: {_told(error)}"


def _told(error: BaseException) -> str:
    """What was raised, and in which line of which file; no paths, which differ by machine."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    try:
        text = str(error)
    except BaseException:
        text = ""
    return _one_line(f"raised {type(error).__name__}: {text}") + place


def _one_line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _TEXT_LENGTH else line[: _TEXT_LENGTH - 3] + "..."
