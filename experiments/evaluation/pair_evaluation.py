"""Stage: estimates of one robot pair compared with the truth."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.alignment_errors import EvaluatedRobot, error_rows, met_maps
from experiments.evaluation.fused_landmarks import MergeSettings, fusion_rows
from experiments.evaluation.truth import PathTruth, landmark_truth
from experiments.pipeline.stage import Job
from experiments.pipeline.stages.slam import ROBOTS_KEPT, RobotFolders, folders_of_both, stored_maps
from mapfusion.errors import InputError
from mapfusion.robot_log import TRUTH_TABLES, RobotLog, RobotTruth, read_log, read_truth
from mapfusion.tables import table_path
from mapfusion.verification.verdict import Judge

WRITES = ("errors.parquet", "fusion.parquet")
ALIGNED = ("estimates", "correspondences", "rivals")  # tables of the align stage, per pair of maps


@dataclass(frozen=True)
class JudgeSettings:
    """All that the judgement depends on, beside maps, estimates and truth."""

    judge: Judge
    merge: MergeSettings
    true_pair_radius_m: float


def truth_of(folder: Path, log: RobotLog) -> RobotTruth:
    """The truth beside a log; NaN where there is none."""
    if all(table_path(folder, name).is_file() for name in TRUTH_TABLES):
        return read_truth(folder)
    return RobotTruth(np.full((len(log), 3), np.nan), np.full((len(log.observations), 3), np.nan))


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def load_robot(folders: RobotFolders, viewing: bool = True) -> EvaluatedRobot:
    """A robot's maps joined with the truth beside its log, which is NaN where it is unknown.

    They stay in memory as `stored_maps` do, with or without viewing evidence.
    """
    log = read_log(folders.log)
    truth = truth_of(folders.log, log)
    poses, points = (truth.T_world_robot, log), (truth.point_world_m, log.observations)
    for file, (true, logged) in (("truth_poses", poses), ("truth_points", points)):
        if len(true) != len(logged):
            counts = f"{len(true)} rows, the log has {len(logged)} of them"
            raise InputError(f"{folders.log / file}.parquet: {counts}")
    maps = stored_maps(folders, viewing)
    points = landmark_truth(truth, maps.associations.at, maps)
    return EvaluatedRobot(log.robot, maps, points, PathTruth.of(truth))


def run(settings: JudgeSettings, job: Job) -> None:
    """Write the pair's `errors.parquet` and `fusion.parquet`."""
    robots = [load_robot(folders) for folders in folders_of_both(job)]
    aligned = [tables.read(job.inputs["align"] / f"{name}.parquet", name) for name in ALIGNED]
    met, radius_m = met_maps(robots, *aligned), settings.true_pair_radius_m
    errors = pd.concat([error_rows(maps, settings.judge, radius_m) for maps in met])
    tables.write(job.output / "errors.parquet", "errors", errors)
    fusion = fusion_rows(met, settings.merge, radius_m)
    tables.write(job.output / "fusion.parquet", "fusion", fusion)
