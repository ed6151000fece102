"""Sweep: run all combinations of settings and seeds on all cores or a cluster."""

import itertools
import pickle
import shutil
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Sequence, Sized
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import pandas as pd
import pyarrow as pa
from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.evaluation.result import measure_aligners
from experiments.pipeline import cluster
from experiments.pipeline.cluster import dask_client
from experiments.pipeline.store import retry_damaged
from experiments.pipeline.tasks import OnProgress, Task
from experiments.pipeline.workers import single_threaded
from experiments.studies.sweep_combinations import SweepRun
from experiments.studies.sweep_plan import PlannedRun, Sweep, planned
from experiments.studies.sweep_tables import ALIGNER_TIMINGS, JoinedTables, written_by_nobody_else
from mapfusion.errors import InputError
from mapfusion.files import PART, remove_abandoned, temporary_prefix, write_whole

# Tasks that Dask holds for each worker. Enough that no worker waits while this process plans the
# next run; few enough that memory does not grow with the number of runs.
TASKS_PER_WORKER = 30
MIN_WORKERS = 4  # assumed while a cluster is still starting
_COUNT_WORKERS_EVERY_S = 10.0
# A worker may be killed without a fault of its task, for example with its machine. A task whose
# worker was killed four times is at fault.
RETRIES = 3
_ATTEMPTS = "attempts"
# Rows are written, and can be read, after a minute; or later, because to replace files shall not
# take more than a twentieth of the time. Rows of this size are always written: memory is bounded.
_WRITE_EVERY_S, _TIMES_AS_LONG, _MOST_WAITING_BYTES = 60.0, 20.0, 50_000_000
_OLD_S = 24 * 3600  # a folder of attempts that has not changed for so long is not in use


@dataclass
class SweepProgress:
    """Progress of a sweep; the driver updates it.

    Attributes:
        runs: number of all runs.
        done: number of runs that have ended, finished or failed.
        failed: reasons by run id.
        defects: ids of the runs that failed because of a defect of this program.
        tasks: number of tasks by label, of the runs that were planned so far.
        tasks_done: number of these that have ended.
    """

    runs: int
    done: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    defects: set[str] = field(default_factory=set)
    tasks: Counter[str] = field(default_factory=Counter)
    tasks_done: Counter[str] = field(default_factory=Counter)


OnSweepProgress = Callable[[SweepProgress], None]


class SweepDriver:
    """Driver of all runs that are not finished; a run that fails does not stop the others."""

    def __init__(
        self,
        client: Client,
        sweep: Sweep,
        tables: JoinedTables,
        terms: cluster.SweepTerms,
        on_progress: OnSweepProgress,
        jobs: int | None = None,
    ) -> None:
        """Take the number of workers on this machine as `jobs`; None if a cluster has them."""
        self._client, self._sweep, self._tables = client, sweep, tables
        self._terms, self._jobs = terms, jobs
        self._on_progress = on_progress
        # Keys are unique to this sweep: another client's task of the same key may write elsewhere.
        self._suffix = uuid.uuid4().hex[:8]
        self._ended = as_completed(loop=client.loop)
        self._futures: dict[str, Future] = {}  # by name of the task
        self._open: dict[PlannedRun, set[str]] = {}  # the tasks at Dask that each run waits for
        self._failures: dict[str, cluster.TaskFailedError] = {}  # by name of the task
        self._mended = Counter[Path]()  # damaged files of the store
        self._again: set[PlannedRun] = set()  # runs to be planned again: a stage was damaged
        self._n_workers, self._counted_at = 0, -_COUNT_WORKERS_EVERY_S
        self._left_in = Counter(map(tables.number, sweep.runs))  # runs by the file they go into
        self._write_at = time.monotonic() + _WRITE_EVERY_S
        self.progress = SweepProgress(len(sweep.runs))

    def execute(self) -> None:
        """Finish all runs; `progress` says how they ended.

        Raises:
            InputError: workers cannot take part, or the scheduler was lost.
        """
        todo = iter(self._sweep.runs)
        try:
            while True:
                while self._has_room() and (run := next(todo, None)) is not None:
                    self._begin(run)
                self._on_progress(self.progress)
                if not self._open:
                    break
                self._task_ended(next(self._ended))
        finally:  # also after Ctrl-C
            self._tables.write()

    def _has_room(self) -> bool:
        if time.monotonic() - self._counted_at > _COUNT_WORKERS_EVERY_S:
            self._n_workers = len(cast(Sized, self._client.nthreads()))
            self._counted_at = time.monotonic()
        return len(self._futures) < TASKS_PER_WORKER * max(self._n_workers, MIN_WORKERS)

    def _begin(self, run: SweepRun) -> None:
        try:
            laid_out = planned(run, self._sweep.store, self._tables, self._jobs)
        except InputError as error:  # no world can be made from this seed, a log is damaged, ...
            self._failed(run, " ".join(str(error).split()))
            self._run_ended(run)
            return
        self._open[laid_out] = set()
        blocked: set[str] = set()
        for task in laid_out.left:
            if task.name in self._failures or blocked.intersection(task.needs):
                blocked.add(task.name)
                continue
            if task.name not in self._futures:  # else another run has submitted it
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
            # new at each attempt: Dask does not repeat a task that failed under the same key
            key=f"{task.label}-{self._suffix}{self.progress.tasks.total()}-{task.name}",
            pure=False,
            # earlier tasks first: a run is finished before others begin
            priority=-self.progress.tasks.total(),
        )
        self._futures[task.name] = future
        self._ended.add(future)

    def _task_ended(self, future: Future) -> None:
        label, name = _label_and_name(future.key)
        waiting = [each for each, waits_for in self._open.items() if name in waits_for]
        own = [laid_out.run for laid_out in waiting if laid_out.last == name]
        rows: Any = None
        if own and future.status == "finished":
            try:
                rows = future.result()
            except Exception:
                if future.status == "finished":
                    raise  # else the worker that held the rows was lost, and it was tried again
        if future.status != "finished":
            failure, store = self._failure(future, name), self._sweep.store
            if failure.damage and store.discard_damaged(failure.damage, self._mended):
                self._again |= {each for each in self._open if failure.task in each.tasks}
            else:
                self._failures[failure.task] = failure
        elif own:
            self._tables.add(own[0], rows)
            self._details(own[0]).unlink(missing_ok=True)
        del self._futures[name]
        self.progress.tasks_done[label] += 1
        for laid_out in waiting:
            self._open[laid_out].remove(name)
            self._end_if_over(laid_out)

    def _failure(self, future: Future, name: str) -> cluster.TaskFailedError:
        """Return the failure of a task or of the task that it needed.

        Raises:
            InputError: the scheduler was lost, or workers cannot take part.
        """
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
            self._failed(laid_out.run, first.reason, first.details, laid_out.stages)
        self._run_ended(laid_out.run)

    def _failed(
        self, run: SweepRun, reason: str, traceback: str = "", stages: Sequence[str] = ()
    ) -> None:
        self._tables.add(run, self._sweep.dataset.failed(run, reason, stages))
        path = self._details(run)
        path.unlink(missing_ok=True)
        if traceback:
            text = traceback.encode("utf-8", "backslashreplace")  # an exception's text may be any
            write_whole(path, lambda file: file.write_bytes(text))
            reason += f"; its traceback: {path}"
            self.progress.defects.add(run.run_id)
        self.progress.failed[run.run_id] = reason

    def _details(self, run: SweepRun) -> Path:
        return self._sweep.dataset.folder / "failures" / f"{run.run_id}.txt"

    def _run_ended(self, run: SweepRun) -> None:
        self.progress.done += 1
        number, began = self._tables.number(run), time.monotonic()
        self._left_in[number] -= 1
        is_due = began >= self._write_at or self._tables.waiting_bytes > _MOST_WAITING_BYTES
        if is_due or not self._left_in[number]:  # all runs of a file are done
            self._tables.write()
            took_s = time.monotonic() - began
            self._write_at = began + max(_WRITE_EVERY_S, _TIMES_AS_LONG * took_s)


def _label_and_name(key: object) -> tuple[str, str]:
    """Return label and name of the task that Dask knows under this key."""
    label, _, name = str(key).split("-", 2)
    return label, name


def execute(
    sweep: Sweep, jobs: int, scheduler: str | None, on_progress: OnSweepProgress
) -> SweepProgress:
    """Run a sweep on `jobs` processes, or on the scheduler at an address.

    Returns:
        The final progress.

    Raises:
        InputError: the output folder holds another sweep, or another command writes into it; no
            scheduler answers, or no worker can take part.
    """
    folder = sweep.dataset.folder
    with written_by_nobody_else(folder):
        tables = JoinedTables(sweep.dataset)
        tables.ask_for(sweep.runs)
        for abandoned in folder.glob(f".{_ATTEMPTS}.*"):  # by a sweep that was killed
            if time.time() - abandoned.stat().st_mtime > _OLD_S:  # else it may still be in use
                shutil.rmtree(abandoned, ignore_errors=True)
        named = PART, temporary_prefix(_ATTEMPTS)
        own = tempfile.TemporaryDirectory(*named, folder, ignore_cleanup_errors=True)
        with own as attempts, dask_client(jobs, scheduler) as client:
            terms = cluster.SweepTerms(Path(attempts), RETRIES, cluster.code_version())
            local = None if scheduler else jobs
            driver = SweepDriver(client, sweep, tables, terms, on_progress, local)
            driver.execute()
        remove_abandoned(folder)  # by processes that were killed
    return driver.progress


def measure_times(sweep: Sweep, failed: Collection[str], on_progress: OnProgress) -> None:
    """Measure the aligners' times for all runs that did not fail and have none yet.

    Measurements are serial; nothing else may run on the machine. The store keeps the times of each
    run; the table is written file by file.
    """
    single_threaded()
    label, done = "time the aligners", 0
    runs = [run for run in sweep.runs if run.run_id not in failed]
    with written_by_nobody_else(sweep.dataset.folder):
        tables = JoinedTables(sweep.dataset)
        tables.ask_for(runs)
        for number, group in itertools.groupby(sorted(runs, key=tables.number), tables.number):
            timed, rows = tables.runs_in(ALIGNER_TIMINGS, number), dict[str, pa.Table]()
            for run in group:
                on_progress(label, done, len(runs))
                done += 1
                if run.run_id not in timed:
                    measured = retry_damaged(sweep.store, partial(_measured, sweep, run))
                    rows[run.run_id] = sweep.dataset.rows(ALIGNER_TIMINGS, run, measured)
            if rows:
                tables.replace(ALIGNER_TIMINGS, number, rows)
    on_progress(label, len(runs), len(runs))


def _measured(sweep: Sweep, run: SweepRun) -> pd.DataFrame:
    judged = JudgedRun.of(run.load(), sweep.store)
    judged.execute(1, lambda *_: None)  # makes damaged stages again; all others exist
    measure_aligners(judged)
    return judged.pair_table(ALIGNER_TIMINGS)
