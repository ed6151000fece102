"""Stage: one robot pair's estimates against the truth, and whether fusing the pair was worth it."""

import time

from experiments.judge import tables
from experiments.judge.errors import EvaluatedRobot, error_rows
from experiments.judge.fused_landmarks import fusion_rows
from experiments.judge.truth import PathTruth, landmark_truth
from experiments.run.stages.slam import RobotFolders, read_associations, read_snapshots
from experiments.run.store import StageFolder, Store
from experiments.scenario.settings import Scenario
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log, read_truth

SOURCES = ("mapfusion", "experiments/judge/judging.py", "experiments/judge/errors.py")
SOURCES += (
    "experiments/judge/fused_landmarks.py",
    "experiments/judge/truth.py",
    "experiments/judge/tables.py",
    "experiments/judge/criteria.py",
    "experiments/run/estimates.py",
)


def load_robot(folders: RobotFolders) -> EvaluatedRobot:
    """A robot's maps joined with the truth."""
    log, truth = read_log(folders.log), read_truth(folders.log)
    for file, rows, expected in (
        ("truth_poses", truth.T_world_robot, len(log)),
        ("truth_points", truth.point_world_m, len(log.observations)),
    ):
        if len(rows) != expected:
            raise InputError(
                f"{folders.log / file}.parquet: {len(rows)} rows, the log has {expected} of them"
            )
    maps = read_snapshots(folders.slam, log)
    points = landmark_truth(truth, read_associations(folders.slam), maps)
    return EvaluatedRobot(log.robot, maps, points, PathTruth.of(truth))


def stage(
    store: Store, scenario: Scenario, align: StageFolder, slams: list[StageFolder]
) -> StageFolder:
    """Where this pair's errors are or will be."""
    resolved = scenario.resolved()
    settings = {
        "refinement": resolved["align"]["refinement"],
        "acceptance": resolved["align"]["acceptance"],
        "merge": resolved["merge"],
        "radius_m": scenario.evaluate.true_pair_radius_m,
    }
    return store.stage("judge", settings, [align, *slams], SOURCES)


def run(
    scenario: Scenario, a: RobotFolders, b: RobotFolders, align: StageFolder, output: StageFolder
) -> None:
    """Write the pair's `errors.parquet` and `fusion.parquet`."""
    started = time.perf_counter()
    robot_a, robot_b = load_robot(a), load_robot(b)
    estimates = tables.read(align.path / "estimates.parquet", "estimates")
    correspondences = tables.read(align.path / "correspondences.parquet", "correspondences")
    radius_m = scenario.evaluate.true_pair_radius_m
    settings = scenario.align
    errors = error_rows(
        robot_a,
        robot_b,
        estimates,
        correspondences,
        settings.refinement,
        settings.acceptance,
        radius_m,
    )
    tables.write(output.path / "errors.parquet", "errors", errors)
    fusion = fusion_rows(robot_a, robot_b, estimates, correspondences, scenario.merge, radius_m)
    tables.write(output.path / "fusion.parquet", "fusion", fusion)
    output.finish(elapsed_s=time.perf_counter() - started)
