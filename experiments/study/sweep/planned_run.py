"""One run of a sweep as tasks: those of its scenario, and one that writes its rows."""

from dataclasses import dataclass
from typing import Any

import pandas as pd

from experiments.judge.consistency import landmark_nees_rows
from experiments.judge.fused_landmarks import map_fit_rows
from experiments.judge.judging import load_robot
from experiments.judge.pipeline import Plan, plan, task_name, tasks_of
from experiments.judge.provenance import renderer
from experiments.judge.result import fused_map, measure_aligners, pair_table, robot_tables
from experiments.run.store import StageFolder, Store
from experiments.run.tasks import Task, unfinished
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.sweep_dataset import ALIGNER_TIMINGS, RUN_TIMES, SweepDataset

WRITE = "tables"  # the kind of the task that writes a run's rows


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
    laid_out = plan(run.load(), store)
    tasks, stages = tasks_of(laid_out), stages_of(laid_out)
    read = [folder for robot in laid_out.robots for folder in (robot.log, robot.slam)]
    read += [folder for pair in laid_out.pairs for folder in (pair.align, pair.judge)]
    needs = tuple(name for name in map(task_name, read) if name in tasks)
    name = write_name(run)
    tasks[name] = Task(name, WRITE, write_rows, (run, laid_out, dataset), (), needs)
    return PlannedRun(run, stages, tasks, dataset.holds(run, stages))


def stages_of(laid_out: Plan) -> list[str]:
    """STAGE/KEY of all stages, the aligners' own among them."""
    return [task_name(folder) for folder in (*laid_out.folders(), *_aligner_parts(laid_out))]


def _aligner_parts(laid_out: Plan) -> list[StageFolder]:
    return [part for pair in laid_out.pairs for part in (pair.parts.match, *pair.parts.aligners)]


def write_rows(run: SweepRun, laid_out: Plan, dataset: SweepDataset) -> None:
    """Write a run's rows of all tables, `runs` last; no maps, no images."""
    dataset.path(ALIGNER_TIMINGS, run).unlink(missing_ok=True)  # of an earlier state of the run
    for name, rows in _run_tables(laid_out).items():
        dataset.write(name, run, rows)
    dataset.finish(run, renderer(laid_out.scenario), stages_of(laid_out))


def _run_tables(laid_out: Plan) -> dict[str, pd.DataFrame | list[dict[str, Any]]]:
    robots = [load_robot(robot.folders) for robot in laid_out.robots]
    of_robots = robot_tables(laid_out, robots)
    last = max(max(robot.maps) for robot in robots)
    estimates, offered = (pair_table(laid_out, name) for name in ("estimates", "correspondences"))
    fused = fused_map(laid_out.scenario.merge, robots, estimates, offered, last)
    radius_m = laid_out.scenario.evaluate.true_pair_radius_m
    return {
        "errors": pair_table(laid_out, "errors"),
        "fusion": pair_table(laid_out, "fusion"),
        "robots": of_robots["robots"],
        "path_statistics": of_robots["path_statistics"],
        "map_fits": map_fit_rows(robots, fused, last),
        "landmark_nees": landmark_nees_rows(robots, fused, last, radius_m),
        RUN_TIMES: _times(laid_out),
    }


def _times(laid_out: Plan) -> list[dict[str, Any]]:
    timed = [(folder, folder.figures()) for folder in laid_out.folders() if folder.finished]
    timed += [(part, part.noted()) for part in _aligner_parts(laid_out)]
    return [
        {"stage": folder.stage, "key": folder.key, "figure": name, "seconds": figures[name]}
        for folder, figures in timed
        for name in ("elapsed_s", "rendering_s")
        if name in figures
    ]


def write_aligner_timings(run: SweepRun, store: Store, dataset: SweepDataset) -> None:
    """Time a finished run's aligners, serially: nothing else may be running."""
    laid_out = plan(run.load(), store)
    measure_aligners(laid_out, [load_robot(robot.folders) for robot in laid_out.robots])
    dataset.write(ALIGNER_TIMINGS, run, pair_table(laid_out, ALIGNER_TIMINGS))
