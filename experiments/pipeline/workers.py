"""Worker processes that run tasks; results do not depend on their number.

On Linux the processes are forked from multiprocessing's fork server, which imports our modules once
for all of them. Elsewhere, where libraries hold threads or handles from their import on, each
process starts anew.
"""

import functools
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, resource_tracker
from typing import Any

from threadpoolctl import threadpool_limits

from mapfusion.errors import InputError


@contextmanager
def blocked_interrupts() -> Iterator[Callable[[], None]]:
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


def describe_defect(error: BaseException, details: str) -> str:
    """What went wrong and where, in one line; `details` is the error's traceback."""
    frames = _FRAME.findall(details)
    place = "at {}:{} in {}".format(*frames[-1]) if frames else "at an unknown place"
    reason = " ".join(f"{type(error).__name__} {error}".split())[:_LONGEST_REASON]
    return f"a defect of mapfusion itself: {reason} {place}"


def save_defect(error: BaseException) -> str:
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
    return f"{describe_defect(error, details)}; {told}: {path}"


# While a process works on one task, the next is there already. More of them would be begun in the
# order they were submitted, though a later one may be what others wait for.
TASKS_PER_PROCESS = 2

_START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
_OURS = ("experiments.", "mapfusion.", "sim.")


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
    """A pool of processes, or this process alone for one job.

    Tasks are submitted with a tag; `completed` gives (tag, result) as they end, and more tasks may
    be submitted meanwhile. No process is started before the first task.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None
        self._others: set[Any] = set()  # this process's children before the pool
        self._pending: dict[Any, Any] = {}  # tags, by futures or what is to be called

    def submit(self, tag: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Have `function(*arguments)` called, after what was submitted before."""
        if self._jobs == 1:
            self._pending[functools.partial(function, *arguments)] = tag
            return
        with blocked_interrupts():  # a task may start a process
            if self._pool is None:
                self._pool = self._started()
            self._pending[self._pool.submit(function, *arguments)] = tag

    def _started(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context(_START_METHOD)
        # Only the first call of a command counts: the server starts with the first process.
        context.set_forkserver_preload([name for name in [*sys.modules] if name.startswith(_OURS)])
        self._others = {*multiprocessing.active_children()}
        return ProcessPoolExecutor(self._jobs, context, initializer=_start_worker)

    @property
    def room(self) -> int:
        """How many more tasks are wanted, so that no process has to wait for its next one."""
        wanted = 1 if self._jobs == 1 else TASKS_PER_PROCESS * self._jobs
        return max(wanted - len(self._pending), 0)

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

    def end(self) -> None:
        """Wait for the tasks, then end the processes."""
        if self._pool is not None:
            self._pool.shutdown()

    def kill(self) -> None:
        """End the processes at once, those at work too."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in {*multiprocessing.active_children()} - self._others:
                process.kill()


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
    pool = Workers(jobs)
    try:
        yield pool
    except BaseException:
        pool.kill()
        raise
    pool.end()
