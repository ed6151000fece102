"""Stage that compares the estimates of one robot pair with the truth."""

import functools
from dataclasses import dataclass

import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.alignment_errors import EvaluatedRobot, error_rows, join_map_pairs
from experiments.evaluation.fused_landmarks import MergeSettings, fusion_rows
from experiments.evaluation.truth import PathTruth, landmark_truth, truth_or_unknown
from experiments.pipeline.stage import Job
from experiments.pipeline.stages.slam import ROBOTS_KEPT, RobotFolders, folders_of_both, stored_maps
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log
from mapfusion.verification.verdict import Verifier

WRITES = ("errors.parquet", "fusion.parquet")
# Tables of the stage `align`, in the order of the arguments of `join_map_pairs`.
ALIGNED = ("estimates", "correspondences", "rivals")


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the evaluation of alignments."""

    judge: Verifier
    merge: MergeSettings
    true_pair_radius_m: float


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def load_robot(folders: RobotFolders, viewing: bool = True) -> EvaluatedRobot:
    """Load a robot's maps with the true points of their landmarks; NaN where unknown.

    The result stays in memory, as that of `stored_maps`.

    Args:
        folders: folders of the log and of the maps.
        viewing: whether to load the viewing evidence of the maps.

    Raises:
        InputError: the truth and the log differ in their number of rows.
    """
    log = read_log(folders.log)
    truth = truth_or_unknown(folders.log, log)
    poses, points = (truth.T_world_robot, log), (truth.point_world_m, log.observations)
    for file, (true, logged) in (("truth_poses", poses), ("truth_points", points)):
        if len(true) != len(logged):
            counts = f"{len(true)} rows, the log has {len(logged)} of them"
            raise InputError(f"{folders.log / file}.parquet: {counts}")
    maps = stored_maps(folders, viewing)
    points = landmark_truth(truth, maps.associations.at, maps)
    return EvaluatedRobot(log.robot, maps, points, PathTruth.of(truth))


def run(settings: EvaluationSettings, job: Job) -> None:
    """Write the pair's `errors.parquet` and `fusion.parquet`."""
    robots = [load_robot(folders) for folders in folders_of_both(job)]
    aligned = [tables.read(job.inputs["align"] / f"{name}.parquet", name) for name in ALIGNED]
    map_pairs, radius_m = join_map_pairs(robots, *aligned), settings.true_pair_radius_m
    errors = pd.concat([error_rows(pair, settings.judge, radius_m) for pair in map_pairs])
    tables.write(job.output / "errors.parquet", "errors", errors)
    fusion = fusion_rows(map_pairs, settings.merge, radius_m)
    tables.write(job.output / "fusion.parquet", "fusion", fusion)
