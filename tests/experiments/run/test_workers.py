import os
import signal
import subprocess
import sys
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


FORKED = """
import os, sys, threading
from experiments.pipeline.workers import make_ready, workers

def told():
    return os.getppid(), made_here

if __name__ == "__main__":
    made_here = "only a fork knows"
    sys.stdout.write("once ")  # is not yet written, and not to be written by every process
    stop = threading.Event()
    if sys.argv[1] == "beside a thread":
        threading.Thread(target=stop.wait).start()
    make_ready(int(sys.argv[2]))
    for _ in range(2):
        with workers(2) as pool:
            for tag in range(4):
                pool.submit(tag, told)
            for _, (parent, known) in pool.completed():
                print(parent, known)
    print(os.getpid())
    stop.set()
else:
    made_here = "imported anew"
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere they are spawned")
@pytest.mark.parametrize(
    ("moment", "jobs", "known"),
    [
        ("at first", 2, "only a fork knows"),
        ("beside a thread", 2, "imported anew"),
        ("at first", 1, "imported anew"),
    ],
)
def test_a_server_is_forked_from_a_command_that_has_begun_nothing(
    tmp_path: Path, moment: str, jobs: int, known: str
) -> None:
    script = tmp_path / "command.py"
    script.write_text(FORKED)
    command = [sys.executable, str(script), moment, str(jobs)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    once, *told, own, _ = ended.stdout.replace("once ", "once\n", 1).split("\n")
    server = told[0].split()[0]
    assert once == "once"
    assert told == [f"{server} {known}"] * 8
    assert server != own
    assert not ended.stderr
    assert wait_until(lambda: has_ended(int(server)))


PARENT = """
import os, sys, time
from experiments.pipeline.workers import make_ready, workers
if __name__ == "__main__":
    make_ready(int(sys.argv[1]))
    with workers(2) as pool:
        pool.submit("task", os.getpid)
        pool.submit("task", time.sleep, 100_000)
        for _, pid in pool.completed():
            print(pid, flush=True)
"""


@pytest.mark.parametrize("ready", [1, 2])
def test_workers_end_with_a_killed_parent(tmp_path: Path, ready: int) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    command = [sys.executable, str(script), str(ready)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        worker = int(run.stdout.readline())
        run.kill()
    assert wait_until(lambda: has_ended(worker))
