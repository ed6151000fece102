"""Smoothed maps and paths, compared with the truth and with the filter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_errors import EvaluatedRobot
from experiments.evaluation.map_consistency import fit_to_truth, relative_consistency
from experiments.evaluation.path_errors import ate_m
from experiments.evaluation.truth import landmark_truth, truth_or_unknown
from experiments.pipeline.stages.slam import RobotFolders, final_path
from experiments.pipeline.stages.smooth import (
    read_endings,
    read_smoothed,
    read_smoothed_path,
    smoothed_owners,
)
from mapfusion.files import POSE_FIELDS, named_columns
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog


@dataclass(frozen=True)
class SmoothedRobot:
    """Smoothed maps and paths of a robot, by iteration, with the truth.

    Attributes:
        robot: maps of the filter, and true path.
        filter_path: path of the filter at the end, shape (T, 3).
        maps: smoothed maps; only the last one has its joint covariance.
        points_world_m: true points of each map, shape (N, 3), NaN where unknown.
        paths: smoothed paths until each iteration k, shape (k + 1, 3).
        ending: convergence of the smoother at the last iteration.
        not_smoothed: reasons by iteration where smoothing failed.
    """

    robot: EvaluatedRobot
    filter_path: Float
    maps: dict[int, LandmarkMap]
    points_world_m: dict[int, Float]
    paths: dict[int, Float]
    ending: dict[str, Any]
    not_smoothed: Mapping[int, str] = field(default_factory=dict)

    @property
    def last_path(self) -> Float:
        """Smoothed path of the whole log, shape (T, 3); NaN if smoothing failed."""
        unknown = np.full_like(self.filter_path, np.nan)
        return self.paths.get(len(self.filter_path) - 1, unknown)

    def given_at(self, iteration: int) -> tuple[int | None, str]:
        """Return the iteration of the smoothed map that a fuser is given at an iteration.

        Returns:
            The iteration of the last smoothed map until then, or None: the fuser is given the
            filter's map. And the reason if smoothing failed at the iteration; else empty.
        """
        at = max((k for k in self.maps if k <= iteration), default=None)
        lacking = max((k for k in self.not_smoothed if k <= iteration), default=-1)
        if (at is not None and at > lacking) or lacking < 0:
            return at, ""
        instead = "FastSLAM's map" if at is None else f"its map until frame {at}"
        return at, f"{self.not_smoothed[lacking]}; {instead} stands in"


def load_smoothed(
    robot: EvaluatedRobot, folders: RobotFolders, log: RobotLog, smooth: Path
) -> SmoothedRobot:
    """Load a robot's smoothed maps and paths with the truth; NaN where unknown.

    Args:
        robot: maps of the filter, and true path.
        folders: folders of its log and of the stage `slam`.
        log: its log.
        smooth: folder of the stage `smooth`.
    """
    truth, maps = truth_or_unknown(folders.log, log), read_smoothed(smooth, last_whole=True)
    points = landmark_truth(truth, partial(smoothed_owners, smooth, folders.slam), maps)
    endings = read_endings(smooth)
    reasons = dict(zip(endings["iteration"].tolist(), endings["not_smoothed"], strict=True))
    not_smoothed = {k: str(why) for k, why in reasons.items() if why}
    ending = {str(name): value for name, value in endings.to_dict("records")[-1].items()}
    path, paths = final_path(folders.slam), read_smoothed_path(smooth)
    return SmoothedRobot(robot, path, maps, points, paths, ending, not_smoothed)


def smoothed_path_rows(smoothed: Sequence[SmoothedRobot]) -> pd.DataFrame:
    """Return the rows of the table `smoothed_paths`."""
    rows = [
        pd.DataFrame(named_columns(POSE_FIELDS, path)).assign(
            robot=each.robot.name, iteration=k, frame=np.arange(len(path))
        )
        for each in smoothed
        for k, path in each.paths.items()
    ]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def smoother_rows(smoothed: Sequence[SmoothedRobot]) -> list[dict[str, Any]]:
    """Return the rows of the table `smoother`: last maps and whole paths of the robots."""
    return [_smoother_row(each) for each in smoothed]


def _smoother_row(smoothed: SmoothedRobot) -> dict[str, Any]:
    robot, last = smoothed.robot, len(smoothed.filter_path) - 1
    path_m, filter_m = (
        path_rmse_m(path, robot.path.T_map_robot)
        for path in (smoothed.last_path, smoothed.filter_path)
    )
    row = {"robot": robot.name, "path_rmse_m": path_m, "filter_path_rmse_m": filter_m}
    row |= {"filter_over_smoother": filter_m / path_m if path_m > 0 else np.nan} | smoothed.ending
    row["not_smoothed"] = smoothed.given_at(last)[1]
    of_filter = fit_to_truth(robot.maps[last], robot.points_world_m[last])
    row |= {"filter_landmark_rmse_m": of_filter.rmse_m, "filter_gross_share": of_filter.gross_share}
    if last not in smoothed.maps:
        return row | {"n_landmarks": 0}
    landmarks = smoothed.maps[last]
    fit = fit_to_truth(landmarks, smoothed.points_world_m[last])
    row |= {"landmark_rmse_m": fit.rmse_m, "gross_share": fit.gross_share}
    row |= {"n_landmarks": len(landmarks)}
    consistency = relative_consistency(landmarks, fit)
    names = ("nees_per_dof", "marginal_nees_per_dof", "coverage_95")
    return row | {name: getattr(consistency, name) for name in names}


def path_rmse_m(path: Float, truth: Float) -> float:
    """Return the RMS position error without a fit; NaN if no pose is known in both paths."""
    known = np.isfinite(path).all(axis=1) & np.isfinite(truth).all(axis=1)
    if not known.any():
        return np.nan
    return float(np.sqrt(np.mean(ate_m(path[known], truth[known], fit=False) ** 2)))
