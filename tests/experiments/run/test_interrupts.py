"""Ctrl-C never reaches processes that are started meanwhile."""

import subprocess
import sys
import threading

from experiments.run.interrupts import held_back_interrupts

ASK = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"


def child_is_spared() -> bool:
    command = [sys.executable, "-c", ASK]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True\n"


def test_processes_started_meanwhile_never_see_it() -> None:
    with held_back_interrupts() as let_them_come:
        assert child_is_spared()
        started = threading.Event()
        spared: list[bool] = []
        thread = threading.Thread(target=lambda: (started.wait(), spared.append(child_is_spared())))
        thread.start()
        let_them_come()
        assert not child_is_spared()
        started.set()  # as Dask's loop starts a worker again, long afterwards
        thread.join()
    assert spared == [True]
    assert not child_is_spared()
