import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.pipeline.workers import workers
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
from experiments.pipeline.workers import workers

def told():
    return os.getppid(), "experiments.scenario.loading" in sys.modules

if __name__ == "__main__":
    importlib.import_module("experiments.scenario.loading")  # the server imports it, too
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


NOTHING_TO_DO = """
import os
from pathlib import Path
from experiments.pipeline.workers import workers

def children():
    return Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()

if __name__ == "__main__":
    with workers(2) as pool:
        assert list(pool.completed()) == []
        print(children())
        pool.submit("task", os.getpid)
        assert list(pool.completed())
        print(children() == [])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_no_process_is_started_before_the_first_task(tmp_path: Path) -> None:
    script = tmp_path / "idle.py"
    script.write_text(NOTHING_TO_DO)
    command = [sys.executable, str(script)]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")
    assert told == ["[]", "False", ""]


def _fail_beside_a_long_task(found: list[int]) -> None:
    with workers(2) as pool:
        pool.submit("at work", time.sleep, 100_000)
        pool.submit("task", os.getpid)
        found.append(next(pool.completed())[1])
        raise ValueError("of a task")


def test_an_error_ends_the_processes_at_work_and_no_others() -> None:
    with workers(2) as outer:
        outer.submit("outer", os.getpid)
        ((_, of_outer),) = outer.completed()
        found: list[int] = []
        with pytest.raises(ValueError, match="of a task"):
            _fail_beside_a_long_task(found)
        assert wait_until(lambda: has_ended(found[0]))
        assert not has_ended(of_outer)


PARENT = """
import os, time
from experiments.pipeline.workers import workers
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
    command = [sys.executable, str(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        worker = int(run.stdout.readline())
        run.kill()
    assert wait_until(lambda: has_ended(worker))
