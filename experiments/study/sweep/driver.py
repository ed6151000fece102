"""Gives a sweep's tasks to Dask, a window of runs at a time, and keeps book of what ended how."""

import pickle
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import dataclass, field
from typing import cast

from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from experiments.run.dask_worker import TaskFailedError, Terms, UnfitWorkerError, perform
from experiments.run.store import Store, explained
from experiments.run.tasks import Task
from experiments.study.sweep.dataset import Dataset
from experiments.study.sweep.grid import Run
from experiments.study.sweep.planned import PlannedRun, planned
from mapfusion.errors import InputError

# Tasks at Dask for each worker. Enough that none waits while this process plans the next run; few
# enough that memory does not grow with the number of runs.
TASKS_PER_WORKER = 30
MIN_WORKERS = 4  # counted, while a cluster is still starting
_COUNT_WORKERS_EVERY_S = 10.0


@dataclass(frozen=True)
class Progress:
    """How far a sweep is.

    Attributes:
        runs: in all.
        finished, failed, kept: runs that are done; `kept` were done before.
        tasks, tasks_done: by label, of the runs looked at so far.
    """

    runs: int
    finished: int
    failed: int
    kept: int
    tasks: Counter[str]
    tasks_done: Counter[str]

    @property
    def done(self) -> int:
        """Runs that need nothing more."""
        return self.finished + self.failed + self.kept


@dataclass(frozen=True)
class Failure:
    """Why a task failed; details are a traceback, where there is one."""

    reason: str
    details: str = ""


@dataclass
class _OpenRun:
    planned: PlannedRun
    waiting: set[str]
    failures: dict[str, Failure] = field(default_factory=dict)


class SweepDriver:
    """Runs everything that is not finished; a run that fails does not stop the others."""

    def __init__(
        self,
        client: Client,
        store: Store,
        dataset: Dataset,
        terms: Terms,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._client, self._store, self._dataset, self._terms = client, store, dataset, terms
        self._on_progress = on_progress
        # Of this sweep alone: another client's tasks of the same key might write elsewhere.
        self._suffix = uuid.uuid4().hex[:8]
        self._ended = as_completed(loop=client.loop)
        self._futures: dict[str, Future] = {}
        self._names: dict[Future, str] = {}
        self._waiting_for: dict[str, set[str]] = {}  # run ids by name of a task at Dask
        self._open: dict[str, _OpenRun] = {}
        self._failed: dict[str, Failure] = {}  # by task, for the runs that follow
        self._n_submitted = 0
        self._n_workers, self._counted_at = 0, -_COUNT_WORKERS_EVERY_S
        self._tasks, self._tasks_done = Counter[str](), Counter[str]()
        self._runs = self._finished = self._kept = 0
        self.failed_runs: dict[str, str] = {}

    def execute(self, runs: list[Run]) -> Progress:
        """Bring all runs to an end; failed ones are in `failed_runs` with their reasons.

        Raises:
            InputError: workers cannot take part, or the scheduler was lost.
        """
        todo = iter(runs)
        self._runs = len(runs)
        self._fill(todo)
        while self._open:
            self._task_ended(next(self._ended))
            self._fill(todo)
        return self._progress()

    def _progress(self) -> Progress:
        return Progress(
            self._runs,
            self._finished,
            len(self.failed_runs),
            self._kept,
            self._tasks.copy(),
            self._tasks_done.copy(),
        )

    def _fill(self, todo: Iterator[Run]) -> None:
        """Begin further runs, in their order, while there is room."""
        while len(self._futures) < TASKS_PER_WORKER * self._workers():
            run = next(todo, None)
            if run is None:
                break
            self._begin(run)
        self._on_progress(self._progress())

    def _workers(self) -> int:
        if time.monotonic() - self._counted_at > _COUNT_WORKERS_EVERY_S:
            self._n_workers = len(cast(Sized, self._client.nthreads()))
            self._counted_at = time.monotonic()
        return max(self._n_workers, MIN_WORKERS)

    def _begin(self, run: Run) -> None:
        try:
            laid_out = planned(run, self._store, self._dataset)
        except InputError as error:  # no world can be made from this seed, a log is damaged, ...
            self._fail(run, Failure(" ".join(str(error).split())))
            return
        if laid_out.finished:
            self._kept += 1
            return
        opened = _OpenRun(laid_out, set())
        self._open[run.run_id] = opened
        blocked: set[str] = set()
        for task in laid_out.left():
            if task.name in self._failed:
                opened.failures[task.name] = self._failed[task.name]
                blocked.add(task.name)
            elif blocked.intersection(task.needs):
                blocked.add(task.name)
            else:
                self._submit(task)
                opened.waiting.add(task.name)
                self._waiting_for.setdefault(task.name, set()).add(run.run_id)
        self._end_if_over(opened)

    def _submit(self, task: Task) -> None:
        """Hand a task to Dask, unless it is there for another run already."""
        if task.name in self._futures:
            return
        self._tasks[task.label] += 1
        self._n_submitted += 1
        needs = [self._futures[need] for need in task.needs if need in self._futures]
        future = self._client.submit(
            perform,
            task.name,
            pickle.dumps(task),
            self._terms,
            *needs,
            key=f"{task.label}-{self._suffix}-{task.name}",
            pure=False,
            priority=-self._n_submitted,  # in order: a run is finished before others begin
        )
        self._futures[task.name], self._names[future] = future, task.name
        self._ended.add(future)

    def _task_ended(self, future: Future) -> None:
        name = self._names.pop(future)
        del self._futures[name]
        failure = self._failure(future, name)
        for run_id in self._waiting_for.pop(name):
            opened = self._open[run_id]
            opened.waiting.discard(name)
            if failure is not None:
                cause, reason = failure
                opened.failures[cause] = self._failed[cause] = reason
            self._end_if_over(opened)
        self._tasks_done[str(future.key).partition("-")[0]] += 1

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
            cause = str(error.task).split("-", 2)[2]
            kind = cause.partition("/")[0]
            times = error.allowed_failures + 1
            return cause, Failure(f"{kind}: Dask gave it up after {times} of its workers died")
        if isinstance(error, UnfitWorkerError):
            raise InputError(str(error))
        raise InputError(f"a worker cannot run {name}: {type(error).__name__}: {error}")

    def _end_if_over(self, opened: _OpenRun) -> None:
        if opened.waiting:
            return
        run = opened.planned.run
        del self._open[run.run_id]
        if not opened.failures:
            self._finished += 1
            return
        # All tasks that could be done were done, so which comes first does not depend on chance.
        first = next(name for name in opened.planned.tasks if name in opened.failures)
        self._fail(run, opened.failures[first], opened.planned)

    def _fail(self, run: Run, failure: Failure, laid_out: PlannedRun | None = None) -> None:
        self.failed_runs[run.run_id] = failure.reason
        stages = [] if laid_out is None else laid_out.stages
        self._dataset.fail(run, failure.reason, failure.details, stages)


@dataclass(frozen=True)
class Survey:
    """What a sweep would do: tasks by label."""

    runs: int
    runs_finished: int
    runs_refused: int
    wanted: Counter[str]  # over all runs, as if nothing were shared
    finished: Counter[str]  # on disk
    left: Counter[str]  # to be computed


def survey(runs: Iterable[Run], store: Store, dataset: Dataset) -> Survey:
    """Count the tasks of runs, how many are shared between runs and how many are done."""
    known: set[str] = set()
    wanted, finished, left = Counter[str](), Counter[str](), Counter[str]()
    n_runs = n_finished = n_refused = 0
    for run in runs:
        n_runs += 1
        try:
            laid_out = planned(run, store, dataset)
        except InputError:
            n_refused += 1
            continue
        n_finished += laid_out.finished
        todo = {task.name for task in laid_out.left()}
        for name, task in laid_out.tasks.items():
            wanted[task.label] += 1
            if name not in known:
                known.add(name)
                (left if name in todo else finished)[task.label] += 1
    return Survey(n_runs, n_finished, n_refused, wanted, finished, left)
