"""A command that stands still at a certain moment, to be interrupted there."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests.helpers.waiting import PATIENCE_S, wait_until

# Read by every Python process that is started, so also by a command's workers. A finished file is
# renamed to its name, which Python tells its audit hooks before it happens. Tests that run in the
# background hand down that Ctrl-C is ignored: here it counts.
_STAND_STILL = """
import os, pathlib, signal, sys, time

signal.signal(signal.SIGINT, signal.default_int_handler)

def stand_still(event, arguments):
    if event == "os.rename" and str(arguments[1]).endswith({name!r}):
        pathlib.Path({mark!r}).touch()
        time.sleep(100_000)

sys.addaudithook(stand_still)
"""


def interrupted(
    arguments: list[object],
    folder: Path,
    before_file: str,
    ready: Callable[[], bool],
    by_terminal: bool = True,
) -> subprocess.CompletedProcess[str]:
    """Start `mapfusion ARGUMENTS`, and end it when it would put a file in place.

    Args:
        arguments: of the command.
        folder: an empty one, for what makes it stand still.
        before_file: how the file's name ends; each process that has finished one stands still.
        ready: what must have come true as well, by the work of other processes.
        by_terminal: press Ctrl-C, which all processes get; else terminate its own process, as
            `kill` and `timeout` do.
    """
    mark = folder / "stands_still"
    text = _STAND_STILL.format(name=before_file, mark=str(mark))
    (folder / "sitecustomize.py").write_text(text, encoding="utf-8")
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.cli.main", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        start_new_session=True,  # a process group of its own, as a shell gives each command
    )
    there = wait_until(lambda: (mark.exists() and ready()) or process.poll() is not None)
    assert there, "it never came to stand still"
    assert process.poll() is None, process.communicate()
    if by_terminal:
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.terminate()
    out, err = process.communicate(timeout=PATIENCE_S)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)
