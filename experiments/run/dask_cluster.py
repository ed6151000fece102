"""The Dask cluster a sweep runs on: processes of this machine, or one that is there already.

Dask runs whatever its clients send. Processes of this machine listen on its loopback interface,
which all its users can reach, so they take part only with the credentials of this sweep: a TLS key
that is drawn for it and is kept in memory. Their web servers, which know no credentials, have no
pages.
"""

import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import dask.config
from distributed import Client, LocalCluster
from distributed.security import Security

from experiments.run.interrupts import held_back_interrupts
from mapfusion.errors import InputError

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
