"""A whole run: each stage as soon as what it needs is there, on all cores, resumable."""

import itertools
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from experiments.scenario import NAME_PATTERN, Scenario
from experiments.stages import align, drive, features, judge, log, slam
from experiments.stages.judge import RobotFolders
from experiments.store import StageFolder, Store
from experiments.workers import Workers, workers
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log

OnProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class RobotStages:
    """Where one robot's intermediate results lie."""

    name: str
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
    return RobotStages(robot, logged, slam.stage(store, scenario, logged), seen, observed)


def _imported(scenario: Scenario, store: Store, folder: Path) -> RobotStages:
    log = read_log(folder)
    if not len(log):
        raise InputError(f"{folder}: frames.parquet holds no frame")
    logged = store.imported("log", folder)
    return RobotStages(log.robot, logged, slam.stage(store, scenario, logged))


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
        aligned = align.stage(store, scenario, a.slam, b.slam)
        judged = judge.stage(store, scenario, aligned, [a.slam, b.slam])
        pairs.append(PairStages(a, b, parts, aligned, judged))
    return pairs


@dataclass
class _Run:
    """Submits each stage's tasks once those before it are done."""

    plan: Plan
    pool: Workers
    on_progress: OnProgress
    logs_only: bool = False
    open_chunks: dict[str, int] = field(default_factory=dict)
    open_batches: dict[int, int] = field(default_factory=dict)
    rendering_s: dict[str, float] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)
    total: dict[str, int] = field(default_factory=dict)
    started: dict[str, float] = field(default_factory=dict)

    def execute(self) -> None:
        """Run everything that is not finished."""
        if self.plan.drive is not None and self.plan.faces is not None:
            self._submit_once(("drive",), self.plan.drive, drive.run, self.plan.drive)
            self._submit_once(("faces",), self.plan.faces, features.run_faces, self.plan.faces)
        self._after_world()
        for tag, result in self.pool.completed():
            self._ended(tag, result)

    def _submit_once(
        self, tag: tuple, folder: StageFolder, function: Callable, *args: object
    ) -> None:
        if not folder.finished:
            self._submit(tag, function, *args)

    def _submit(self, tag: tuple, function: Callable, *args: object) -> None:
        self.total[tag[0]] = self.total.get(tag[0], 0) + 1
        self._report(tag[0])
        self.pool.submit(tag, function, self.plan.scenario, *args)

    def _report(self, kind: str) -> None:
        self.on_progress(kind, self.done.get(kind, 0), self.total[kind])

    def _ended(self, tag: tuple, result: object) -> None:
        kind = tag[0]
        self.done[kind] = self.done.get(kind, 0) + 1
        self._report(kind)
        if kind in {"drive", "faces"}:
            self._after_world()
        elif kind == "render":
            self._after_chunk(self.plan.robots[tag[1]], result)
        elif kind == "slam":
            self._after_slam(self.plan.robots[tag[1]])
        elif kind == "align":
            self._after_batch(tag[1])

    def _after_world(self) -> None:
        world = [folder for folder in (self.plan.drive, self.plan.faces) if folder is not None]
        if not all(folder.finished for folder in world):
            return
        for index, robot in enumerate(self.plan.robots):
            if self.logs_only and robot.log.finished:
                continue
            if robot.slam.finished:
                self._after_slam(robot)
            elif robot.features is None or robot.features.finished:
                self._submit_slam(robot)
            else:
                self._submit_chunks(index, robot, robot.features)

    def _submit_chunks(self, index: int, robot: RobotStages, output: StageFolder) -> None:
        missing = features.chunks(self.plan.scenario, output)
        self.open_chunks[robot.name] = len(missing)
        self.started[robot.name] = time.perf_counter()
        if not missing:  # interrupted between the last chunk and the mark
            self._features_done(robot)
        for start in missing:
            self._submit(
                ("render", index),
                features.run_chunk,
                self.plan.drive,
                self.plan.faces,
                output,
                robot.name,
                start,
            )

    def _after_chunk(self, robot: RobotStages, rendering_s: object) -> None:
        assert isinstance(rendering_s, float)
        self.rendering_s[robot.name] = self.rendering_s.get(robot.name, 0.0) + rendering_s
        self.open_chunks[robot.name] -= 1
        if not self.open_chunks[robot.name]:
            self._features_done(robot)

    def _features_done(self, robot: RobotStages) -> None:
        assert robot.features is not None
        robot.features.finish(
            elapsed_s=time.perf_counter() - self.started[robot.name],
            rendering_s=self.rendering_s.get(robot.name, 0.0),
        )
        self._submit_slam(robot)

    def _submit_slam(self, robot: RobotStages) -> None:
        index = self.plan.robots.index(robot)
        if self.logs_only:
            self._submit(("log", index), write_log, self.plan.drive, robot)
        else:
            self._submit(("slam", index), run_robot, self.plan.drive, robot)

    def _after_slam(self, robot: RobotStages) -> None:
        for index, pair in enumerate(self.plan.pairs):
            if robot not in (pair.a, pair.b) or index in self.open_batches:
                continue
            if pair.a.slam.finished and pair.b.slam.finished:
                self._submit_pair(index, pair)

    def _submit_pair(self, index: int, pair: PairStages) -> None:
        self.open_batches[index] = 0
        self.started[pair.align.key] = time.perf_counter()
        if pair.align.finished:
            self._submit_judge(index, pair)
            return
        batches = self._batches(pair)
        self.open_batches[index] = len(batches)
        folders = (pair.a.folders, pair.b.folders)
        for number, iterations in enumerate(batches):
            self._submit(("align", index), align.run_batch, folders, pair.parts, number, iterations)

    def _batches(self, pair: PairStages) -> list[list[int]]:
        known = [slam.snapshot_iterations(robot.slam.path) for robot in (pair.a, pair.b)]
        return align.batches(max(known, key=lambda iterations: iterations[-1]))

    def _after_batch(self, index: int) -> None:
        self.open_batches[index] -= 1
        if self.open_batches[index]:
            return
        pair = self.plan.pairs[index]
        started = self.started[pair.align.key]
        align.finish(pair.align, pair.parts, len(self._batches(pair)), started)
        self._submit_judge(index, pair)

    def _submit_judge(self, index: int, pair: PairStages) -> None:
        arguments = (pair.a.folders, pair.b.folders, pair.align, pair.judge)
        self._submit_once(("judge", index), pair.judge, judge.run, *arguments)


def write_log(scenario: Scenario, driven: StageFolder, robot: RobotStages) -> None:
    """One simulated robot's log from its features and its trajectory."""
    assert robot.features is not None
    assert robot.observed is not None
    if not robot.observed.finished:
        log.run_observed(scenario, robot.features, robot.observed, robot.name)
    if not robot.log.finished:
        log.run(scenario, driven, robot.observed, robot.log, robot.name)


def run_robot(scenario: Scenario, driven: StageFolder | None, robot: RobotStages) -> None:
    """One robot from its features (or its log) to its maps: in one task, as each step is short."""
    if driven is not None:
        write_log(scenario, driven, robot)
    slam.run(scenario, robot.log, robot.slam)


def execute(
    scenario: Scenario, store: Store, jobs: int, on_progress: OnProgress, fresh: bool = False
) -> Plan:
    """Run all stages of a scenario that are not in the store yet.

    Args:
        scenario: what to run.
        store: where stages are kept.
        jobs: processes.
        on_progress: told (stage, tasks done, tasks so far).
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
    try:
        with workers(jobs) as pool:
            _Run(laid_out, pool, on_progress, logs_only).execute()
    except InputError as error:
        if str(store.root) in str(error):  # no file of the user's own, but one that was stored
            raise InputError(f"{error}; delete its folder, then it is computed again") from error
        raise
    wanted = [robot.log for robot in laid_out.robots] if logs_only else laid_out.folders()
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
