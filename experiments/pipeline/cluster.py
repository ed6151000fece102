"""Dask cluster of a sweep: local processes, or a running cluster.

Dask executes any code that its clients send. Local processes listen on the loopback interface,
which all users of the machine can reach. So they accept only the credentials of this sweep: a TLS
key that is created for the sweep and kept in memory. Their web servers do not check credentials, so
all pages are switched off.
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

from experiments.pipeline.stage import library_versions, source_hash, use_kernel_cache
from experiments.pipeline.workers import blocked_interrupts, describe_defect, single_threaded
from mapfusion.errors import DamagedFileError, InputError

# Tasks use state of their process (the open PyBullet world, OpenCV's threads), so a worker with
# several threads runs one task at a time.
_one_at_a_time = threading.Lock()


class TaskFailedError(Exception):
    """Failure of a task: its name and the reason in one line.

    `details` is the traceback of a defect; `damage` is the error of a damaged file.
    """

    def __init__(
        self, task: str, reason: str, details: str = "", damage: DamagedFileError | None = None
    ) -> None:
        super().__init__(task, reason, details, damage)
        self.task, self.reason, self.details, self.damage = task, reason, details, damage


class UnfitWorkerError(Exception):
    """Reason why a worker cannot take part in a sweep."""


@dataclass(frozen=True)
class SweepTerms:
    """Terms that all tasks of a sweep share.

    Attributes:
        attempts: folder with a file for each running task, which has one byte per start.
        retries: number of restarts of a task whose worker was killed.
        code: `code_version()` of the machine that plans the sweep.
    """

    attempts: Path
    retries: int
    code: str


@functools.cache
def code_version() -> str:
    """Return a text that identifies sources and libraries, on which the keys of results depend."""
    return f"{source_hash()} {sorted(library_versions().items())} {platform.machine()}"


def perform(name: str, task: bytes, terms: SweepTerms, *needs: None) -> object:
    """Run a task.

    A file marks the task as started; only a killed process leaves the file behind.

    Args:
        name: name of the task.
        task: pickled task, which is unpickled after the process is prepared.
        terms: terms of the sweep.
        needs: results of the tasks before it (all None), which tell Dask the order.

    Returns:
        The value of the task's function; None if the task was finished before.

    Raises:
        TaskFailedError: the task raised an error, or its workers were killed too often.
        UnfitWorkerError: this machine does not see the folder, or has another version installed.
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
        use_kernel_cache()  # before the import of modules with kernels
        single_threaded()
        stage = name.partition("/")[0]
        mark = terms.attempts / name.replace("/", "_")
        if mark.exists() and mark.stat().st_size > terms.retries:
            killed = f"its worker was killed {terms.retries + 1} times (out of memory?)"
            raise TaskFailedError(name, f"{stage}: {killed}")
        with mark.open("ab") as file:
            file.write(b".")
        try:
            begun = pickle.loads(task)  # noqa: S301 (our own client's)
            return None if begun.finished else begun.function(*begun.arguments)
        except InputError as error:
            damage = error if isinstance(error, DamagedFileError) else None
            raise TaskFailedError(name, " ".join(str(error).split()), damage=damage) from None
        except (OSError, MemoryError) as error:  # full disk or write-protected folder
            reason = " ".join(f"{stage}: {type(error).__name__} {error}".split())
            raise TaskFailedError(name, reason) from None
        except Exception as error:
            details = traceback.format_exc()
            reason = f"{stage}: {describe_defect(error, details)}"
            raise TaskFailedError(name, reason, details) from None
        finally:
            mark.unlink(missing_ok=True)


CONNECT_TIMEOUT_S = 30
_STARTS = 3  # attempts to start a cluster, because a worker may be killed during its start

_LOCAL_SETTINGS = {
    # Dask counts a failure of every task that was assigned to a killed worker, not only of the one
    # that ran. So the sweep counts by itself (`SweepTerms.retries`).
    "distributed.scheduler.allowed-failures": 1_000_000,
    # A killed worker is restarted, which takes long on a busy machine.
    "distributed.deploy.lost-worker-timeout": "1 day",
    # Dask keeps only a few rows of tables in memory, so there is nothing to spill, and a paused
    # worker would never continue. A worker that fills 95 % of its share is killed.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # Logs of tasks and events for developers take tens of MB by default.
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.log-length": 100,
    "distributed.admin.system-monitor.log-length": 100,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


def dask_client(jobs: int, scheduler: str | None) -> AbstractContextManager[Client]:
    """Return a client for a `with` block, of the scheduler at an address or of `jobs` processes.

    Credentials for an address `tls://...` are taken from Dask's configuration.

    Raises:
        InputError: no scheduler answers at the address, or it refuses the credentials.
    """
    if scheduler is None:
        return _local_client(jobs)
    try:
        return Client(scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except TypeError as error:  # Dask's reaction to missing credentials
        named = (
            "set distributed.comm.tls in Dask's configuration (DASK_DISTRIBUTED__COMM__TLS__...)"
        )
        raise InputError(f"--scheduler {scheduler}: needs TLS credentials; {named}") from error
    except (OSError, ValueError) as error:
        reason = f"no Dask scheduler answers ({str(error).splitlines()[0]})"
        raise InputError(f"--scheduler {scheduler}: {reason}") from error


@contextmanager
def _local_client(jobs: int) -> Iterator[Client]:
    """Provide a client of local processes, which are killed after an error."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the sweep reports failures
    with dask.config.set(_LOCAL_SETTINGS), blocked_interrupts() as unblock_interrupts:
        cluster = _start_cluster(jobs)
        try:
            unblock_interrupts()
            with Client(cluster, set_as_default=False) as client:
                yield client
        except BaseException:  # kill workers at once; the next sweep repeats their tasks
            for nanny in cluster.workers.values():
                process = getattr(nanny.process, "process", None)
                if process is not None and process.is_alive():
                    cluster.sync(process.kill)
            raise
        finally:
            cluster.close()


def _start_cluster(jobs: int) -> LocalCluster:
    """Start a cluster; try again if a worker was killed before it answered."""
    credentials = Security.temporary()
    for attempt in range(_STARTS):
        try:
            return LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                security=credentials,
                dashboard_address="127.0.0.1:0",  # any free port
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:  # "Nanny failed to start."
            if attempt == _STARTS - 1:
                reason = f"{jobs} workers could not be started, {_STARTS} times ({error})"
                raise InputError(f"--jobs {jobs}: {reason}") from error
    raise AssertionError
