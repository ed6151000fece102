"""Worker processes that run tasks; results do not depend on their number.

Where Python can do so safely, they are forked from a server: a process that has imported what they
need, once for all of them, and has done nothing else. OpenCV's and Numba's threads do not survive a
fork, so nothing is forked that has begun to work. A command that has imported all it needs forks
the server from itself, with `make_ready`; else the server imports it all anew.
"""

import functools
import gc
import multiprocessing
import os
import re
import signal
import socket
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, forkserver, resource_tracker
from multiprocessing.connection import (
    arbitrary_address,  # pyright: ignore[reportAttributeAccessIssue]  # of which it is not told
)
from typing import Any, NoReturn

from threadpoolctl import threadpool_limits

from experiments.plugins.isolated_process import end_children
from mapfusion.errors import InputError


@contextmanager
def held_back_interrupts() -> Iterator[Callable[[], None]]:
    """Until the end of a `with` block, or until what it gives is called, this thread blocks Ctrl-C.

    A terminal sends it to the command and to all its processes. Those that are started meanwhile,
    and by threads that are started meanwhile, inherit the block and never see it: not even while
    they still import, too early to say so themselves. The command itself may be interrupted all the
    same, through another of its threads.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None  # only the main thread is interrupted
        return
    # Python starts it before the first process of all, and lifts the block as it does.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    def let_them_come() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield let_them_come
    finally:
        let_them_come()


def single_threaded() -> None:
    """Limit BLAS and OpenCV to one thread: the order of sums depends on the number of threads.

    Only loaded libraries can be limited, and SciPy has a BLAS of its own.
    """
    import cv2
    import numpy as np  # noqa: F401
    import scipy.linalg  # noqa: F401

    cv2.setNumThreads(1)
    threadpool_limits(1)


# What a process pool puts in place of the traceback of a worker, as text.
_REMOTE = "_RemoteTraceback"
_FRAME = re.compile(r'File "([^"]+)", line (\d+), in (\S+)')
_LONGEST_REASON = 200  # characters


def described(error: BaseException, details: str) -> str:
    """What went wrong and where, in one line; `details` is the error's traceback."""
    frames = _FRAME.findall(details)
    place = "at {}:{} in {}".format(*frames[-1]) if frames else "at an unknown place"
    reason = " ".join(f"{type(error).__name__} {error}".split())[:_LONGEST_REASON]
    return f"a defect of mapfusion itself: {reason} {place}"


def saved_defect(error: BaseException) -> str:
    """The same, once the whole traceback is in a file, which it names.

    What was finished before is in the store, and a repaired program goes on from there.
    """
    cause = error.__cause__
    is_remote = cause is not None and type(cause).__name__ == _REMOTE
    details = str(cause) if is_remote else "".join(traceback.format_exception(error))
    handle, path = tempfile.mkstemp(prefix="mapfusion-defect-", suffix=".txt")
    with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(details)
    told = "what was finished is kept; please report it with its traceback"
    return f"{described(error, details)}; {told}: {path}"


# While a process works on one task, the next is there already. More of them would be begun in the
# order they were submitted, though a later one may be what others wait for.
TASKS_PER_PROCESS = 2

# On other systems libraries hold threads or handles from their import on.
_FORKED = sys.platform == "linux"
_OURS = ("experiments.", "mapfusion.", "sim.")


def make_ready(jobs: int) -> None:
    """Fork the server from this process, if there are to be workers.

    To be called by a command that has imported what they need, and has begun nothing yet. Only the
    first call counts.
    """
    gc.freeze()  # what is imported stays: nobody is to look through it for garbage
    server: Any = forkserver._forkserver
    if jobs == 1 or not _FORKED or server._forkserver_pid is not None:
        return
    if threading.active_count() > 1:  # one of them may hold a lock, which nobody would open
        return
    end_children()  # of plug-ins that were looked at: they would be nobody's and everybody's
    from numba.core.registry import cpu_target

    # What Numba does before its first kernel, which takes it tenths of a second in each process.
    contexts: Any = cpu_target
    contexts.typing_context.refresh()
    contexts.target_context.refresh()
    sys.stdout.flush()  # else each process would write what is left there
    sys.stderr.flush()
    with held_back_interrupts(), socket.socket(socket.AF_UNIX) as listener:
        # as `ensure_running` does, but for starting Python anew
        address = arbitrary_address("AF_UNIX")
        listener.bind(address)
        os.chmod(address, 0o600)
        listener.listen()
        ended, alive = os.pipe()
        process = os.fork()
        if process == 0:
            os.close(alive)
            _serve(listener.fileno(), ended)
        os.close(ended)
    server._forkserver_address = address
    server._forkserver_alive_fd = alive
    server._forkserver_pid = process


def _serve(listener: int, ended: int) -> NoReturn:
    """Fork workers until the end of this process's parent and of all workers."""
    try:
        forkserver.main(listener, ended, [])
    finally:
        os._exit(0)


def _ensure_server() -> None:
    """Unless there is a server, start one that imports our modules that are imported here."""
    multiprocessing.set_forkserver_preload(
        [name for name in list(sys.modules) if name.startswith(_OURS)]
    )
    with held_back_interrupts():
        forkserver.ensure_running()


def _start_worker() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    single_threaded()


def _end_with_parent() -> None:
    """A parent that was killed cannot stop its workers, so each of them watches for it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


class Workers:
    """A pool of processes, or this process alone without one.

    Tasks are submitted with a tag; `completed` gives (tag, result) as they end, and more tasks may
    be submitted meanwhile.
    """

    def __init__(self, jobs: int, pool: ProcessPoolExecutor | None) -> None:
        self._pool = pool
        self._wanted = 1 if pool is None else TASKS_PER_PROCESS * jobs
        self._pending: dict[Any, Any] = {}  # tags, by futures or what is to be called

    def submit(self, tag: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Have `function(*arguments)` called, after what was submitted before."""
        if self._pool is None:
            self._pending[functools.partial(function, *arguments)] = tag
            return
        with held_back_interrupts():  # the first task starts the processes
            self._pending[self._pool.submit(function, *arguments)] = tag

    @property
    def room(self) -> int:
        """How many more tasks are wanted, so that no process has to wait for its next one."""
        return max(self._wanted - len(self._pending), 0)

    def completed(self) -> Iterator[tuple[Any, Any]]:
        """(tag, result) of each task as it ends; a task's error is raised here."""
        while self._pending:
            if self._pool is None:
                task = next(iter(self._pending))
                yield self._pending.pop(task), task()
                continue
            done, _ = wait(self._pending, return_when=FIRST_COMPLETED)
            # In order of submission: what follows from them is then submitted in a fixed order.
            for future in [future for future in self._pending if future in done]:
                yield self._pending.pop(future), _result(future)


def _result(future: Future) -> Any:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process was killed from outside (out of memory?); what was finished is kept, "
            "the same command goes on from there (--jobs 1 needs least memory)"
        ) from error


@contextmanager
def workers(jobs: int) -> Iterator[Workers]:
    """A pool for the length of a `with` block; an error or Ctrl-C ends it at once."""
    single_threaded()
    if jobs == 1:
        yield Workers(1, None)
        return
    if _FORKED:
        _ensure_server()
    context = multiprocessing.get_context("forkserver" if _FORKED else "spawn")
    pool = ProcessPoolExecutor(jobs, context, initializer=_start_worker)
    try:
        yield Workers(jobs, pool)
    except BaseException:
        processes = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:  # also those at work
            process.kill()
        raise
    pool.shutdown()
