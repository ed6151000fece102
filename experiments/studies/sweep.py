"""Sweep: run all combinations of settings and seeds on all cores or a cluster."""

import itertools
import pickle
import shutil
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Sized
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import cast

import pandas as pd
import pyarrow as pa
from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.evaluation.result import measure_aligners
from experiments.pipeline import cluster
from experiments.pipeline.cluster import connected
from experiments.pipeline.store import mending
from experiments.pipeline.tasks import OnProgress, Task
from experiments.pipeline.workers import single_threaded
from experiments.studies.sweep_combinations import SweepRun
from experiments.studies.sweep_plan import PlannedRun, Sweep, planned
from experiments.studies.sweep_tables import (
    ALIGNER_TIMINGS,
    JoinedTables,
    open_dataset,
    written_by_nobody_else,
)
from mapfusion.errors import InputError
from mapfusion.files import PART, remove_abandoned, temporary_prefix

# Tasks at Dask for each worker. Enough that none waits while this process plans the next run; few
# enough that memory does not grow with the number of runs.
TASKS_PER_WORKER = 30
MIN_WORKERS = 4  # counted, while a cluster is still starting
_COUNT_WORKERS_EVERY_S = 10.0
# A worker may be killed for no fault of its task (a machine that goes away); four times in a row
# while at the same task it is the task.
RETRIES = 3
_ATTEMPTS = "attempts"
# Rows that wait are joined, and so can be read, in a minute; or later, as that must not take more
# than a twentieth of the time: each time a file is written anew.
_JOIN_EVERY_S, _TIMES_AS_LONG = 60.0, 20.0
_OLD_S = 24 * 3600  # in a sweep that runs, tasks begin and end in the meantime


@dataclass
class SweepProgress:
    """How far a sweep is; the driver counts on in it.

    Runs in all; those `done`, which need nothing more; of these the failed ones, with their reasons
    by run id, and which of them are defects of ours. Tasks by label, of the runs looked at so far.
    """

    runs: int
    done: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    defects: set[str] = field(default_factory=set)
    tasks: Counter[str] = field(default_factory=Counter)
    tasks_done: Counter[str] = field(default_factory=Counter)


OnSweepProgress = Callable[[SweepProgress], None]


class SweepDriver:
    """Runs everything that is not finished; a run that fails does not stop the others."""

    def __init__(
        self,
        client: Client,
        sweep: Sweep,
        tables: JoinedTables,
        terms: cluster.Terms,
        on_progress: OnSweepProgress,
        jobs: int | None = None,
    ) -> None:
        """`jobs` are the workers on this machine; None if they are a cluster's."""
        self._client, self._sweep, self._tables = client, sweep, tables
        self._terms, self._jobs = terms, jobs
        self._on_progress = on_progress
        # Of this sweep alone: another client's tasks of the same key might write elsewhere.
        self._suffix = uuid.uuid4().hex[:8]
        self._ended = as_completed(loop=client.loop)
        self._futures: dict[str, Future] = {}  # by name of the task
        self._open: dict[PlannedRun, set[str]] = {}  # with the tasks at Dask that each waits for
        self._failures: dict[str, cluster.TaskFailedError] = {}  # by task
        self._mended = Counter[Path]()  # damaged files of the store
        self._again: set[PlannedRun] = set()  # to be planned anew, since a stage was damaged
        self._n_workers, self._counted_at = 0, -_COUNT_WORKERS_EVERY_S
        self._left_in = Counter(map(tables.number, sweep.runs))  # runs by the file they go into
        self._join_at = time.monotonic() + _JOIN_EVERY_S
        self.progress = SweepProgress(len(sweep.runs))

    def execute(self) -> None:
        """Bring all runs to an end; how they ended is in `progress`.

        Raises:
            InputError: workers cannot take part, or the scheduler was lost.
        """
        todo = iter(self._sweep.runs)
        while True:
            while self._has_room() and (run := next(todo, None)) is not None:
                self._begin(run)
            self._on_progress(self.progress)
            if not self._open:
                break
            self._task_ended(next(self._ended))
        self._tables.join()

    def _has_room(self) -> bool:
        if time.monotonic() - self._counted_at > _COUNT_WORKERS_EVERY_S:
            self._n_workers = len(cast(Sized, self._client.nthreads()))
            self._counted_at = time.monotonic()
        return len(self._futures) < TASKS_PER_WORKER * max(self._n_workers, MIN_WORKERS)

    def _begin(self, run: SweepRun) -> None:
        try:
            laid_out = planned(run, self._sweep.store, self._tables, self._jobs)
        except InputError as error:  # no world can be made from this seed, a log is damaged, ...
            reason = " ".join(str(error).split())
            self.progress.failed[run.run_id] = reason
            self._sweep.dataset.fail(run, reason)
            self._run_ended(run)
            return
        self._open[laid_out] = set()
        blocked: set[str] = set()
        for task in laid_out.left:
            if task.name in self._failures or blocked.intersection(task.needs):
                blocked.add(task.name)
                continue
            if task.name not in self._futures:  # else it is there for another run already
                self._submit(task)
            self._open[laid_out].add(task.name)
        self._end_if_over(laid_out)

    def _submit(self, task: Task) -> None:
        self.progress.tasks[task.label] += 1
        future = self._client.submit(
            cluster.perform,
            task.name,
            pickle.dumps(task),
            self._terms,
            *(self._futures[need] for need in task.needs if need in self._futures),
            # new at each attempt: what failed under a key, Dask does not compute again
            key=f"{task.label}-{self._suffix}{self.progress.tasks.total()}-{task.name}",
            pure=False,
            # in order: a run is finished before others begin
            priority=-self.progress.tasks.total(),
        )
        self._futures[task.name] = future
        self._ended.add(future)

    def _task_ended(self, future: Future) -> None:
        label, name = _label_and_name(future.key)
        if future.status != "finished":
            failure, store = self._failure(future, name), self._sweep.store
            if failure.damage and store.discard_damaged(failure.damage, self._mended):
                self._again |= {each for each in self._open if failure.task in each.tasks}
            else:
                self._failures[failure.task] = failure
        del self._futures[name]
        self.progress.tasks_done[label] += 1
        for laid_out in [each for each, waits_for in self._open.items() if name in waits_for]:
            self._open[laid_out].remove(name)
            self._end_if_over(laid_out)

    def _failure(self, future: Future, name: str) -> cluster.TaskFailedError:
        """Which task failed and why: those that needed it fail like it."""
        if future.status != "error":
            kept = "what was finished is kept, the same command goes on from there"
            raise InputError(f"the connection to the Dask scheduler was lost; {kept}")
        error = future.exception()
        if isinstance(error, cluster.TaskFailedError):
            return error
        if isinstance(error, KilledWorker):
            _, cause = _label_and_name(error.task)
            stage, times = cause.partition("/")[0], error.allowed_failures + 1
            reason = f"{stage}: Dask gave it up after {times} of its workers died"
            return cluster.TaskFailedError(cause, reason)
        if isinstance(error, cluster.UnfitWorkerError):
            raise InputError(str(error))
        raise InputError(f"a worker cannot run {name}: {type(error).__name__}: {error}")

    def _end_if_over(self, laid_out: PlannedRun) -> None:
        if self._open[laid_out]:
            return
        del self._open[laid_out]
        if laid_out in self._again:
            self._again.remove(laid_out)
            self._begin(laid_out.run)
            return
        # All tasks that could be done were done, so which comes first does not depend on chance.
        failures = (self._failures.get(task.name) for task in laid_out.left)
        if first := next(filter(None, failures), None):
            run, reason = laid_out.run, first.reason
            details = self._sweep.dataset.fail(run, reason, first.details, laid_out.stages)
            if first.details:
                reason += f"; its traceback: {details}"
                self.progress.defects.add(run.run_id)
            self.progress.failed[run.run_id] = reason
        self._run_ended(laid_out.run)

    def _run_ended(self, run: SweepRun) -> None:
        """Count it; its rows are joined with those of the last run that goes into their file."""
        self.progress.done += 1
        number, began = self._tables.number(run), time.monotonic()
        self._left_in[number] -= 1
        if not self._left_in[number]:
            self._tables.join(number)
        elif began >= self._join_at:
            self._tables.join()
            took_s = time.monotonic() - began
            self._join_at = began + max(_JOIN_EVERY_S, _TIMES_AS_LONG * took_s)


def _label_and_name(key: object) -> tuple[str, str]:
    """Of the task that Dask knows under this key."""
    label, _, name = str(key).split("-", 2)
    return label, name


def execute(
    sweep: Sweep, jobs: int, scheduler: str | None, on_progress: OnSweepProgress
) -> SweepProgress:
    """Run a sweep; returns how it ended.

    Raises:
        InputError: the output folder is of another sweep, or another command is at work in it; no
            scheduler or no worker is of use.
    """
    folder = sweep.dataset.folder
    with written_by_nobody_else(folder):
        tables = open_dataset(sweep.dataset, sweep.runs)
        for left_behind in folder.glob(f".{_ATTEMPTS}.*"):  # by a sweep killed on any machine
            if time.time() - left_behind.stat().st_mtime > _OLD_S:  # else another may be running
                shutil.rmtree(left_behind, ignore_errors=True)
        named = PART, temporary_prefix(_ATTEMPTS)
        own = tempfile.TemporaryDirectory(*named, folder, ignore_cleanup_errors=True)
        with own as attempts, connected(jobs, scheduler) as client:
            terms = cluster.Terms(Path(attempts), RETRIES, cluster.code_version())
            local = None if scheduler else jobs
            driver = SweepDriver(client, sweep, tables, terms, on_progress, local)
            driver.execute()
        remove_abandoned(folder)  # by earlier sweeps, and by workers of this one, that were killed
    return driver.progress


def measure_times(sweep: Sweep, failed: Collection[str], on_progress: OnProgress) -> None:
    """Aligners' times, serial, for all runs without that did not fail: nothing else may run.

    They are in the store run by run, and go into the table file by file.
    """
    single_threaded()
    label, done = "time the aligners", 0
    runs = [run for run in sweep.runs if run.run_id not in failed]
    with written_by_nobody_else(sweep.dataset.folder):
        tables = open_dataset(sweep.dataset, runs)
        for number, group in itertools.groupby(sorted(runs, key=tables.place), key=tables.number):
            timed, rows = tables.runs_in(ALIGNER_TIMINGS, number), dict[int, pa.Table]()
            for run in group:
                on_progress(label, done, len(runs))
                done += 1
                if run.run_id not in timed:
                    measured = mending(sweep.store, partial(_measured, sweep, run))
                    rows[tables.place(run)] = sweep.dataset.rows(ALIGNER_TIMINGS, run, measured)
            if rows:
                tables.replace(ALIGNER_TIMINGS, number, rows)
    on_progress(label, len(runs), len(runs))


def _measured(sweep: Sweep, run: SweepRun) -> pd.DataFrame:
    judged = JudgedRun.of(run.load(), sweep.store)
    judged.execute(1, lambda *_: None)  # what is there already, but for a damaged stage
    measure_aligners(judged)
    return judged.pair_table(ALIGNER_TIMINGS)
