"""Run of a scenario with its evaluation, timing of its aligners, and findings about its logs."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.fused_landmarks import FusedTeam, MergeSettings
from experiments.evaluation.map_errors import (
    ALIGNED,
    EVALUATION_STAGE,
    EvaluatedFusion,
    EvaluationSettings,
    GivenMap,
    SmoothedRobot,
    load_smoothed,
)
from experiments.evaluation.truth import (
    EvaluatedRobot,
    MapPair,
    is_surveyed,
    join_map_pairs,
    load_robot,
)
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.fuse import read_fusions
from experiments.pipeline.stages.pipeline import (
    PairStages,
    Pipeline,
    RobotStages,
    build_pipeline,
    require_memory,
)
from experiments.pipeline.stages.slam import noise_factor, read_findings
from experiments.pipeline.stages.smooth import RobotFolders, latest_at, stored_maps
from experiments.pipeline.store import StageFolder, Store, require_undamaged
from experiments.pipeline.tasks import OnProgress, Task, run_tasks, task_names, tasks_of, unfinished
from experiments.pipeline.workers import workers
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.settings import AnyScenario, Recording, has_truth
from mapfusion.align.aligners import Aligner
from mapfusion.datasets.log_consistency import Finding, truth_finding
from mapfusion.datasets.relative_motion import composed_spans, observed_spans, odometry_motions
from mapfusion.errors import DamagedFileError, InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fusion.fusers import make_fuser
from mapfusion.geometry.numerics import Float, generator
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, read_log, read_true_poses

TABLES_PART = "tables"  # part of a run outside its stages, in the table `timings`
SMOOTHED_PREFIX = "smoothed_"  # of tables of alignments of smoothed maps
# Tables of pairs that the evaluation writes; the stage `align` writes the others.
_EVALUATION_TABLES = {"errors", "smoothed_errors", "fusion"}


_PERCENTILES = {"elapsed_low_s": 10, "elapsed_s": 50, "elapsed_high_s": 90}
_WARM_UP = "warm-up"  # name of the random generators of calls that are not timed


@dataclass(frozen=True)
class AlignerTiming:
    """Aligners ready for timing on the maps of one pair of robots.

    Attributes:
        seed: seed of the scenario.
        repeats: number of timings of each aligner on each pair of maps.
        aligners: aligners by name; their kernels are compiled and their processes run.
        maps: pairs of maps, evenly spread over the run.
        n_common: number of common landmarks of each pair of maps; UNKNOWN without truth.
    """

    seed: int
    repeats: int
    aligners: Mapping[str, Aligner]
    maps: Sequence[MapPair]
    n_common: Sequence[int]

    @classmethod
    def of(cls, scenario: AnyScenario, map_pairs: Sequence[MapPair]) -> "AlignerTiming":
        """Choose pairs of maps of two robots and warm up all aligners.

        Other processes may be busy meanwhile.
        """
        settings = scenario.evaluate
        spread = np.linspace(0, len(map_pairs) - 1, settings.timing_points)
        maps = [map_pairs[k] for k in np.unique(spread.round().astype(int))]
        aligners = {
            entry.name: callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
            for entry in scenario.align.aligners
        }
        n_common = []
        for pair in maps:
            known = all(np.isfinite(points_m).any() for points_m in pair.points_world_m)
            radius_m = settings.true_pair_radius_m
            n_common.append(pair.n_common(radius_m) if known else tables.UNKNOWN)
        ready = cls(scenario.seed, settings.timing_repeats, aligners, maps, n_common)
        for smallest_or_largest in (maps[0], maps[-1]):  # some aligners treat few pairs apart
            for name in aligners:
                ready._call(name, smallest_or_largest, _WARM_UP)
        return ready

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of the table `aligner_timings`; nothing else may run meanwhile."""
        rows, elapsed_s = [], []
        for maps, n_common in zip(self.maps, self.n_common, strict=True):
            self._call(next(iter(self.aligners)), maps, _WARM_UP)  # load the maps into CPU caches
            counts = {"n_correspondences": len(maps.offered), "n_common": n_common}
            for name in self.aligners:
                rows.append(maps.keys | counts | {"aligner": name})
                elapsed_s.append([self._call(name, maps, k) for k in range(self.repeats)])
        times = np.percentile(elapsed_s, list(_PERCENTILES.values()), axis=1).T
        named = (dict(zip(_PERCENTILES, each, strict=True)) for each in times.tolist())
        return [row | each for row, each in zip(rows, named, strict=True)]

    def _call(self, name: str, maps: MapPair, repeat: int | str) -> float:
        """Call an aligner and return its time in s."""
        rng = generator(self.seed, "timing", name, repeat)
        return self.aligners[name].align(*maps.maps, maps.offered, rng).elapsed_s


@dataclass(frozen=True)
class EvaluatedRun:
    """Stages of a scenario and of its evaluation, and their store.

    Attributes:
        pipeline: stages up to the estimates and fused maps.
        settings: settings of the evaluation.
        evaluations: stages that compare a pair's estimates with the truth, in the order of the
            pipeline's pairs; none for pairs with a robot without truth.
        store: store of the stages.
        no_truth: reason why nothing can be evaluated; empty if the truth is known.
    """

    pipeline: Pipeline
    settings: EvaluationSettings
    evaluations: tuple[Stage, ...]
    store: Store
    no_truth: str

    @classmethod
    def of(cls, scenario: AnyScenario, store: Store) -> "EvaluatedRun":
        """Lay out the stages of a scenario, without any computation."""
        pipeline = build_pipeline(scenario)
        merge = MergeSettings(scenario.merge.aligner, scenario.merge.parameters)
        radius_m = scenario.evaluate.true_pair_radius_m
        settings = EvaluationSettings(scenario.align.verifier, merge, radius_m)
        no_truth = scenario.why_no_truth()
        kind, evaluations = EVALUATION_STAGE, []
        unknown = {
            robot.name
            for robot in pipeline.robots
            if isinstance(scenario, Recording) and not has_truth(store.path(robot.log))
        }
        judged = [pair for pair in pipeline.pairs if not unknown & {pair.a.name, pair.b.name}]
        for pair in judged:
            before = {"align": pair.filtered.estimates, "align_smoothed": pair.smoothed.estimates}
            before |= {"log_a": pair.a.log, "slam_a": pair.a.slam}
            before |= {"log_b": pair.b.log, "slam_b": pair.b.slam}
            before |= {"smooth_a": pair.a.smooth, "smooth_b": pair.b.smooth}
            evaluations.append(
                Stage(kind.name, kind.label, settings, kind.work, kind.writes, before)
            )
        return cls(pipeline, settings, tuple(evaluations), store, no_truth)

    @property
    def scenario(self) -> AnyScenario:
        """The scenario of the run."""
        return self.pipeline.scenario

    def stages(self) -> list[Stage]:
        """Return all stages, each after the stages that it needs."""
        return [*self.pipeline.stages(), *self.evaluations]

    def folders(self) -> list[StageFolder]:
        """Return the folders of all stages."""
        return [self.store.folder(stage) for stage in self.stages()]

    @cached_property
    def tasks(self) -> dict[str, Task]:
        """All tasks by name, each after the tasks that it needs."""
        return tasks_of(self.stages(), self.store)

    def robot_folders(self, robot: RobotStages) -> RobotFolders:
        """Return the folders of a robot's log and maps."""
        return RobotFolders(self.store.path(robot.log), self.store.path(robot.slam))

    @cached_property
    def logs(self) -> dict[str, RobotLog]:
        """Logs of all robots by name."""
        folders = {robot.name: self.robot_folders(robot) for robot in self.pipeline.robots}
        return {name: read_log(each.log) for name, each in folders.items()}

    def load_robots(self) -> list[EvaluatedRobot]:
        """Load the maps of all robots with the truth, without the viewing evidence."""
        folders = map(self.robot_folders, self.pipeline.robots)
        return [load_robot(each, viewing=False) for each in folders]

    def last_maps(self, iteration: int) -> dict[str, LandmarkMap]:
        """Return all robots' maps at an iteration; smoothed logs determine their errors."""
        folders = {
            robot.name: self.robot_folders(robot)._replace(smooth=self.store.path(robot.smooth))
            for robot in self.pipeline.robots
        }
        return {
            name: latest_at(stored_maps(each, viewing=True), iteration)
            for name, each in folders.items()
        }

    def load_smoothed(self, robots: Sequence[EvaluatedRobot]) -> list[SmoothedRobot]:
        """Load the smoothed maps and paths of all robots with the truth."""
        return [
            load_smoothed(
                robot,
                self.robot_folders(stages),
                self.logs[stages.name],
                self.store.path(stages.smooth),
            )
            for robot, stages in zip(robots, self.pipeline.robots, strict=True)
        ]

    def load_fusions(
        self, robots: Sequence[EvaluatedRobot], smoothed: Sequence[SmoothedRobot]
    ) -> list[EvaluatedFusion]:
        """Load the fused maps of all fusers and iterations with the truth."""
        names, fusions = [robot.name for robot in robots], []
        for fuser, stage in self.pipeline.fusers.items():
            folder, takes_smoothed = self.store.path(stage), make_fuser(fuser).smoothed
            smoothed_or_none = smoothed if takes_smoothed else [None] * len(robots)
            for k, fusion in read_fusions(folder, names).items():
                pairs = zip(robots, smoothed_or_none, strict=True)
                given = [GivenMap.at(robot, own, k) for robot, own in pairs]
                fusions.append(EvaluatedFusion(fuser, k, fusion, given))
        return fusions

    @cached_property
    def outside_s(self) -> defaultdict[str, float]:
        """Time in s outside the stages so far, by part of the run."""
        return defaultdict(float)

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Add the time of a `with` block to a part of the run outside its stages."""
        started_s = time.perf_counter()
        try:
            yield
        finally:
            self.outside_s[part] += time.perf_counter() - started_s

    @cached_property
    def team(self) -> FusedTeam:
        """Last maps of all robots, merged by the paper's fuser."""
        robots = self.load_robots()
        map_pairs = join_map_pairs(robots, *map(self.pair_table, ALIGNED))
        return FusedTeam.of(robots, map_pairs, self.settings.merge)

    @cached_property
    def timings(self) -> dict[tuple[str, str], AlignerTiming]:
        """Aligners ready for timing, by the names of a pair's robots."""
        by_robots: dict[tuple[str, str], list[MapPair]] = {}
        for each in self.team.map_pairs:
            by_robots.setdefault((each.a.name, each.b.name), []).append(each)
        return {pair: AlignerTiming.of(self.scenario, maps) for pair, maps in by_robots.items()}

    def untimed(self) -> Iterator[tuple[PairStages, Path]]:
        """Yield robot pairs without a table `aligner_timings`, and the path of this table."""
        for pair in self.pipeline.pairs:
            path = self.store.path(pair.filtered.estimates) / "aligner_timings.parquet"
            if not path.is_file():
                yield pair, path

    def pair_table(self, name: str) -> pd.DataFrame:
        """Return a table of robot pairs, of all pairs."""
        if name in _EVALUATION_TABLES:
            stages, file = self.evaluations, name
        else:
            file, pairs = name.removeprefix(SMOOTHED_PREFIX), self.pipeline.pairs
            stages = [
                (each.filtered if file == name else each.smoothed).estimates for each in pairs
            ]
        parts = [tables.read(self.store.path(s) / f"{file}.parquet", file) for s in stages]
        return pd.concat(parts, ignore_index=True) if parts else tables.as_table(name, [])

    def execute(self, jobs: int, on_progress: OnProgress, only: Sequence[Stage] = ()) -> None:
        """Run the stages that are not in the store yet.

        A run of all stages also computes `team` and `timings`, at the same time as the last tasks.

        Args:
            jobs: number of processes.
            on_progress: called with the number of finished tasks.
            only: stages that are needed; empty for all stages.

        Raises:
            InputError: an input cannot be used, or the machine has too little memory.
            DamagedFileError: a file of the store was changed.
        """
        require_memory(self.pipeline, jobs)
        wanted = only or self.stages()
        left = unfinished(self.tasks, [name for stage in wanted for name in task_names(stage)])

        def load() -> None:
            with self.timed(TABLES_PART):
                _ = self.team
                if any(self.untimed()):
                    _ = self.timings

        robots, pairs = self.pipeline.robots, self.pipeline.pairs
        estimates = [each.estimates for p in pairs for each in (p.filtered, p.smoothed)]
        loaded = [robot.slam for robot in robots] + [pair.filtered.estimates for pair in pairs]
        needs = tuple(name for stage in loaded for name in task_names(stage))
        load_task = Task("team", "load the maps", load, (), (), needs)
        try:
            with workers(jobs) as pool:
                run_tasks(left, pool, on_progress, None if only else load_task)
        except DamagedFileError:  # `mending` repairs the stage that the error names
            raise
        except InputError as error:
            raise InputError(f"scenario {self.scenario.name}: {error}") from error
        for folder in map(self.store.folder, wanted):
            if not folder.finished:
                raise InputError(f"{folder.path}: was removed while it was being made; run again")
        # stages whose files become tables and maps of the result
        simulated, fusers = self.pipeline.simulated, self.pipeline.fusers.values()
        collected = [each for robot in robots for each in (robot.slam, robot.smooth)]
        collected += [each for robot in simulated for each in (robot.observed, robot.log)]
        collected += [*estimates, *self.evaluations, *fusers]
        for stage in only or collected:
            require_undamaged(self.store.path(stage))


def finding_rows(run: EvaluatedRun) -> list[dict[str, Any]]:
    """Return the rows of the table `findings`.

    In a recording the truth is compared with the odometry, too.
    """
    rows, recorded = [], isinstance(run.scenario, Recording)
    for robot in run.pipeline.robots:
        folders, log = run.robot_folders(robot), run.logs[robot.name]
        found = read_findings(folders.slam)
        named = found[["check", "iteration", "finding"]].assign(robot=robot.name)
        rows += named.to_dict("records")
        poses = read_true_poses(folders.log) if recorded else None
        if recorded and not is_surveyed(folders.log):
            text = "true points are unknown: landmarks are identified by the true poses, and their "
            row = {"robot": robot.name, "check": "truth", "iteration": -1}
            rows.append(row | {"finding": f"{text}errors are not judged"})
        if poses is not None and len(poses) == len(log):
            sound = not (found["check"] == "odometry").any()
            motion = run.scenario.slam.filter.motion.scaled(noise_factor(folders.slam))
            finding = finding_of_truth(log, poses, motion, sound)
            if finding is not None:
                row = {"robot": robot.name, "check": finding.kind}
                rows.append(row | {"iteration": finding.frame, "finding": finding.text})
    return rows


def finding_of_truth(
    log: RobotLog, T_world_robot: Float, noise: MotionNoise, sound: bool
) -> Finding | None:
    """Compare the true poses of a log with its odometry or observations.

    Args:
        log: the log.
        T_world_robot: true poses, shape (T, 3).
        noise: noise of the odometry.
        sound: whether the odometry is usable. Otherwise the truth is compared with the motions
            that the observations show.

    Returns:
        The finding; None if there is no truth or no contradiction.
    """
    if not np.isfinite(T_world_robot).all(axis=1).any():
        return None
    if sound:
        spans = composed_spans(odometry_motions(log, noise), len(log))
        return truth_finding("the odometry", spans, T_world_robot)
    reference = "the motion that the observations show"
    return truth_finding(reference, observed_spans(log), T_world_robot)


def finding_lines(result: Path) -> Iterator[str]:
    """Yield a line for each finding of a result; none if its version wrote no findings."""
    path = tables.table_path(result, "findings")
    if path.exists():
        yield from finding_row_lines(tables.read(path, "findings"))


def finding_row_lines(rows: pd.DataFrame) -> Iterator[str]:
    """Yield a line for each row of the table `findings`."""
    yield from (f"{row.robot}: {row.finding}" for row in rows.itertuples(index=False))


def has_usable_map(result: Path) -> bool:
    """Return True if any robot has landmarks that agree with its observations."""
    mapped, found = (
        tables.read(tables.table_path(result, name), name) for name in ("landmarks", "findings")
    )
    contradicted = found.loc[found["check"] == "gate", "robot"]
    return bool(set(mapped["robot"]) - set(contradicted))
