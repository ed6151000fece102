"""Dask cluster of a sweep: local processes, or a cluster that is running already.

Dask runs whatever its clients send. Processes of this machine listen on its loopback interface,
which all its users can reach, so they take part only with the credentials of this sweep: a TLS key
that is drawn for it and is kept in memory. Their web servers, which know no credentials, have no
pages.
"""

import functools
import logging
import pickle
import platform
import threading
import traceback
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import dask.config
from distributed import Client, LocalCluster
from distributed.security import Security

from experiments.pipeline.code_version import library_versions, source_hash, use_kernel_cache
from experiments.pipeline.workers import described, held_back_interrupts
from mapfusion.errors import DamagedFileError, InputError

# Tasks keep state of their process (the open PyBullet world, OpenCV's threads), so a worker that
# was started with several threads works with one at a time.
_one_at_a_time = threading.Lock()


class TaskFailedError(Exception):
    """A task raised: its name and the reason in one line.

    And the traceback where it is a defect, or the error where it read a damaged file.
    """

    def __init__(
        self, task: str, reason: str, details: str = "", damage: DamagedFileError | None = None
    ) -> None:
        super().__init__(task, reason, details, damage)
        self.task, self.reason, self.details, self.damage = task, reason, details, damage


class UnfitWorkerError(Exception):
    """A worker that cannot take part, with the reason: nothing it did would be of use."""


@dataclass(frozen=True)
class Terms:
    """What all tasks of a sweep have in common.

    Attributes:
        attempts: folder with a file for each task at work; one byte for each time it was begun.
        retries: how often a task is begun again after the worker at it was killed.
        code: `code_version()` of the machine that plans.
    """

    attempts: Path
    retries: int
    code: str


@functools.cache
def code_version() -> str:
    """Source and libraries: where they differ, results would be kept under wrong keys."""
    return f"{source_hash()} {sorted(library_versions().items())} {platform.machine()}"


@functools.cache
def _prepare() -> None:
    """Once a process, before anything is imported that computes."""
    use_kernel_cache()
    from experiments.pipeline.workers import single_threaded

    single_threaded()


def perform(name: str, task: bytes, terms: Terms, *needs: None) -> None:
    """Run a task, pickled so that it is unpacked only after this process is prepared.

    `needs` are results of the tasks before it (all None), so that Dask knows the order.

    Raises:
        TaskFailedError: the task raised, or its workers were killed too often.
        UnfitWorkerError: this machine does not see the folder or has another version installed.
    """
    if not terms.attempts.is_dir():
        raise UnfitWorkerError(
            f"worker on {platform.node()} does not see {terms.attempts.parent}: the folder of "
            "results must be shared by all machines, under the same path"
        )
    if code_version() != terms.code:
        raise UnfitWorkerError(
            f"worker on {platform.node()} has other source or libraries than this machine: "
            "install the same version everywhere and start the workers again"
        )
    with _one_at_a_time:
        _prepare()
        _attempt(name, task, terms)


def _attempt(name: str, task: bytes, terms: Terms) -> None:
    """Run it under a mark: only a killed process leaves the mark behind."""
    stage = name.partition("/")[0]
    mark = terms.attempts / name.replace("/", "_")
    if mark.exists() and mark.stat().st_size > terms.retries:
        killed = f"its worker was killed {terms.retries + 1} times (out of memory?)"
        raise TaskFailedError(name, f"{stage}: {killed}")
    with mark.open("ab") as file:
        file.write(b".")
    try:
        pickle.loads(task).run()  # noqa: S301 (our own client's)
    except InputError as error:
        damage = error if isinstance(error, DamagedFileError) else None
        raise TaskFailedError(name, " ".join(str(error).split()), damage=damage) from None
    except (OSError, MemoryError) as error:  # of this machine: full, or not ours to write to
        reason = " ".join(f"{stage}: {type(error).__name__} {error}".split())
        raise TaskFailedError(name, reason) from None
    except Exception as error:
        details = traceback.format_exc()
        raise TaskFailedError(name, f"{stage}: {described(error, details)}", details) from None
    finally:
        mark.unlink(missing_ok=True)


CONNECT_TIMEOUT_S = 30
_STARTS = 3  # of a cluster: a worker may be killed for no fault of ours, thrice in a row it is not

_LOCAL_SETTINGS = {
    # Dask blames every task that was assigned to a killed worker, not only the one at work; the
    # sweep counts by itself (`dask_worker.Terms.retries`).
    "distributed.scheduler.allowed-failures": 1_000_000,
    # A killed worker is begun again, which a busy machine may take long for: Dask must not give up.
    "distributed.deploy.lost-worker-timeout": "1 day",
    # Tasks keep nothing in Dask's memory, so there is nothing to spill, and a paused worker would
    # wait for ever. One that fills 95 % of its share is killed and its task begun again.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # Dask keeps the last tasks and events for developers: with thousands of them, tens of MB.
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.log-length": 100,
    "distributed.admin.system-monitor.log-length": 100,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


def connected(jobs: int, scheduler: str | None) -> AbstractContextManager[Client]:
    """A client for a `with` block: of the scheduler at an address, else of `jobs` processes.

    Credentials for one at `tls://...` are those of Dask's configuration.

    Raises:
        InputError: no scheduler answers there, or it is not one for these credentials.
    """
    if scheduler is None:
        return _local(jobs)
    try:
        return Client(scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except TypeError as error:  # how Dask takes it that there are no credentials
        named = (
            "set distributed.comm.tls in Dask's configuration (DASK_DISTRIBUTED__COMM__TLS__...)"
        )
        raise InputError(f"--scheduler {scheduler}: needs TLS credentials; {named}") from error
    except (OSError, ValueError) as error:
        reason = f"no Dask scheduler answers ({str(error).splitlines()[0]})"
        raise InputError(f"--scheduler {scheduler}: {reason}") from error


@contextmanager
def _local(jobs: int) -> Iterator[Client]:
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the sweep tells what matters
    with dask.config.set(_LOCAL_SETTINGS), held_back_interrupts() as let_them_come:
        cluster = _started(jobs)
        try:
            let_them_come()
            with Client(cluster, set_as_default=False) as client:
                yield client
        except BaseException:  # end workers at once: the next sweep begins their tasks again
            for nanny in cluster.workers.values():
                process = getattr(nanny.process, "process", None)
                if process is not None and process.is_alive():
                    cluster.sync(process.kill)
            raise
        finally:
            cluster.close()


def _started(jobs: int) -> LocalCluster:
    """A cluster with all its workers; where one was killed before it answered, once more."""
    credentials = Security.temporary()
    for attempt in range(_STARTS):
        try:
            return LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                security=credentials,
                dashboard_address="127.0.0.1:0",  # any port that is free
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:  # "Nanny failed to start."
            if attempt == _STARTS - 1:
                reason = f"{jobs} workers could not be started, {_STARTS} times ({error})"
                raise InputError(f"--jobs {jobs}: {reason}") from error
    raise AssertionError
