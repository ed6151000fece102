"""Gives a sweep's tasks to Dask, a window of runs at a time, and records how each run ended."""

import pickle
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sized
from dataclasses import dataclass, field
from typing import NamedTuple, cast

from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from experiments.run.dask_worker import TaskFailedError, Terms, UnfitWorkerError, perform
from experiments.run.store import Store, explained
from experiments.run.tasks import Task
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.planned_run import PlannedRun, planned
from experiments.study.sweep.sweep_dataset import SweepDataset
from mapfusion.errors import InputError

# Tasks at Dask for each worker. Enough that none waits while this process plans the next run; few
# enough that memory does not grow with the number of runs.
TASKS_PER_WORKER = 30
MIN_WORKERS = 4  # counted, while a cluster is still starting
_COUNT_WORKERS_EVERY_S = 10.0


@dataclass
class SweepProgress:
    """How far a sweep is; the driver counts on in it.

    Attributes:
        runs: in all.
        finished, kept: runs that are done; `kept` were done before.
        failed: the other runs that are done, with their reasons, by run id.
        tasks, tasks_done: by label, of the runs looked at so far.
    """

    runs: int = 0
    finished: int = 0
    kept: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    tasks: Counter[str] = field(default_factory=Counter)
    tasks_done: Counter[str] = field(default_factory=Counter)

    @property
    def done(self) -> int:
        """Runs that need nothing more."""
        return self.finished + self.kept + len(self.failed)


class Failure(NamedTuple):
    """Why a task failed; details are a traceback, where there is one."""

    reason: str
    details: str = ""


@dataclass
class _OpenRun:
    planned: PlannedRun
    left: list[str]  # names of its tasks, in order
    waiting: set[str]  # those of them at Dask


class SweepDriver:
    """Runs everything that is not finished; a run that fails does not stop the others."""

    def __init__(
        self,
        client: Client,
        store: Store,
        dataset: SweepDataset,
        terms: Terms,
        on_progress: Callable[[SweepProgress], None],
    ) -> None:
        self._client, self._store, self._dataset, self._terms = client, store, dataset, terms
        self._on_progress = on_progress
        # Of this sweep alone: another client's tasks of the same key might write elsewhere.
        self._suffix = uuid.uuid4().hex[:8]
        self._ended = as_completed(loop=client.loop)
        self._futures: dict[str, Future] = {}  # by name of the task
        self._waiting_for: dict[str, set[str]] = {}  # run ids by name of a task at Dask
        self._open: dict[str, _OpenRun] = {}
        self._failures: dict[str, Failure] = {}  # by name of the task, for runs that follow too
        self._n_workers, self._counted_at = 0, -_COUNT_WORKERS_EVERY_S
        self.progress = SweepProgress()

    def execute(self, runs: list[SweepRun]) -> None:
        """Bring all runs to an end; how they ended is in `progress`.

        Raises:
            InputError: workers cannot take part, or the scheduler was lost.
        """
        todo = iter(runs)
        self.progress.runs = len(runs)
        self._fill(todo)
        while self._open:
            self._task_ended(next(self._ended))
            self._fill(todo)

    def _fill(self, todo: Iterator[SweepRun]) -> None:
        """Begin further runs, in their order, while there is room."""
        while len(self._futures) < TASKS_PER_WORKER * self._workers():
            run = next(todo, None)
            if run is None:
                break
            self._begin(run)
        self._on_progress(self.progress)

    def _workers(self) -> int:
        if time.monotonic() - self._counted_at > _COUNT_WORKERS_EVERY_S:
            self._n_workers = len(cast(Sized, self._client.nthreads()))
            self._counted_at = time.monotonic()
        return max(self._n_workers, MIN_WORKERS)

    def _begin(self, run: SweepRun) -> None:
        try:
            laid_out = planned(run, self._store, self._dataset)
        except InputError as error:  # no world can be made from this seed, a log is damaged, ...
            self._fail(run, Failure(" ".join(str(error).split())))
            return
        if laid_out.finished:
            self.progress.kept += 1
            return
        left = laid_out.left()
        opened = _OpenRun(laid_out, [task.name for task in left], set())
        self._open[run.run_id] = opened
        blocked: set[str] = set()
        for task in left:
            if task.name in self._failures or blocked.intersection(task.needs):
                blocked.add(task.name)
                continue
            if task.name not in self._futures:  # else it is there for another run already
                self._submit(task)
            opened.waiting.add(task.name)
            self._waiting_for.setdefault(task.name, set()).add(run.run_id)
        self._end_if_over(opened)

    def _submit(self, task: Task) -> None:
        self.progress.tasks[task.label] += 1
        future = self._client.submit(
            perform,
            task.name,
            pickle.dumps(task),
            self._terms,
            *(self._futures[need] for need in task.needs if need in self._futures),
            key=f"{task.label}-{self._suffix}-{task.name}",
            pure=False,
            # in order: a run is finished before others begin
            priority=-self.progress.tasks.total(),
        )
        self._futures[task.name] = future
        self._ended.add(future)

    def _task_ended(self, future: Future) -> None:
        kind, name = _kind_and_name(future.key)
        failed = self._failure(future, name)
        if failed is not None:
            cause, failure = failed
            self._failures[cause] = failure
        del self._futures[name]
        self.progress.tasks_done[kind] += 1
        for run_id in self._waiting_for.pop(name):
            opened = self._open[run_id]
            opened.waiting.discard(name)
            self._end_if_over(opened)

    def _failure(self, future: Future, name: str) -> tuple[str, Failure] | None:
        """Which task failed and why; None if it did not. Those that needed it fail like it."""
        if future.status == "finished":
            return None
        if future.status != "error":
            raise InputError(
                "the connection to the Dask scheduler was lost; what was finished is kept, the "
                "same command goes on from there"
            )
        error = future.exception()
        if isinstance(error, TaskFailedError):
            return error.task, Failure(explained(error.reason, self._store), error.details)
        if isinstance(error, KilledWorker):
            _, cause = _kind_and_name(error.task)
            stage, times = cause.partition("/")[0], error.allowed_failures + 1
            return cause, Failure(f"{stage}: Dask gave it up after {times} of its workers died")
        if isinstance(error, UnfitWorkerError):
            raise InputError(str(error))
        raise InputError(f"a worker cannot run {name}: {type(error).__name__}: {error}")

    def _end_if_over(self, opened: _OpenRun) -> None:
        if opened.waiting:
            return
        run = opened.planned.run
        del self._open[run.run_id]
        # All tasks that could be done were done, so which comes first does not depend on chance.
        failures = (self._failures[name] for name in opened.left if name in self._failures)
        first = next(failures, None)
        if first is None:
            self.progress.finished += 1
        else:
            self._fail(run, first, opened.planned.stages)

    def _fail(self, run: SweepRun, failure: Failure, stages: list[str] | None = None) -> None:
        self.progress.failed[run.run_id] = failure.reason
        self._dataset.fail(run, failure.reason, failure.details, stages or [])


def _kind_and_name(key: object) -> tuple[str, str]:
    """Of the task that Dask knows under this key."""
    kind, _, name = str(key).split("-", 2)
    return kind, name
