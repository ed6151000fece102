"""What a piece of work costs: CPU time of this process, and how far its memory grew meanwhile."""

import ctypes
import gc
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from experiments.pipeline.tables import FLOAT, INT, TEXT, fields
from mapfusion.files import schema

# One row a piece of work. It differs from run to run: nothing else may be read from it.
WORK_COSTS = schema(
    "independence.work_costs", 1, fields(iteration=INT, work=TEXT, cpu_s=FLOAT, peak_mb=FLOAT)
)
COSTS_FILE = "costs.parquet"
_STATUS, _PEAK_RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # what proc(5) has written there to begin a new peak of the resident memory
_KB_A_MB = 1000.0  # the kernel's kB are 1024 bytes


@dataclass(frozen=True)
class Cost:
    """What work took.

    Attributes:
        cpu_s: of all threads, user's and system's.
        peak_mb: by which the resident memory grew at most; NaN where the system does not tell.
    """

    cpu_s: float
    peak_mb: float


class Meter:
    """Reads what was spent since it was made.

    Memory is the kernel's high-water mark of this process (Linux), less what was resident at the
    start: what was given to the work does not count, what it made does, until it is given back. It
    is taken from the kernel and not from Python's tracer, which makes work several times as long.
    """

    def __init__(self) -> None:
        gc.collect(1)  # what was made last: a whole collection takes longer than some work
        _give_back()
        self._at_start_kb = _resident_kb()
        self._started_s = time.process_time()

    def read(self) -> Cost:
        """The cost so far."""
        cpu_s = time.process_time() - self._started_s
        return Cost(cpu_s, (_peak_kb() - self._at_start_kb) * 1.024 / _KB_A_MB)


def cost_row(iteration: int, work: str, cost: Cost) -> Mapping[str, object]:
    """A row of `WORK_COSTS`."""
    return {"iteration": iteration, "work": work, "cpu_s": cost.cpu_s, "peak_mb": cost.peak_mb}


def _give_back() -> None:
    """Have the C library return what it holds free: work that takes it again would seem small."""
    trim: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # GNU's alone
        trim(0)


def _resident_kb() -> float:
    """Resident memory now, from where a new peak begins."""
    try:
        _PEAK_RESET.write_text(_RESET_PEAK)
    except OSError:
        return math.nan
    return _status_kb("VmRSS")


def _peak_kb() -> float:
    return _status_kb("VmHWM")


def _status_kb(name: str) -> float:
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return math.nan
    values = dict(line.split(":", 1) for line in lines)
    return float(values[name].split()[0]) if name in values else math.nan
