"""One run of a sweep as tasks: those of its scenario, and one that writes its rows."""

from dataclasses import dataclass

from experiments.judge.consistency import landmark_nees_rows
from experiments.judge.fused_landmarks import map_fit_rows
from experiments.judge.judged_run import JudgedRun
from experiments.judge.provenance import renderer
from experiments.judge.result import fused_map, robot_tables
from experiments.run.store import Store
from experiments.run.tasks import Task, task_names, unfinished
from experiments.study.sweep.dataset import ALIGNER_TIMINGS, RUN_TIMES, Dataset
from experiments.study.sweep.grid import Run

WRITE = "write the tables"  # the kind of the task that writes a run's rows


@dataclass(frozen=True)
class PlannedRun:
    """A run and its tasks.

    Attributes:
        run: which one.
        judged: its stages.
        tasks: all of them by name; the last one writes the run's rows.
        finished: whether the dataset holds it already.
    """

    run: Run
    judged: JudgedRun
    tasks: dict[str, Task]
    finished: bool

    @property
    def stages(self) -> list[str]:
        """STAGE/KEY of all it is made from."""
        return stages_of(self.judged)

    def left(self) -> list[Task]:
        """Tasks that are not done yet, each after those it needs."""
        return [] if self.finished else unfinished(self.tasks, [write_name(self.run)])


def write_name(run: Run) -> str:
    """Name of the task that writes a run's rows."""
    return f"run/{run.run_id}"


def stages_of(judged: JudgedRun) -> list[str]:
    """STAGE/KEY of all stages."""
    return [f"{stage.name}/{stage.key}" for stage in judged.stages()]


def planned(run: Run, store: Store, dataset: Dataset) -> PlannedRun:
    """Lay out a run; nothing is computed. Raises InputError for what cannot be run."""
    judged = JudgedRun.of(run.load(), store)
    tasks = dict(judged.tasks)
    pipeline = judged.pipeline
    before = [stage for robot in pipeline.robots for stage in (robot.log, robot.slam)]
    before += [*(pair.estimates for pair in pipeline.pairs), *judged.judgements]
    needs = tuple(name for stage in before for name in task_names(stage))
    name = write_name(run)
    tasks[name] = Task(name, WRITE, write_rows, (run, judged, dataset), (), needs)
    return PlannedRun(run, judged, tasks, dataset.holds(run, stages_of(judged)))


def write_rows(run: Run, judged: JudgedRun, dataset: Dataset) -> None:
    """Write a run's rows of all tables, `runs` last; no maps, no images."""
    dataset.path(ALIGNER_TIMINGS, run).unlink(missing_ok=True)  # of an earlier state of the run
    robots = judged.load_robots()
    made = {name: judged.pair_table(name) for name in ("errors", "fusion")}
    of_robots = robot_tables(judged, robots)
    made |= {name: of_robots[name] for name in ("robots", "path_statistics")}
    last = max(max(robot.maps) for robot in robots)
    estimates, offered = (judged.pair_table(name) for name in ("estimates", "correspondences"))
    fused = fused_map(judged.scenario.merge, robots, estimates, offered, last)
    for name, rows in made.items():
        dataset.write(name, run, rows)
    dataset.write("map_fits", run, map_fit_rows(robots, fused, last))
    radius_m = judged.scenario.evaluate.true_pair_radius_m
    dataset.write("landmark_nees", run, landmark_nees_rows(robots, fused, last, radius_m))
    dataset.write(RUN_TIMES, run, _times(judged))
    dataset.finish(run, renderer(judged.scenario), stages_of(judged))


def _times(judged: JudgedRun) -> list[dict[str, object]]:
    return [
        {"stage": folder.name, "key": folder.key, "figure": name, "seconds": seconds}
        for folder in judged.folders()
        for name, seconds in folder.figures().items()
    ]
