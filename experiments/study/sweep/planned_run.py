"""One run of a sweep as tasks: those of its scenario, and one that writes its rows."""

from dataclasses import dataclass
from typing import Any

import pandas as pd

from experiments.judge.judged_run import JudgedRun
from experiments.judge.result import all_tables, measure_aligners, renderer
from experiments.run.store import Store
from experiments.run.tasks import Task, task_names, unfinished
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.sweep_dataset import ALIGNER_TIMINGS, RUN_TIMES, SweepDataset

_TABLES = ("errors", "fusion", "robots", "path_statistics", "map_fits", "landmark_nees")
WRITE = "write the tables"  # the label of the task that writes a run's rows


@dataclass(frozen=True)
class PlannedRun:
    """A run and its tasks.

    Attributes:
        run: which one.
        stages: STAGE/KEY of all it is made from.
        tasks: all of them by name; the last one writes the run's rows.
        finished: whether the dataset holds it already.
    """

    run: SweepRun
    stages: list[str]
    tasks: dict[str, Task]
    finished: bool

    def left(self) -> list[Task]:
        """Tasks that are not done yet, each after those it needs."""
        return [] if self.finished else unfinished(self.tasks, [write_name(self.run)])


def write_name(run: SweepRun) -> str:
    """Name of the task that writes a run's rows."""
    return f"run/{run.run_id}"


def planned(run: SweepRun, store: Store, dataset: SweepDataset) -> PlannedRun:
    """Lay out a run; nothing is computed. Raises InputError for what cannot be run."""
    judged = JudgedRun.of(run.load(), store)
    tasks, stages = dict(judged.tasks), stages_of(judged)
    pipeline = judged.pipeline
    read = [stage for robot in pipeline.robots for stage in (robot.log, robot.slam)]
    read += [*(pair.estimates for pair in pipeline.pairs), *judged.judgements]
    needs = tuple(name for stage in read for name in task_names(stage))
    name = write_name(run)
    tasks[name] = Task(name, WRITE, write_rows, (run, judged, dataset), (), needs)
    return PlannedRun(run, stages, tasks, dataset.holds(run, stages))


def stages_of(judged: JudgedRun) -> list[str]:
    """STAGE/KEY of all stages."""
    return [f"{stage.name}/{stage.key}" for stage in judged.stages()]


def write_rows(run: SweepRun, judged: JudgedRun, dataset: SweepDataset) -> None:
    """Write a run's rows of all tables, `runs` last; no maps, no images."""
    dataset.path(ALIGNER_TIMINGS, run).unlink(missing_ok=True)  # of an earlier state of the run
    for name, rows in _run_tables(judged).items():
        dataset.write(name, run, rows)
    dataset.finish(run, renderer(judged.scenario), stages_of(judged))


def _run_tables(judged: JudgedRun) -> dict[str, pd.DataFrame | list[dict[str, Any]]]:
    made = all_tables(judged, judged.load_team())
    return {name: made[name] for name in _TABLES} | {
        RUN_TIMES: [
            {"stage": folder.name, "key": folder.key, "figure": name, "seconds": seconds}
            for folder in judged.folders()
            for name, seconds in folder.figures().items()
        ],
    }


def write_aligner_timings(run: SweepRun, store: Store, dataset: SweepDataset) -> None:
    """Time a finished run's aligners, serially: nothing else may be running."""
    judged = JudgedRun.of(run.load(), store)
    measure_aligners(judged, judged.load_robots())
    dataset.write(ALIGNER_TIMINGS, run, judged.pair_table(ALIGNER_TIMINGS))
