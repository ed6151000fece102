"""Findings: contradictions of the logs of a run with themselves and with their truth."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge import tables
from experiments.judge.judged_run import JudgedRun
from experiments.run.stages.slam import read_findings
from experiments.scenario.settings import Recording
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.log_consistency import (
    Finding,
    composed_spans,
    observed_spans,
    odometry_motions,
    truth_finding,
)
from mapfusion.robot_log import RobotLog, read_true_poses
from mapfusion.se2 import Float


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
