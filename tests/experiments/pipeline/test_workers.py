"""Tests of `experiments.pipeline.workers`."""

import inspect
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.cli import main as cli
from experiments.pipeline.workers import blocked_interrupts, save_defect, workers
from mapfusion.errors import InputError
from tests.helpers import acting
from tests.helpers.tiny_scenario import command
from tests.helpers.waiting import PATIENCE_S, has_ended, wait_until


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
    told = save_defect(raised(work))
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
    with blocked_interrupts() as let_them_come:
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
from experiments.pipeline.workers import blocked_interrupts
from tests.experiments.pipeline.test_workers import tell

if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    with blocked_interrupts():
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


_SCRIPT = """
import json
from experiments.pipeline.workers import single_threaded
single_threaded()
import numba, scipy.linalg, scipy.sparse.linalg, scipy.optimize
from threadpoolctl import threadpool_info
print(json.dumps([library["num_threads"] for library in threadpool_info()]))
"""


def test_libraries_that_are_loaded_afterwards_are_bound_too() -> None:
    """In a new process, as a worker is: several threads would sum in another order."""
    ended = subprocess.run(
        [sys.executable, "-c", _SCRIPT], capture_output=True, text=True, check=True
    )
    threads = json.loads(ended.stdout)
    assert len(threads) >= 2  # numpy's and scipy's own
    assert set(threads) == {1}


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_worker_is_told_in_one_line() -> None:
    with workers(2) as pool:
        pool.submit("task", _die)
        with pytest.raises(InputError, match="killed from outside"):
            list(pool.completed())


def _work_until(end: Path) -> None:
    end.with_suffix(".begun").touch()
    wait_until(end.exists)


def test_a_killed_worker_is_told_though_the_others_work_on(tmp_path: Path) -> None:
    end = tmp_path / "end"
    with workers(2) as pool:
        pool.submit("long", _work_until, end)
        assert wait_until(end.with_suffix(".begun").exists)
        pool.submit("killed", _die)
        late = threading.Timer(PATIENCE_S / 2, end.touch)  # ends the test if it is not told
        late.start()
        with pytest.raises(InputError, match="killed from outside"):
            list(pool.completed())
        late.cancel()
        assert not end.exists()


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
