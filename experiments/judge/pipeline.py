"""A whole run: each stage as soon as what it needs is there, on all cores, resumable."""

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.judge import judging as judge
from experiments.run.stages import align, drive, features, log, slam
from experiments.run.stages.slam import RobotFolders
from experiments.run.store import StageFolder, Store, explained
from experiments.run.tasks import OnProgress, Task, run_tasks, unfinished
from experiments.run.workers import workers
from experiments.scenario.settings import NAME_PATTERN, Scenario
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log


@dataclass(frozen=True)
class RobotStages:
    """Where one robot's intermediate results lie."""

    name: str
    n_frames: int
    log: StageFolder
    slam: StageFolder
    features: StageFolder | None = None  # None for imported logs
    observed: StageFolder | None = None

    @property
    def folders(self) -> RobotFolders:
        """For the evaluation."""
        return RobotFolders(self.log.path, self.slam.path)


@dataclass(frozen=True)
class PairStages:
    """Where one robot pair's intermediate results lie."""

    a: RobotStages
    b: RobotStages
    parts: align.Parts
    align: StageFolder
    judge: StageFolder


@dataclass(frozen=True)
class Plan:
    """All stages of a scenario, in the order of the data."""

    scenario: Scenario
    robots: list[RobotStages]
    pairs: list[PairStages]
    drive: StageFolder | None = None
    faces: StageFolder | None = None

    def folders(self) -> list[StageFolder]:
        """Every stage's folder."""
        found = [self.drive, self.faces]
        for robot in self.robots:
            found += [robot.features, robot.observed, robot.slam]
            found += [robot.log] if robot.features is not None else []
        for pair in self.pairs:
            found += [pair.align, pair.judge]
        return [folder for folder in found if folder is not None]


def plan(scenario: Scenario, store: Store) -> Plan:
    """Lay out the stages of a scenario; nothing is computed."""
    if scenario.logs:
        robots = [_imported(scenario, store, Path(folder)) for folder in scenario.logs]
        _require_usable_names(robots)
        return Plan(scenario, robots, _pairs(scenario, store, robots))
    driven, faces = drive.stage(store, scenario), features.faces_stage(store, scenario)
    robots = [_simulated(scenario, store, driven, faces, r.name) for r in scenario.robots]
    return Plan(scenario, robots, _pairs(scenario, store, robots), driven, faces)


def _simulated(
    scenario: Scenario, store: Store, driven: StageFolder, faces: StageFolder, robot: str
) -> RobotStages:
    seen = features.stage(store, scenario, driven, faces, robot)
    observed = log.observed_stage(store, scenario, seen)
    logged = log.stage(store, scenario, driven, observed, robot)
    slammed = slam.stage(store, scenario, logged)
    assert scenario.drive is not None
    return RobotStages(robot, scenario.drive.frames, logged, slammed, seen, observed)


def _imported(scenario: Scenario, store: Store, folder: Path) -> RobotStages:
    log = read_log(folder)
    if not len(log):
        raise InputError(f"{folder}: frames.parquet holds no frame")
    logged = store.imported("log", folder)
    return RobotStages(log.robot, len(log), logged, slam.stage(store, scenario, logged))


def _require_usable_names(robots: Sequence[RobotStages]) -> None:
    """Robots of recorded logs give their names to files, as those of scenarios do."""
    known: set[str] = set()
    for robot in robots:
        frames = robot.log.path / "frames.parquet"
        if not re.fullmatch(NAME_PATTERN, robot.name):
            raise InputError(f"{frames}: robot is named {robot.name!r}, expected {NAME_PATTERN}")
        if robot.name in known:
            raise InputError(f"{frames}: robot {robot.name} is in another log already")
        known.add(robot.name)


def _pairs(scenario: Scenario, store: Store, robots: Sequence[RobotStages]) -> list[PairStages]:
    pairs = []
    for a, b in itertools.combinations(robots, 2):
        parts = align.parts(store, scenario, a.slam, b.slam)
        aligned = align.stage(store, parts)
        judged = judge.stage(store, scenario, aligned, [a.slam, b.slam])
        pairs.append(PairStages(a, b, parts, aligned, judged))
    return pairs


def tasks_of(plan: Plan) -> dict[str, Task]:
    """All tasks of a plan by name, each after those it needs, one robot or pair after the other."""
    tasks: list[Task] = []
    if plan.drive is not None and plan.faces is not None:
        tasks.append(_task(plan.drive, "drive", drive.run, (plan.scenario, plan.drive)))
        tasks.append(_task(plan.faces, "faces", features.run_faces, (plan.scenario, plan.faces)))
    for robot in plan.robots:
        tasks += _robot_tasks(plan, robot)
    for pair in plan.pairs:
        tasks += _pair_tasks(plan.scenario, pair)
    return {task.name: task for task in tasks}


def task_name(folder: StageFolder) -> str:
    """The name of the task that ends a stage."""
    return f"{folder.stage}/{folder.key}"


def _task(
    folder: StageFolder,
    kind: str,
    function: Callable[..., object],
    arguments: tuple[object, ...],
    needs: Sequence[StageFolder] = (),
    parts: Sequence[Task] = (),
) -> Task:
    """The task that ends a stage."""
    names = [task_name(before) for before in needs] + [part.name for part in parts]
    return Task(task_name(folder), kind, function, arguments, (folder.mark,), tuple(names))


def _robot_tasks(plan: Plan, robot: RobotStages) -> list[Task]:
    """From the world, or the recorded log, to the robot's maps."""
    scenario, name = plan.scenario, robot.name
    tasks, before = [], []
    if robot.features is not None and robot.observed is not None:
        assert plan.drive is not None
        seen, observed, driven = robot.features, robot.observed, plan.drive
        chunks = _chunk_tasks(plan, robot)
        tasks += [
            *chunks,
            _task(seen, "render", features.finish, (seen,), parts=chunks),
            _task(observed, "log", log.run_observed, (scenario, seen, observed, name), [seen]),
            _task(
                robot.log,
                "log",
                log.run,
                (scenario, driven, observed, robot.log, name),
                [driven, observed],
            ),
        ]
        before = [robot.log]
    return [*tasks, _task(robot.slam, "slam", slam.run, (scenario, robot.log, robot.slam), before)]


def _chunk_tasks(plan: Plan, robot: RobotStages) -> list[Task]:
    output, driven, faces = robot.features, plan.drive, plan.faces
    assert output is not None
    assert driven is not None
    assert faces is not None
    return [
        Task(
            f"{task_name(output)}/{start:06d}",
            "render",
            features.run_chunk,
            (plan.scenario, driven, faces, output, robot.name, start),
            features.chunk_paths(output.path, start),
            (task_name(driven), task_name(faces)),
        )
        for start in features.chunks(robot.n_frames)
    ]


def _pair_tasks(scenario: Scenario, pair: PairStages) -> list[Task]:
    """From two robots' maps to the judged estimates, each aligner apart."""
    n_frames = max(pair.a.n_frames, pair.b.n_frames)
    batches = align.batches(slam.evaluated_iterations(n_frames, scenario.evaluate.every))
    a, b, offered = pair.a.folders, pair.b.folders, pair.parts.match
    maps = (task_name(pair.a.slam), task_name(pair.b.slam))
    parts = []
    for i, iterations in enumerate(batches):
        arguments = (scenario, (a, b), offered, i, iterations)
        parts.append(_batch_task(offered, i, align.run_match, arguments, maps))
    # Method by method within a batch: two processes then compile different methods' kernels.
    for i, iterations in enumerate(batches):
        for entry, output in zip(scenario.align.aligners, pair.parts.aligners, strict=True):
            arguments = (scenario, entry, (a, b), offered, output, i, iterations)
            needs = (*maps, parts[i].name)
            parts.append(_batch_task(output, i, align.run_aligner, arguments, needs))
    ending = (pair.align, pair.parts, len(batches))
    judging = (scenario, a, b, pair.align, pair.judge)
    slams = [pair.a.slam, pair.b.slam]
    return [
        *parts,
        _task(pair.align, "align", align.finish, ending, parts=parts),
        _task(pair.judge, "judge", judge.run, judging, [pair.align, *slams]),
    ]


def _batch_task(
    output: StageFolder,
    index: int,
    function: Callable[..., object],
    arguments: tuple[object, ...],
    needs: tuple[str, ...],
) -> Task:
    name, path = f"{task_name(output)}/{index:03d}", align.batch_path(output, index)
    return Task(name, "align", function, arguments, (path,), needs)


def execute(
    scenario: Scenario, store: Store, jobs: int, on_progress: OnProgress, fresh: bool = False
) -> Plan:
    """Run all stages of a scenario that are not in the store yet.

    Args:
        scenario: what to run.
        store: where stages are kept.
        jobs: processes.
        on_progress: told (stage, tasks done, tasks in all).
        fresh: forget what the store holds of this scenario first.
    """
    laid_out = plan(scenario, store)
    if fresh:
        parts = [f for pair in laid_out.pairs for f in (pair.parts.match, *pair.parts.aligners)]
        for folder in laid_out.folders() + parts:
            folder.discard()
    _run(laid_out, store, jobs, on_progress)
    return laid_out


def _run(
    laid_out: Plan, store: Store, jobs: int, on_progress: OnProgress, logs_only: bool = False
) -> None:
    wanted = [robot.log for robot in laid_out.robots] if logs_only else laid_out.folders()
    left = unfinished(tasks_of(laid_out), [task_name(folder) for folder in wanted])
    try:
        with workers(jobs) as pool:
            run_tasks(left, pool, on_progress)
    except InputError as error:
        raise InputError(explained(str(error), store)) from error
    for folder in wanted:
        if not folder.finished:
            raise InputError(f"{folder.path}: was removed while it was being made; run again")


def record_logs(
    scenario: Scenario, store: Store, jobs: int, on_progress: OnProgress
) -> dict[str, Path]:
    """Simulate only; returns each robot's log folder in the store."""
    laid_out = plan(scenario, store)
    _run(laid_out, store, jobs, on_progress, logs_only=True)
    return {robot.name: robot.log.path for robot in laid_out.robots}
