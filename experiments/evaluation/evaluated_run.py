"""Run with its evaluation: all stages of a scenario, the store, and findings about its logs."""

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import pair_evaluation, tables
from experiments.evaluation.alignment_errors import AlignerTiming, EvaluatedRobot, MetMaps, met_maps
from experiments.evaluation.fused_landmarks import FusedTeam, MergeSettings
from experiments.evaluation.fused_map_errors import GivenMap, JudgedFusion
from experiments.evaluation.pair_evaluation import ALIGNED, JudgeSettings
from experiments.evaluation.smoothed_robots import SmoothedRobot, load_smoothed
from experiments.evaluation.truth import why_no_truth
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.fuse import read_fusions
from experiments.pipeline.stages.match import latest_at
from experiments.pipeline.stages.memory import require_memory
from experiments.pipeline.stages.pipeline import PairStages, Pipeline, RobotStages, build_pipeline
from experiments.pipeline.stages.slam import RobotFolders, read_findings, stored_maps
from experiments.pipeline.store import StageFolder, Store, require_undamaged
from experiments.pipeline.tasks import OnProgress, Task, run_tasks, task_names, tasks_of, unfinished
from experiments.pipeline.workers import workers
from experiments.scenario.settings import AnyScenario, Recording
from mapfusion.datasets.log_consistency import (
    Finding,
    composed_spans,
    observed_spans,
    odometry_motions,
    truth_finding,
)
from mapfusion.errors import DamagedFileError, InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fusion.fusers import make_fuser
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog, read_log, read_true_poses

TABLES_PART = "tables"  # of a run outside its stages
_JUDGED = {"errors", "fusion"}  # the other tables of pairs come from the aligners


@dataclass(frozen=True)
class JudgedRun:
    """A scenario's stages in a store: those up to the estimates, and a judgement of each pair."""

    pipeline: Pipeline
    settings: JudgeSettings
    judgements: tuple[Stage, ...]  # in the order of the pipeline's pairs; none without truth
    store: Store
    no_truth: str  # why nothing can be judged; empty where the truth is known

    @classmethod
    def of(cls, scenario: AnyScenario, store: Store) -> "JudgedRun":
        """Lay out a scenario; nothing is computed."""
        pipeline, chosen = build_pipeline(scenario), scenario.merge
        merge = MergeSettings(chosen.aligner, chosen.parameters)
        align, radius_m = scenario.align, scenario.evaluate.true_pair_radius_m
        settings = JudgeSettings(align.judge, merge, radius_m)
        no_truth = why_no_truth(scenario)
        judged = () if no_truth else pipeline.pairs
        judgements = tuple(_judgement(settings, pair) for pair in judged)
        return cls(pipeline, settings, judgements, store, no_truth)

    @property
    def scenario(self) -> AnyScenario:
        """What is run."""
        return self.pipeline.scenario

    def stages(self) -> list[Stage]:
        """All stages, each after those before it."""
        return [*self.pipeline.stages(), *self.judgements]

    def folders(self) -> list[StageFolder]:
        """Where all stages are kept."""
        return [self.store.folder(stage) for stage in self.stages()]

    @cached_property
    def tasks(self) -> dict[str, Task]:
        """All tasks by name, each after those it needs."""
        return tasks_of(self.stages(), self.store)

    def robot_folders(self, robot: RobotStages) -> RobotFolders:
        """Where a robot's log and maps are."""
        return RobotFolders(self.store.path(robot.log), self.store.path(robot.slam))

    @cached_property
    def logs(self) -> dict[str, RobotLog]:
        """All robots' logs by name."""
        folders = {robot.name: self.robot_folders(robot) for robot in self.pipeline.robots}
        return {name: read_log(each.log) for name, each in folders.items()}

    def load_robots(self) -> list[EvaluatedRobot]:
        """All robots' maps joined with the truth, without viewing evidence: no table reads it."""
        folders = map(self.robot_folders, self.pipeline.robots)
        return [pair_evaluation.load_robot(each, viewing=False) for each in folders]

    def last_maps(self, iteration: int) -> dict[str, LandmarkMap]:
        """All robots' maps at an iteration as they were stored, by name."""
        folders = {robot.name: self.robot_folders(robot) for robot in self.pipeline.robots}
        return {name: latest_at(stored_maps(each), iteration) for name, each in folders.items()}

    def load_smoothed(self, robots: Sequence[EvaluatedRobot]) -> list[SmoothedRobot]:
        """What the smoother made of all robots' logs, joined with the truth."""
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
    ) -> list[JudgedFusion]:
        """All fusers' maps at all iterations that maps are fused at, joined with the truth."""
        names, found = [robot.name for robot in robots], []
        for fuser, stage in self.pipeline.fusers.items():
            folder, takes = self.store.path(stage), make_fuser(fuser).smoothed
            beside = smoothed if takes else [None] * len(robots)
            for k, fusion in read_fusions(folder, names).items():
                given = [GivenMap.at(*both, k) for both in zip(robots, beside, strict=True)]
                found.append(JudgedFusion(fuser, k, fusion, given))
        return found

    def load_team(self) -> FusedTeam:
        """All robots' last maps, merged by the paper's fuser."""
        robots = self.load_robots()
        met = met_maps(robots, *map(self.pair_table, ALIGNED))
        return FusedTeam.of(robots, met, self.settings.merge)

    @cached_property
    def outside_s(self) -> defaultdict[str, float]:
        """Seconds of work outside the stages so far, by the part of the run."""
        return defaultdict(float)

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Count the seconds of a `with` block to a part of the run outside its stages."""
        started_s = time.perf_counter()
        try:
            yield
        finally:
            self.outside_s[part] += time.perf_counter() - started_s

    @cached_property
    def team(self) -> FusedTeam:
        """What `load_team` gives; it stays in memory."""
        return self.load_team()

    @cached_property
    def timings(self) -> dict[tuple[str, str], AlignerTiming]:
        """The aligners made ready to be timed, by the names of a pair's robots."""
        met: dict[tuple[str, str], list[MetMaps]] = {}
        for each in self.team.met:
            met.setdefault((each.a.name, each.b.name), []).append(each)
        return {pair: AlignerTiming.of(self.scenario, maps) for pair, maps in met.items()}

    def untimed(self) -> Iterator[tuple[PairStages, Path]]:
        """The pairs on whose maps aligners are yet to be timed, and the tables this goes to."""
        for pair in self.pipeline.pairs:
            path = self.store.path(pair.estimates) / "aligner_timings.parquet"
            if not path.is_file():
                yield pair, path

    def _load(self) -> None:
        """Have in memory what is wanted when all tasks are done."""
        with self.timed(TABLES_PART):
            _ = self.team
            if any(self.untimed()):
                _ = self.timings

    def _load_task(self) -> Task:
        read = [robot.slam for robot in self.pipeline.robots]
        read += [pair.estimates for pair in self.pipeline.pairs]
        needs = tuple(name for stage in read for name in task_names(stage))
        return Task("team", "load the maps", self._load, (), (), needs)

    def pair_table(self, name: str) -> pd.DataFrame:
        """A table of robot pairs, of all pairs."""
        made = self.judgements if name in _JUDGED else [p.estimates for p in self.pipeline.pairs]
        parts = [tables.read(self.store.path(s) / f"{name}.parquet", name) for s in made]
        return pd.concat(parts, ignore_index=True) if parts else tables.framed(name, [])

    def _collected(self) -> list[Stage]:
        """Return the stages whose files the tables and maps of a result are made from."""
        found = [each for robot in self.pipeline.robots for each in (robot.slam, robot.smooth)]
        found += [each for robot in self.pipeline.simulated for each in (robot.observed, robot.log)]
        found += [pair.estimates for pair in self.pipeline.pairs]
        return [*found, *self.judgements, *self.pipeline.fusers.values()]

    def execute(self, jobs: int, on_progress: OnProgress, only: Sequence[Stage] = ()) -> None:
        """Do what is not in the store yet, in `jobs` processes; of `only` these stages, if any.

        Of all stages `team` and `timings` are made beside the last tasks.

        Raises:
            InputError: something that was given cannot be used, or this machine has too little
                memory for it.
            DamagedFileError: a file of the store is not as it was written.
        """
        require_memory(self.pipeline, jobs)
        wanted = only or self.stages()
        left = unfinished(self.tasks, [name for stage in wanted for name in task_names(stage)])
        try:
            with workers(jobs) as pool:
                run_tasks(left, pool, on_progress, None if only else self._load_task())
        except DamagedFileError:  # `retry_damaged` needs to know which
            raise
        except InputError as error:
            raise InputError(f"scenario {self.scenario.name}: {error}") from error
        for folder in map(self.store.folder, wanted):
            if not folder.finished:
                raise InputError(f"{folder.path}: was removed while it was being made; run again")
        for stage in only or self._collected():
            require_undamaged(self.store.path(stage))


def _judgement(settings: JudgeSettings, pair: PairStages) -> Stage:
    before = {"align": pair.estimates, "log_a": pair.a.log, "slam_a": pair.a.slam}
    before |= {"log_b": pair.b.log, "slam_b": pair.b.slam}
    label = "compare with the truth"
    return Stage("judge", label, settings, pair_evaluation.run, pair_evaluation.WRITES, before)


def finding_rows(run: JudgedRun) -> list[dict[str, Any]]:
    """Rows of the table `findings`; the truth of recorded logs is compared with their odometry."""
    rows, recorded = [], isinstance(run.scenario, Recording)
    for robot in run.pipeline.robots:
        folders, log = run.robot_folders(robot), run.logs[robot.name]
        known = read_findings(folders.slam)
        found = known[["check", "iteration", "finding"]].assign(robot=robot.name)
        rows += found.to_dict("records")
        poses = read_true_poses(folders.log) if recorded else None
        if poses is not None and len(poses) == len(log):
            sound = not (known["check"] == "odometry").any()
            one = finding_of_truth(log, poses, run.scenario.slam.filter.motion, sound)
            if one is not None:
                told = {"check": one.kind, "iteration": one.frame, "finding": one.text}
                rows.append({"robot": robot.name} | told)
    return rows


def finding_of_truth(
    log: RobotLog, T_world_robot: Float, noise: MotionNoise, sound: bool
) -> Finding | None:
    """Compare a log's true poses (T, 3) with its odometry if that is `sound`.

    If it is not, they are compared with the motions that the observations show.
    """
    if not np.isfinite(T_world_robot).all(axis=1).any():
        return None
    if sound:
        spans = composed_spans(odometry_motions(log, noise), len(log))
        return truth_finding("the odometry", spans, T_world_robot)
    reference = "the motion that the observations show"
    return truth_finding(reference, observed_spans(log), T_world_robot)


def finding_lines(result: Path) -> Iterator[str]:
    """A line for each finding of a result folder; none of one that was written without them."""
    path = tables.table_path(result, "findings")
    if path.exists():
        yield from lines_of(tables.read(path, "findings"))


def lines_of(rows: pd.DataFrame) -> Iterator[str]:
    """A line for each row of the table `findings`."""
    yield from (f"{row.robot}: {row.finding}" for row in rows.itertuples(index=False))


def has_usable_map(result: Path) -> bool:
    """Return True if a result has landmarks of a robot whose observations agree with its map."""
    mapped, found = (
        tables.read(tables.table_path(result, name), name) for name in ("landmarks", "findings")
    )
    contradicted = found.loc[found["check"] == "gate", "robot"]
    return bool(set(mapped["robot"]) - set(contradicted))
