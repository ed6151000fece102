"""Worker processes that run tasks; results do not depend on the number of processes.

On Linux the processes are forked from multiprocessing's fork server, which imports our modules once
for all of them. On other systems imported libraries hold threads or handles, so each process is
spawned.
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
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, resource_tracker
from typing import Any

from threadpoolctl import threadpool_limits

from mapfusion.errors import InputError


@contextmanager
def blocked_interrupts() -> Iterator[Callable[[], None]]:
    """Block Ctrl-C in this thread during a `with` block, or until the yielded function is called.

    A terminal sends Ctrl-C to the command and to all its processes. Processes and threads that are
    started in the block inherit it, so they are never interrupted, not even during their imports.
    Another thread of the command can still receive the interrupt.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None  # only the main thread is interrupted
        return
    # Python starts the tracker before the first process and unblocks the signal as it does so
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    def unblock() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield unblock
    finally:
        unblock()


def single_threaded() -> None:
    """Limit BLAS and OpenCV to one thread: the order of sums depends on the number of threads.

    Only loaded libraries can be limited; SciPy has a separate BLAS.
    """
    import cv2
    import numpy as np  # noqa: F401
    import scipy.linalg  # noqa: F401

    cv2.setNumThreads(1)
    threadpool_limits(1)


# Name of the exception by which a process pool replaces the traceback of a worker.
_REMOTE = "_RemoteTraceback"
_FRAME = re.compile(r'File "([^"]+)", line (\d+), in (\S+)')
_LONGEST_REASON = 200  # characters


def describe_defect(error: BaseException, details: str) -> str:
    """Return error and position of a defect in one line; `details` is the traceback."""
    frames = _FRAME.findall(details)
    place = "at {}:{} in {}".format(*frames[-1]) if frames else "at an unknown place"
    reason = " ".join(f"{type(error).__name__} {error}".split())[:_LONGEST_REASON]
    return f"a defect of mapfusion itself: {reason} {place}"


def save_defect(error: BaseException) -> str:
    """Write the traceback of a defect to a file; return a message that names the file."""
    cause = error.__cause__
    is_remote = cause is not None and type(cause).__name__ == _REMOTE
    details = str(cause) if is_remote else "".join(traceback.format_exception(error))
    handle, path = tempfile.mkstemp(prefix="mapfusion-defect-", suffix=".txt")
    with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(details)
    told = "what was finished is kept; please report it with its traceback"
    return f"{describe_defect(error, details)}; {told}: {path}"


# One running task and one waiting task per process. More waiting tasks would run in the order of
# submission, although other tasks may wait for a later one.
TASKS_PER_PROCESS = 2

_START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
_OURS = ("experiments.", "mapfusion.", "sim.")
_KILLED = (
    "a worker process was killed from outside (out of memory?); what was finished is kept, the "
    "same command goes on from there (--jobs 1 needs least memory)"
)


def _start_worker() -> None:
    """Prepare a worker process, which ends itself when its parent has ended."""

    def end_with_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    single_threaded()


class Workers:
    """Pool of worker processes, or this process for one job.

    Tasks are submitted with a tag. `completed` yields (tag, result) as they end; more tasks may be
    submitted meanwhile. No process is started before the first task.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None
        self._others: set[Any] = set()  # child processes that do not belong to the pool
        self._pending: dict[Any, Any] = {}  # tag of each future, or of each function to call

    def submit(self, tag: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Submit the call `function(*arguments)`."""
        if self._jobs == 1:
            self._pending[functools.partial(function, *arguments)] = tag
            return
        with blocked_interrupts():  # a submission may start a process
            if self._pool is None:
                context = multiprocessing.get_context(_START_METHOD)
                # has an effect before the first process only, with which the server starts
                modules = [name for name in [*sys.modules] if name.startswith(_OURS)]
                context.set_forkserver_preload(modules)
                self._others = {*multiprocessing.active_children()}
                self._pool = ProcessPoolExecutor(self._jobs, context, initializer=_start_worker)
                # Python's pool notices the death of a process only after a result that follows its
                # start. An empty task starts each process and gives such a result.
                for _ in range(self._jobs):
                    self._pool.submit(os.getpid)
            self._pending[self._pool.submit(function, *arguments)] = tag

    @property
    def room(self) -> int:
        """Number of further tasks that keep all processes at work."""
        wanted = 1 if self._jobs == 1 else TASKS_PER_PROCESS * self._jobs
        return max(wanted - len(self._pending), 0)

    def completed(self) -> Iterator[tuple[Any, Any]]:
        """Yield (tag, result) of each task as it ends; raise the error of a failed task."""
        while self._pending:
            if self._pool is None:
                task = next(iter(self._pending))
                yield self._pending.pop(task), task()
                continue
            done, _ = wait(self._pending, return_when=FIRST_COMPLETED)
            # in order of submission, so that following tasks are submitted in a fixed order
            for future in [future for future in self._pending if future in done]:
                tag = self._pending.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool as error:
                    raise InputError(_KILLED) from error
                yield tag, result

    def end(self) -> None:
        """Wait for all tasks and end the processes."""
        if self._pool is not None:
            self._pool.shutdown()

    def kill(self) -> None:
        """Kill all processes of the pool."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in {*multiprocessing.active_children()} - self._others:
                process.kill()


@contextmanager
def workers(jobs: int) -> Iterator[Workers]:
    """Provide a pool for a `with` block; an error or Ctrl-C kills its processes."""
    single_threaded()
    pool = Workers(jobs)
    try:
        yield pool
    except BaseException:
        pool.kill()
        raise
    pool.end()
