"""Plan of a sweep: scenarios x seeds x values, as tasks."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from experiments.evaluation.evaluated_run import JudgedRun
from experiments.evaluation.result import all_tables, renderer
from experiments.pipeline.stages.memory import require_memory
from experiments.pipeline.store import Store
from experiments.pipeline.tasks import Task, task_names, unfinished
from experiments.scenario.suite import scenarios_of
from experiments.studies.sweep_combinations import SweepRun, parse_axes, runs_of
from experiments.studies.sweep_tables import RUN_TIMES, JoinedTables, SweepDataset
from mapfusion.errors import InputError

_LONGEST_NAME = 80
_TABLES = ("errors", "fusion", "robots", "path_statistics", "map_fits", "landmark_nees")
_TABLES += ("smoother", "team", "team_pairs", "fusers")


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
) -> Sweep:
    """Check what the user asked for, `settings` as in `--set`; nothing is written.

    Without `output`, the sweep's folder is named after the scenario files, names and tags.

    Raises:
        InputError: a scenario, key or value is wrong.
    """
    axes = parse_axes(settings)
    runs = runs_of(scenarios_of(asked), seeds, axes)
    name = "-".join(Path(part).stem for part in asked)[:_LONGEST_NAME]
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


def planned(
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
    judged = JudgedRun.of(run.load(), store)
    if jobs is not None:
        require_memory(judged.pipeline, jobs)
    pipeline, stages = judged.pipeline, [f"{each.name}/{each.key}" for each in judged.stages()]
    read = [stage for robot in pipeline.robots for stage in (robot.log, robot.slam, robot.smooth)]
    read += [*(pair.estimates for pair in pipeline.pairs), *judged.judgements]
    read += pipeline.fusers.values()
    needs = tuple(name for stage in read for name in task_names(stage))
    name, arguments = f"run/{run.run_id}", (run, judged, stages, tables.dataset)
    last = Task(name, "write the tables", rows_of, arguments, (), needs)
    tasks = judged.tasks | {name: last}
    left = [] if tables.holds(run, stages) else unfinished(tasks, [name])
    return PlannedRun(run, stages, tasks, left)


def rows_of(
    run: SweepRun, judged: JudgedRun, stages: Sequence[str], dataset: SweepDataset
) -> dict[str, pa.Table]:
    """Return a run's rows of all tables (work of the last task)."""
    made = all_tables(judged, judged.load_team(), _TABLES)
    times = [
        {"stage": folder.name, "key": folder.key, "figure": name, "seconds": seconds}
        for folder in judged.folders()
        for name, seconds in folder.figures().items()
    ]
    return dataset.finished(run, renderer(judged.scenario), stages, {**made, RUN_TIMES: times})


@dataclass
class Survey:
    """Counts of runs, and of tasks by label.

    Attributes:
        runs: number of all runs.
        runs_finished: number of runs that the tables hold.
        runs_refused: number of runs that are impossible.
        wanted: tasks summed over all runs, without sharing.
        finished: different tasks that are done.
        left: different tasks to be done.
    """

    runs: int
    runs_finished: int = 0
    runs_refused: int = 0
    wanted: Counter[str] = field(default_factory=Counter)
    finished: Counter[str] = field(default_factory=Counter)
    left: Counter[str] = field(default_factory=Counter)


def survey(sweep: Sweep) -> Survey:
    """Count runs and tasks, and how many of them are done; nothing is computed."""
    found, tables = Survey(len(sweep.runs)), JoinedTables(sweep.dataset)
    known: set[str] = set()
    for run in sweep.runs:
        try:
            laid_out = planned(run, sweep.store, tables)
        except InputError:
            found.runs_refused += 1
            continue
        found.runs_finished += not laid_out.left
        left = {task.name for task in laid_out.left}
        found.wanted.update(task.label for task in laid_out.tasks.values())
        for name in laid_out.tasks.keys() - known:
            (found.left if name in left else found.finished)[laid_out.tasks[name].label] += 1
        known.update(laid_out.tasks)
    return found
