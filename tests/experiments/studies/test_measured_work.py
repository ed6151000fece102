"""Tests of the meter on work whose memory and time are known."""

import math
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from experiments.studies import measured_work
from experiments.studies.measured_work import Cost, Meter

MB = 1_000_000
ROOM_MB = 8.0  # what else a process may take meanwhile


def filled(mb: int) -> np.ndarray:
    """Memory that was written to: pages are resident once they are touched."""
    return np.ones(mb * MB, dtype=np.uint8)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux tells, others do not")
def test_memory_is_the_most_there_was_at_one_time_beyond_what_was_given() -> None:
    """In a process of its own: what other tests left would be given back meanwhile."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        peaks_mb = pool.submit(peaks).result()
    assert peaks_mb == pytest.approx([0.0, 60.0, 90.0, 0.0, 1.0], abs=ROOM_MB)


def peaks() -> list[float]:
    """At first, after 60 MB three times, after 40 and 50 at a time, anew, after 1 MB many times."""
    given = filled(120)
    meter = Meter()
    found = [meter.read().peak_mb]
    for _ in range(3):  # one after the other: never more than 60 at a time
        filled(60)
    found.append(meter.read().peak_mb)
    both = filled(40), filled(50)
    found.append(meter.read().peak_mb)
    del both
    found.append(Meter().read().peak_mb)
    small = Meter()
    for _ in range(100):
        filled(1)
    found.append(small.read().peak_mb)
    assert given[-1] == 1
    return found


def test_waiting_costs_nothing_and_work_does() -> None:
    waited = Meter()
    time.sleep(0.1)
    assert 0 <= waited.read().cpu_s < 0.1
    worked, until = Meter(), time.process_time() + 0.05
    while time.process_time() < until:
        pass
    assert worked.read().cpu_s >= 0.045  # the meter's start takes some of it


def test_memory_is_unknown_where_the_system_does_not_tell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_STATUS", "_PEAK_RESET"):
        monkeypatch.setattr(measured_work, name, tmp_path / "none" / name)
    cost = Meter().read()
    assert isinstance(cost, Cost)
    assert math.isnan(cost.peak_mb)
    assert cost.cpu_s >= 0
