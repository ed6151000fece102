"""Processes that share out tasks; results do not depend on how many there are."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any

from experiments.methods.threads import single_threaded
from mapfusion.errors import InputError

# While a process works on one task, the next is there already. More of them would be begun in the
# order they were submitted, though a later one may be what others wait for.
TASKS_PER_PROCESS = 2


def _start_worker() -> None:
    # Ctrl-C reaches the whole process group; the parent alone decides what then happens.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    single_threaded()


def _end_with_parent() -> None:
    """A parent that was killed cannot stop its workers, so each of them watches for it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


class Workers:
    """A pool of processes, or this process alone when one job is enough.

    Tasks are submitted with a tag; `completed` gives (tag, result) as they end, and more tasks may
    be submitted meanwhile.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._queue: deque[tuple[Any, Callable[..., Any], tuple]] = deque()
        self._pending: dict[Future, Any] = {}
        self._pool: ProcessPoolExecutor | None = None
        if jobs > 1:
            # Spawned, not forked: OpenCV's and Numba's threads do not survive a fork.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(jobs, context, initializer=_start_worker)

    def submit(self, tag: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Have `function(*arguments)` called, after what was submitted before."""
        if self._pool is None:
            self._queue.append((tag, function, arguments))
        else:
            self._pending[self._pool.submit(function, *arguments)] = tag

    @property
    def has_room(self) -> bool:
        """Whether a process would have to wait for its next task unless one is submitted."""
        if self._pool is None:
            return not self._queue
        return len(self._pending) < TASKS_PER_PROCESS * self._jobs

    def completed(self) -> Iterator[tuple[Any, Any]]:
        """(tag, result) of each task as it ends; a task's error is raised here."""
        while self._queue or self._pending:
            if self._queue:
                tag, function, arguments = self._queue.popleft()
                yield tag, function(*arguments)
                continue
            done, _ = wait(self._pending, return_when=FIRST_COMPLETED)
            # In order of submission: what follows from them is then submitted in a fixed order.
            for future in [f for f in self._pending if f in done]:
                tag = self._pending.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool as error:
                    raise InputError(
                        "a worker process was killed from outside (out of memory?); what was "
                        "finished is kept, the same command goes on from there (--jobs 1 needs "
                        "least memory)"
                    ) from error
                yield tag, result

    def stop(self) -> None:
        """End all processes at once, also those at work."""
        if self._pool is None:
            return
        processes = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()

    def close(self) -> None:
        """Wait for the processes to end."""
        if self._pool is not None:
            self._pool.shutdown()


@contextmanager
def workers(jobs: int) -> Iterator[Workers]:
    """A pool for the length of a `with` block; an error or Ctrl-C ends it at once."""
    single_threaded()
    pool = Workers(jobs)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    pool.close()
