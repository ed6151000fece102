"""Main module of the process that runs one plug-in; `isolated_process` starts it."""

import faulthandler
import json
import os
import pickle
import select
import socket
import sys
import threading
import time
import traceback
from typing import Any

import numpy as np

from experiments.plugins.discovery import make_method
from experiments.plugins.isolated_process import (
    InvalidAnswerError,
    alignment_to_json,
    checked_aligner,
    checked_alignment,
)
from mapfusion.align.aligners import Aligner
from mapfusion.errors import moved_module_note, one_line

# The process ends itself this long after the time limit, if a plug-in holds the interpreter's lock
# and the process that would end it has been killed.
_GRACE_S = 10.0
# Less than a request: if a plug-in reads from the connection too, the call fails.
_BUFFER_BYTES = 64


def main(socket_fd: int) -> None:
    """Answer requests, each by a line of JSON, until the other side closes the connection."""
    connection = socket.socket(fileno=socket_fd)
    threading.Thread(target=_end_with, args=(connection,), daemon=True).start()
    requests, runner = connection.makefile("rb", _BUFFER_BYTES), MethodRunner()
    while True:
        token, limit_s, action, *arguments = pickle.load(requests)  # noqa: S301  # our own
        faulthandler.dump_traceback_later(limit_s + _GRACE_S, exit=True, file=2)
        answer = runner.answer(action, *arguments) | {"token": token}
        faulthandler.cancel_dump_traceback_later()
        connection.sendall(json.dumps(answer).encode("ascii") + b"\n")


def _end_with(connection: socket.socket) -> None:
    """End the process when the other side closes the connection, even while the plug-in works."""
    end = select.poll()
    end.register(connection, 0)  # no event but POLLHUP and errors, which are always reported
    end.poll()
    os._exit(1)


class MethodRunner:
    """Runs the method of a plug-in; answers are JSON values."""

    aligner: Aligner
    maps: bytes

    def answer(self, action: str, *arguments: Any) -> dict[str, Any]:
        """Return the answer of an action, `make` or `align`, or the `error` in one line."""
        try:
            return getattr(self, action)(*arguments)
        except BaseException as error:  # also SystemExit, which would end the process
            try:
                text = f"{error}{moved_module_note(error)}"
            except BaseException:  # an error class of the plug-in may fail as well
                text = ""
            if isinstance(error, InvalidAnswerError):
                return {"error": one_line(text)}
            frame = traceback.extract_tb(error.__traceback__)[-1]
            file = one_line(os.path.basename(frame.filename))  # folders differ by machine
            told = one_line(f"raised {type(error).__name__}: {text}")
            return {"error": f"{told} ({file}:{frame.lineno})"}

    def make(self, name: str, parameters: dict[str, Any]) -> dict[str, Any]:
        """Construct the method, and return whether it is randomised."""
        try:
            method = make_method(name, **parameters)
        except ValueError as error:  # a wrong parameter: the text needs no file and line
            raise InvalidAnswerError(str(error)) from None
        self.aligner = checked_aligner(method)
        return {"randomised": bool(self.aligner.randomised)}

    def align(self, maps: bytes | None, rng: np.random.Generator) -> dict[str, Any]:
        """Align two maps, by default those of the last call; return the fields of the alignment."""
        self.maps = maps or self.maps
        # Unpickled for each call, since the plug-in may change its copy.
        map_a, map_b, correspondences = pickle.loads(self.maps)  # noqa: S301  # our own
        started_s = time.perf_counter()
        answer = self.aligner.align(map_a, map_b, correspondences, rng)
        elapsed_s = time.perf_counter() - started_s
        return alignment_to_json(checked_alignment(answer, len(correspondences), elapsed_s))


if __name__ == "__main__":
    main(int(sys.argv[1]))
