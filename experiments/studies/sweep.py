"""Sweep: run all combinations of settings and seeds on all cores or a cluster."""

import itertools
import json
import pickle
import shutil
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import pandas as pd
import pyarrow as pa
from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.result import all_tables, measure_aligners, renderer
from experiments.evaluation.run_plan import require_drive_of
from experiments.pipeline import cluster
from experiments.pipeline.cluster import dask_client
from experiments.pipeline.stages.pipeline import require_memory
from experiments.pipeline.store import Store, retry_damaged
from experiments.pipeline.tasks import OnProgress, Task, task_names, unfinished
from experiments.pipeline.workers import single_threaded
from experiments.scenario.settings import Simulation
from experiments.scenario.suite import scenarios_of, with_aligners
from experiments.scenario.yaml_files import apply_overrides, parse_value, read_mapping
from experiments.studies.sweep_tables import (
    ALIGNER_TIMINGS,
    RUN_TIMES,
    JoinedTables,
    SweepDataset,
    SweepRun,
    locked_folder,
)
from mapfusion.errors import InputError
from mapfusion.files import PART, remove_abandoned, temporary_prefix, write_atomically
from sim.renderer import require_pybullet

_EXPECTED = "expected key=value,value, for example slam.filter.n_particles=50,200"
_ALIGNER_LISTS = {"align.aligners", "align.also"}
_FIXED = {"seed": "--seeds 0..4", "name": "one sweep for each name"}

# Values of each dotted key, as YAML in one spelling (0.10 is 0.1).
Axes = Mapping[str, tuple[str, ...]]


def parse_axes(entries: Sequence[str], option: str = "--set") -> Axes:
    """Parse `OPTION KEY=VALUE,VALUE,...`; raises InputError that shows the correct form."""
    axes: dict[str, tuple[str, ...]] = {}
    for entry in entries:
        key, _, listed = entry.partition("=")
        if not key or not listed.strip():
            raise InputError(f"{option} {entry}: {_EXPECTED}")
        if key in _FIXED:
            raise InputError(f"{option} {entry}: {key} cannot be set here; use {_FIXED[key]}")
        if key in axes:
            raise InputError(f"{option} {key}: given twice; write its values as {key}=A,B")
        values = parse_value(f"[{listed}]", f"{option} {entry}: {_EXPECTED}")
        # Text stays as it is unless YAML would read another type; everything else becomes JSON.
        axes[key] = tuple(
            value
            if isinstance(value, str) and parse_value(value, option) == value
            else json.dumps(value, default=str)
            for value in values
        )
        for value in axes[key]:
            if axes[key].count(value) > 1:
                raise InputError(f"{option} {entry}: {value} is given twice")
    return axes


def runs_of(
    paths: Sequence[Path], seeds: Sequence[int], axes: Axes, aligners: Sequence[str] = ()
) -> list[SweepRun]:
    """Return all combinations; runs that share many stages follow each other.

    Each scenario file is read once. It is loaded with every combination of values, so a wrong value
    is reported before anything is computed. The aligners of `with_aligners` replace those of the
    file, and the values of `axes` apply to them.

    Raises:
        InputError: a scenario, key, value or aligner is wrong, two scenarios have the same name, or
            PyBullet is not installed.
    """
    if aligners and (listed := axes.keys() & _ALIGNER_LISTS):
        raise InputError(f"--aligner: --set {min(listed)} gives aligners, too; use one of the two")
    choices = ([(key, value) for value in values] for key, values in axes.items())
    combinations = list(itertools.product(*choices))
    runs: list[SweepRun] = []
    names: dict[str, Path] = {}
    for path in paths:
        content = apply_overrides(read_mapping(path), with_aligners(path, (), aligners))
        loaded = [SweepRun(path, "", seeds[0], each, content).load() for each in combinations]
        if any(isinstance(scenario, Simulation) for scenario in loaded):
            require_pybullet()
        (name,) = {scenario.name for scenario in loaded}
        if names.setdefault(name, path) != path:
            raise InputError(f"{path}: is named {name}, as {names[name]} is; names must differ")
        runs += [
            SweepRun(path, name, *each, content) for each in itertools.product(seeds, combinations)
        ]
    if len({run.run_id for run in runs}) < len(runs):
        raise InputError("--set: two combinations of values have the same hash; split the sweep")
    return runs


class Shard(NamedTuple):
    """Part of a sweep: one of `count` blocks of consecutive runs, numbered from 1."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Parse NUMBER/COUNT; raises InputError that shows the correct form."""
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise InputError(f"--shard {text}: expected NUMBER/COUNT, from 1/4 to 4/4 for four")
        return cls(int(number), int(count))

    def of(self, runs: Sequence[SweepRun]) -> list[SweepRun]:
        """Return the runs of this block; consecutive runs share most stages."""
        first, end = (len(runs) * k // self.count for k in (self.number - 1, self.number))
        return list(runs[first:end])

    def __str__(self) -> str:
        # with leading zeros, so that the order of the names is that of the numbers
        return f"{self.number:0{len(str(self.count))}d}-of-{self.count}"


_LONGEST_NAME = 80
_TABLES = (
    "errors",
    "smoothed_errors",
    "fusion",
    "robots",
    "path_statistics",
    "map_fits",
    "landmark_nees",
)
_TABLES += ("sightings", "smoother", "team", "team_pairs", "fusers", "team_members", "adoptions")


class Sweep(NamedTuple):
    """Runs of a sweep, the store that it shares with `mapfusion run`, and its tables."""

    runs: list[SweepRun]
    store: Store
    dataset: SweepDataset


def prepare(
    asked: Sequence[str | Path],
    seeds: Sequence[int],
    settings: Sequence[str],
    results: Path,
    output: Path | None = None,
    aligners: Sequence[str] = (),
    shard: Shard | None = None,
) -> Sweep:
    """Check what the user asked for, `settings` as in `--set`; nothing is written.

    Without `output`, the sweep's folder is named after the scenario files, names and tags, and
    after the shard if only this part of the runs is wanted.

    Raises:
        InputError: a scenario, key or value is wrong, or the shard has no runs.
    """
    axes = parse_axes(settings)
    runs = runs_of(scenarios_of(asked), seeds, axes, aligners)
    name = "-".join(Path(part).stem for part in asked)[:_LONGEST_NAME]
    if shard is not None:
        n_runs, runs, name = len(runs), shard.of(runs), f"{name}.{shard}"
        if not runs:
            raise InputError(f"--shard {shard.number}/{shard.count}: the sweep has {n_runs} runs")
    folder = output or results / "sweeps" / name
    # absolute: workers may have been started elsewhere
    return Sweep(runs, Store.of(results.resolve()), SweepDataset(folder.resolve(), tuple(axes)))


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """A run and its tasks.

    Attributes:
        run: scenario, seed and values.
        stages: STAGE/KEY of all stages that the run is made from.
        tasks: all tasks by name; the last one, `run/RUN_ID`, returns the run's rows.
        left: tasks to be done, each after those it needs; none if the tables hold the run.
    """

    run: SweepRun
    stages: list[str]
    tasks: dict[str, Task]
    left: list[Task]

    @property
    def last(self) -> str:
        """Name of the last task."""
        return f"run/{self.run.run_id}"


def plan_run(
    run: SweepRun, store: Store, tables: JoinedTables, jobs: int | None = None
) -> PlannedRun:
    """Plan a run; nothing is computed.

    Args:
        run: scenario, seed and values.
        store: finished stages.
        tables: finished runs.
        jobs: number of processes that share this machine's memory; None for a cluster.

    Raises:
        InputError: the run is impossible.
    """
    evaluated = EvaluatedRun.of(run.load(), store)
    if jobs is not None:
        require_memory(evaluated.pipeline, jobs)
    pipeline = evaluated.pipeline
    stages = [f"{each.name}/{each.key}" for each in evaluated.stages()]
    read = [stage for robot in pipeline.robots for stage in (robot.log, robot.slam, robot.smooth)]
    read += [*(pair.filtered.estimates for pair in pipeline.pairs), *evaluated.evaluations]
    read += pipeline.fusers.values()
    read += [] if pipeline.team is None else [pipeline.team]
    needs = tuple(name for stage in read for name in task_names(stage))
    name, arguments = f"run/{run.run_id}", (run, evaluated, stages, tables.dataset)
    last = Task(name, "write the tables", rows_of, arguments, (), needs)
    tasks = evaluated.tasks | {name: last}
    left = [] if tables.holds(run, stages) else unfinished(tasks, [name])
    return PlannedRun(run, stages, tasks, left)


def rows_of(
    run: SweepRun, evaluated: EvaluatedRun, stages: Sequence[str], dataset: SweepDataset
) -> dict[str, pa.Table]:
    """Return a run's rows of all tables (work of the last task)."""
    made = all_tables(evaluated, evaluated.team, _TABLES)
    times = [
        {"stage": folder.name, "key": folder.key, "figure": name, "seconds": seconds}
        for folder in evaluated.folders()
        for name, seconds in folder.quantities().items()
    ]
    return dataset.finished(run, renderer(evaluated.scenario), stages, {**made, RUN_TIMES: times})


@dataclass
class Survey:
    """Counts of runs, and of tasks by label.

    Attributes:
        runs: number of all runs.
        runs_finished: number of runs that the tables hold.
        runs_refused: number of runs that are impossible.
        why_refused: reason of the first of these runs.
        wanted: tasks summed over all runs, without sharing.
        finished: different tasks that are done.
        left: different tasks to be done.
    """

    runs: int
    runs_finished: int = 0
    runs_refused: int = 0
    why_refused: str = ""
    wanted: Counter[str] = field(default_factory=Counter)
    finished: Counter[str] = field(default_factory=Counter)
    left: Counter[str] = field(default_factory=Counter)


def require_robots_drive(run: SweepRun, store: Store) -> None:
    """Raise InputError if the robots of a run cannot drive as its scenario says."""
    require_drive_of(EvaluatedRun.of(run.load(), store))


def survey(sweep: Sweep) -> Survey:
    """Count runs and tasks, and how many of them are done; nothing is computed."""
    found, tables = Survey(len(sweep.runs)), JoinedTables(sweep.dataset)
    known: set[str] = set()
    for run in sweep.runs:
        try:
            require_robots_drive(run, sweep.store)
            plan = plan_run(run, sweep.store, tables)
        except InputError as error:
            found.runs_refused += 1
            found.why_refused = found.why_refused or f"{run.run_id}: {error}"
            continue
        found.runs_finished += not plan.left
        left = {task.name for task in plan.left}
        found.wanted.update(task.label for task in plan.tasks.values())
        for name in plan.tasks.keys() - known:
            (found.left if name in left else found.finished)[plan.tasks[name].label] += 1
        known.update(plan.tasks)
    return found


# Tasks that Dask holds for each worker. Enough that no worker waits while this process plans the
# next run; few enough that memory does not grow with the number of runs.
TASKS_PER_WORKER = 30
MIN_WORKERS = 4  # assumed while a cluster is still starting
_COUNT_WORKERS_EVERY_S = 10.0
# A worker may be killed without a fault of its task, for example with its machine. A task whose
# worker was killed four times is at fault.
RETRIES = 3
_ATTEMPTS = "attempts"
# Rows are written every minute, or less often so that writing takes at most a twentieth of the
# time. Rows of more bytes than the last constant are always written, which bounds the memory.
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
    """Driver of all runs that are not finished; a failed run does not stop the others."""

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
        """Finish all runs; `progress` has the outcomes.

        Raises:
            InputError: workers cannot take part, or the scheduler was lost.
        """
        todo = iter(self._sweep.runs)
        try:
            while True:
                if time.monotonic() - self._counted_at > _COUNT_WORKERS_EVERY_S:
                    self._n_workers = len(cast(Sized, self._client.nthreads()))
                    self._counted_at = time.monotonic()
                limit = TASKS_PER_WORKER * max(self._n_workers, MIN_WORKERS)
                while len(self._futures) < limit and (run := next(todo, None)) is not None:
                    self._start_run(run)
                self._on_progress(self.progress)
                if not self._open:
                    break
                self._task_ended(next(self._ended))
        finally:  # also after Ctrl-C
            self._tables.write()

    def _start_run(self, run: SweepRun) -> None:
        """Plan a run and submit its tasks, except those that others have submitted."""
        try:
            plan = plan_run(run, self._sweep.store, self._tables, self._jobs)
        except InputError as error:  # no world can be made from this seed, a log is damaged, ...
            self._failed(run, " ".join(str(error).split()))
            self._run_ended(run)
            return
        self._open[plan] = set()
        blocked: set[str] = set()
        for task in plan.left:
            if task.name in self._failures or blocked.intersection(task.needs):
                blocked.add(task.name)
                continue
            if task.name not in self._futures:  # else another run has submitted the task
                self.progress.tasks[task.label] += 1
                number = self.progress.tasks.total()
                future = self._client.submit(
                    cluster.perform,
                    task.name,
                    pickle.dumps(task),
                    self._terms,
                    *(self._futures[need] for need in task.needs if need in self._futures),
                    # A new key at each attempt: Dask does not repeat a failed task of the same key.
                    key=f"{task.label}-{self._suffix}{number}-{task.name}",
                    pure=False,
                    priority=-number,  # earlier tasks first: a run is finished before others begin
                )
                self._futures[task.name] = future
                self._ended.add(future)
            self._open[plan].add(task.name)
        self._end_if_over(plan)

    def _task_ended(self, future: Future) -> None:
        """Take the result or the failure of a task, and end the runs that waited for the task."""
        if future.status in ("lost", "pending"):  # its worker died since it had ended
            self._ended.add(future)  # Dask performs the task again
            return
        label, name = _label_and_name(future.key)
        waiting = [each for each, waits_for in self._open.items() if name in waits_for]
        own = [plan.run for plan in waiting if plan.last == name]
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
        for plan in waiting:
            self._open[plan].remove(name)
            self._end_if_over(plan)

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

    def _end_if_over(self, plan: PlannedRun) -> None:
        """End a run without open tasks, or plan the run again if a stage was damaged."""
        if self._open[plan]:
            return
        del self._open[plan]
        if plan in self._again:
            self._again.remove(plan)
            self._start_run(plan.run)
            return
        # All possible tasks were done, so the first failure does not depend on timing.
        failures = (self._failures.get(task.name) for task in plan.left)
        if first := next(filter(None, failures), None):
            self._failed(plan.run, first.reason, first.details, plan.stages)
        self._run_ended(plan.run)

    def _failed(
        self, run: SweepRun, reason: str, traceback: str = "", stages: Sequence[str] = ()
    ) -> None:
        self._tables.add(run, self._sweep.dataset.failed(run, reason, stages))
        path = self._details(run)
        path.unlink(missing_ok=True)
        if traceback:
            text = traceback.encode("utf-8", "backslashreplace")  # an exception's text may be any
            write_atomically(path, lambda file: file.write_bytes(text))
            reason += f"; its traceback: {path}"
            self.progress.defects.add(run.run_id)
        self.progress.failed[run.run_id] = reason

    def _details(self, run: SweepRun) -> Path:
        return self._sweep.dataset.folder / "failures" / f"{run.run_id}.txt"

    def _run_ended(self, run: SweepRun) -> None:
        """Count a run, and write the tables if that is due."""
        self.progress.done += 1
        number, began = self._tables.number(run), time.monotonic()
        self._left_in[number] -= 1
        is_due = began >= self._write_at or self._tables.waiting_bytes > _MOST_WAITING_BYTES
        if is_due or not self._left_in[number]:  # all runs of a file are done
            self._tables.write()
            took_s = time.monotonic() - began
            self._write_at = began + max(_WRITE_EVERY_S, _TIMES_AS_LONG * took_s)


def _label_and_name(key: object) -> tuple[str, str]:
    """Return label and name of the task of this key at Dask."""
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
    with locked_folder(folder):
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

    def measured(run: SweepRun) -> pd.DataFrame:
        evaluated = EvaluatedRun.of(run.load(), sweep.store)
        evaluated.execute(1, lambda *_: None)  # makes damaged stages again; all others exist
        measure_aligners(evaluated)
        return evaluated.pair_table(ALIGNER_TIMINGS)

    single_threaded()
    label, done = "time the aligners", 0
    runs = [run for run in sweep.runs if run.run_id not in failed]
    with locked_folder(sweep.dataset.folder):
        tables = JoinedTables(sweep.dataset)
        tables.ask_for(runs)
        for number, group in itertools.groupby(sorted(runs, key=tables.number), tables.number):
            timed, rows = tables.runs_in(ALIGNER_TIMINGS, number), dict[str, pa.Table]()
            for run in group:
                on_progress(label, done, len(runs))
                done += 1
                if run.run_id not in timed:
                    timings = retry_damaged(sweep.store, partial(measured, run))
                    rows[run.run_id] = sweep.dataset.rows(ALIGNER_TIMINGS, run, timings)
            if rows:
                tables.replace(ALIGNER_TIMINGS, number, rows)
    on_progress(label, len(runs), len(runs))
