"""Ctrl-C waits while processes are started, and they never see it."""

import os
import signal
import subprocess
import sys
import threading

import pytest

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


def interrupted(reached: list[str], early: bool) -> None:
    with held_back_interrupts() as let_them_come:
        os.kill(os.getpid(), signal.SIGINT)
        reached.append("started")
        if early:
            let_them_come()
        reached.append("at the end")


@pytest.mark.parametrize("early", [True, False])
def test_ctrl_c_comes_when_they_are_there(early: bool) -> None:
    reached: list[str] = []
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background: ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted(reached, early)
    finally:
        signal.signal(signal.SIGINT, before)
    assert reached == ["started", "at the end"][: 1 if early else 2]
