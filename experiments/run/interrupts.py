"""Ctrl-C is for the command alone, not for the processes that work for it."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


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
