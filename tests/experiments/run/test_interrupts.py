"""Ctrl-C never reaches processes that are started meanwhile."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

from experiments.pipeline.workers import held_back_interrupts

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


FIRST_OF_ALL = """
import multiprocessing, sys
from experiments.pipeline.workers import held_back_interrupts
from tests.experiments.run.test_interrupts import tell

if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    with held_back_interrupts():
        for name in ("first", "second"):
            process = spawn.Process(target=tell, args=(f"{sys.argv[1]}/{name}",))
            process.start()
            process.join()
"""


def tell(path: str) -> None:
    """Write into a file whether this process is spared."""
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    Path(path).write_text(str(signal.SIGINT in blocked), encoding="utf-8")


def test_nor_does_it_reach_the_first_process_of_all(tmp_path: Path) -> None:
    """With it Python starts a helper, and lifts the block of the thread that does so."""
    script = tmp_path / "start.py"
    script.write_text(FIRST_OF_ALL, encoding="utf-8")
    own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run([sys.executable, script, tmp_path], check=True, env=os.environ | own)
    assert [(tmp_path / name).read_text() for name in ("first", "second")] == ["True", "True"]
