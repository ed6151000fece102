import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.run.workers import workers
from mapfusion.errors import InputError
from tests.helpers.waiting import has_ended, wait_until


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
        pool.submit("task", time.sleep, 100_000)
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
    assert wait_until(lambda: has_ended(worker))
