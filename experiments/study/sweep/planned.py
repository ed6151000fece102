"""One run of a sweep as tasks: those of its scenario, and one that writes its rows."""

from dataclasses import dataclass

from experiments.judge.consistency import landmark_nees_rows
from experiments.judge.fused_landmarks import map_fit_rows
from experiments.judge.judging import load_robot
from experiments.judge.pipeline import Plan, plan, task_name, tasks_of
from experiments.judge.provenance import renderer
from experiments.judge.result import fused_map, pair_table, robot_tables
from experiments.run.store import Store
from experiments.run.tasks import Task, unfinished
from experiments.study.sweep.dataset import ALIGNER_TIMINGS, RUN_TIMES, Dataset
from experiments.study.sweep.grid import Run

WRITE = "tables"  # the kind of the task that writes a run's rows


@dataclass(frozen=True)
class PlannedRun:
    """A run and its tasks.

    Attributes:
        run: which one.
        plan: its stages.
        tasks: all of them by name; the last one writes the run's rows.
        finished: whether the dataset holds it already.
    """

    run: Run
    plan: Plan
    tasks: dict[str, Task]
    finished: bool

    @property
    def stages(self) -> list[str]:
        """STAGE/KEY of all it is made from."""
        return stages_of(self.plan)

    def left(self) -> list[Task]:
        """Tasks that are not done yet, each after those it needs."""
        return [] if self.finished else unfinished(self.tasks, [write_name(self.run)])


def write_name(run: Run) -> str:
    """Name of the task that writes a run's rows."""
    return f"run/{run.run_id}"


def stages_of(laid_out: Plan) -> list[str]:
    """STAGE/KEY of all stages, the aligners' own among them."""
    parts = [part for pair in laid_out.pairs for part in (pair.parts.match, *pair.parts.aligners)]
    return [task_name(folder) for folder in (*laid_out.folders(), *parts)]


def planned(run: Run, store: Store, dataset: Dataset) -> PlannedRun:
    """Lay out a run; nothing is computed. Raises InputError for what cannot be run."""
    laid_out = plan(run.load(), store)
    tasks = tasks_of(laid_out)
    before = [folder for robot in laid_out.robots for folder in (robot.log, robot.slam)]
    before += [folder for pair in laid_out.pairs for folder in (pair.align, pair.judge)]
    needs = tuple(name for name in map(task_name, before) if name in tasks)
    name = write_name(run)
    tasks[name] = Task(name, WRITE, write_rows, (run, laid_out, dataset), (), needs)
    return PlannedRun(run, laid_out, tasks, dataset.holds(run, stages_of(laid_out)))


def write_rows(run: Run, laid_out: Plan, dataset: Dataset) -> None:
    """Write a run's rows of all tables, `runs` last; no maps, no images."""
    dataset.path(ALIGNER_TIMINGS, run).unlink(missing_ok=True)  # of an earlier state of the run
    robots = [load_robot(robot.folders) for robot in laid_out.robots]
    made = {name: pair_table(laid_out, name) for name in ("errors", "fusion")}
    of_robots = robot_tables(laid_out, robots)
    made |= {name: of_robots[name] for name in ("robots", "path_statistics")}
    last = max(max(robot.maps) for robot in robots)
    estimates, offered = (pair_table(laid_out, name) for name in ("estimates", "correspondences"))
    fused = fused_map(laid_out.scenario.merge, robots, estimates, offered, last)
    for name, rows in made.items():
        dataset.write(name, run, rows)
    dataset.write("map_fits", run, map_fit_rows(robots, fused, last))
    radius_m = laid_out.scenario.evaluate.true_pair_radius_m
    dataset.write("landmark_nees", run, landmark_nees_rows(robots, fused, last, radius_m))
    dataset.write(RUN_TIMES, run, _times(laid_out))
    dataset.finish(run, renderer(laid_out.scenario), stages_of(laid_out))


def _times(laid_out: Plan) -> list[dict[str, object]]:
    parts = [part for pair in laid_out.pairs for part in (pair.parts.match, *pair.parts.aligners)]
    timed = [(folder, folder.figures()) for folder in laid_out.folders() if folder.finished]
    timed += [(part, part.noted()) for part in parts]
    return [
        {"stage": folder.stage, "key": folder.key, "figure": name, "seconds": figures[name]}
        for folder, figures in timed
        for name in ("elapsed_s", "rendering_s")
        if name in figures
    ]
