import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.run.workers import workers
from mapfusion.errors import InputError


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_worker_is_told_in_one_line() -> None:
    with workers(2) as pool:
        pool.submit("task", _die)
        with pytest.raises(InputError, match="killed from outside"):
            list(pool.completed())


PARENT = """
import os, time
from experiments.run.workers import workers
if __name__ == "__main__":
    with workers(2) as pool:
        pool.submit("task", os.getpid)
        pool.submit("task", time.sleep, 60)
        for _, pid in pool.completed():
            print(pid, flush=True)
"""


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        worker = int(run.stdout.readline())
        run.kill()
    deadline = time.monotonic() + 20
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{worker}").exists()
