"""Waiting for what happens in other processes, on a machine as busy as may be."""

import time
from collections.abc import Callable
from pathlib import Path

PATIENCE_S = 900  # kernels may have to be compiled; nothing that is right takes as long


def wait_until(happened: Callable[[], bool]) -> bool:
    """Return True if the condition became true before the time limit."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not happened():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.01)
    return True


def has_ended(pid: int) -> bool:
    """Return True if the process does not exist any more."""
    return not Path(f"/proc/{pid}").exists()
