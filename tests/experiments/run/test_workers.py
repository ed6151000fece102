import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.cli import run_commands
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


READY = """
import importlib, os, sys
from experiments.run.workers import workers

def told():
    return os.getppid(), "experiments.scenario.schema" in sys.modules

if __name__ == "__main__":
    importlib.import_module("experiments.scenario.schema")  # the server imports it, too
    with workers(2) as pool:
        for tag in range(8):
            pool.submit(tag, told)
        for _, (parent, imported) in pool.completed():
            print(parent, imported)
    print(os.getpid())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere they are spawned")
def test_workers_are_forked_from_a_server_with_what_is_imported_here(tmp_path: Path) -> None:
    script = tmp_path / "ready.py"
    script.write_text(READY)
    command = [sys.executable, str(script)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")
    *told, own, _ = lines
    server = told[0].split()[0]
    assert told == [f"{server} True"] * 8
    assert server != own


def test_what_is_to_be_imported_early_is_there() -> None:
    """The server passes over in silence what it does not find."""
    assert all(importlib.util.find_spec(name) for name in run_commands.NEEDED)


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
