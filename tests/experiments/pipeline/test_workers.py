"""Tests of `experiments.pipeline.workers`."""

import inspect
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.cli import main as cli
from experiments.pipeline.workers import held_back_interrupts, saved_defect, workers
from mapfusion.errors import InputError
from tests.helpers import acting
from tests.helpers.tiny_scenario import command
from tests.helpers.waiting import has_ended, wait_until


def raised(work: Callable[[], object]) -> BaseException:
    try:
        work()
    except ZeroDivisionError as error:
        return error
    raise AssertionError("it did not raise")


def in_a_worker() -> None:
    with workers(2) as pool:
        pool.submit("task", acting.break_down)
        list(pool.completed())


@pytest.mark.parametrize("work", [acting.break_down, in_a_worker])
def test_the_place_is_where_it_was_raised(work: Callable[[], object]) -> None:
    told = saved_defect(raised(work))
    assert "\n" not in told
    assert "ZeroDivisionError a bug at " in told
    lines, first = inspect.getsourcelines(acting.break_down)
    assert f"acting.py:{first + len(lines) - 1} in break_down;" in told  # its last
    details = Path(told.rpartition(": ")[2])
    assert 'raise ZeroDivisionError("a bug")' in details.read_text(encoding="utf-8")
    details.unlink()


def test_it_has_an_exit_code_of_its_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "app", lambda **_: acting.break_down())
    reply = command(capsys, "run", "x.yaml")
    assert reply.code == 70
    assert reply.err.startswith("mapfusion: a defect of mapfusion itself: ZeroDivisionError a bug")
    assert len(reply.err.splitlines()) == 1
    Path(reply.err.strip().rpartition(": ")[2]).unlink()


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
from tests.experiments.pipeline.test_workers import tell

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
