"""Robots that go on in a joint map, compared with the truth and with independent robots.

The same logs are filtered alone (stage `slam`) and as a team (stage `team`). Paths have the true
start and no fit. The true point of a landmark is that of the observation that created it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.evaluation.alignment_criteria import is_right
from experiments.evaluation.map_consistency import GROSS_M, MOST_GROSS
from experiments.evaluation.truth import PathTruth, motion_errors
from experiments.pipeline.stages import slam, team
from experiments.pipeline.tables import read_rows
from mapfusion.files import POSE_FIELDS, points_from
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, chi_square_bound, squared_mahalanobis
from mapfusion.robot_log import RobotTruth

_COVERED = 0.95  # nominal probability of the ellipses
ADOPTED, DROPPED = "adopted", "dropped"
# Reason why figure 13 is not drawn; screens do not show it, as most scenarios have no team.
NO_TEAM = "the robots do not exchange maps (`team` of the scenario)"


@dataclass(frozen=True)
class TeamMember:
    """Robot of a team with its truth.

    Attributes:
        name: name of the robot.
        truth: its truth.
        slam: folder of the stage of its independent filter.
        smoothed: paths of the smoother of its own log, by iteration.
    """

    name: str
    truth: RobotTruth
    slam: Path
    smoothed: Mapping[int, Float]

    @property
    def path(self) -> PathTruth:
        """True path."""
        return PathTruth.of(self.truth)


def event_rows(folder: Path, members: Sequence[TeamMember]) -> pd.DataFrame:
    """Return the rows of the table `adoptions`: events with the errors of their motions."""
    events = read_rows(folder / "events.parquet", team.EVENTS)
    start = {member.name: member.path.T_world_map for member in members}
    errors = []
    for row in events.itertuples():
        T_true = se2.between(start[str(row.robot)], start[str(row.other)])
        errors.append(motion_errors(np.array([row.tx_m, row.ty_m, row.theta_rad]), T_true))
    columns = np.array(errors).reshape(-1, 2).T
    events["translation_error_m"], events["rotation_error_rad"] = columns
    return events


def message_rows(folder: Path, members: Sequence[TeamMember]) -> pd.DataFrame:
    """Return the rows of the table `messages`."""
    return read_rows(folder / "messages.parquet", team.MESSAGES)


def member_rows(folder: Path, members: Sequence[TeamMember]) -> list[dict[str, Any]]:
    """Return the rows of the table `team_members`: each robot at each evaluated iteration."""
    paths = read_rows(folder / "paths.parquet", team.PATHS)
    maps = read_rows(folder / "maps.parquet", team.MAPS)
    steps = read_rows(folder / "steps.parquet", team.STEPS)
    events = read_rows(folder / "events.parquet", team.EVENTS)
    messages = read_rows(folder / "messages.parquet", team.MESSAGES)
    point_world_m = {member.name: member.truth.point_world_m for member in members}
    rows = []
    for member in members:
        alone = read_rows(member.slam / "paths.parquet", slam.PATHS)
        own = paths[paths["robot"] == member.name]
        first = events[(events["robot"] == member.name) & (events["event"] == ADOPTED)]
        merged_at = first["iteration"].min() if len(first) else np.inf
        observed = steps[steps["robot"] == member.name]
        sent = messages[messages["sender"] == member.name]
        for k in sorted(own["evaluated"].unique().tolist()):
            given = maps[(maps["robot"] == member.name) & (maps["iteration"] == k)]
            row: dict[str, Any] = {"robot": member.name, "iteration": k}
            known = {
                "": own[own["evaluated"] == k],
                "alone_": alone[alone["evaluated"] == min(k, alone["evaluated"].max())],
            }
            for prefix, poses in known.items():
                path = poses[POSE_FIELDS].to_numpy(np.float64)
                row |= _path_errors(path, member.path.T_map_robot, merged_at, prefix)
            smoothed = member.smoothed.get(k)
            row["smoothed_path_rmse_m"] = np.nan
            if smoothed is not None:
                errors = _path_errors(smoothed, member.path.T_map_robot, merged_at, "")
                row["smoothed_path_rmse_m"] = errors["path_rmse_m"]
            since = observed[(observed["iteration"] <= k) & (observed["iteration"] > merged_at)]
            n_observed = since["n_observed"].sum()
            row["shared_share"] = since["n_shared"].sum() / n_observed if n_observed else np.nan
            row["sent_kb"] = sent.loc[sent["iteration"] <= k, "n_bytes"].sum() / 1e3
            row |= _landmark_errors(given, member, point_world_m)
            rows.append(row)
    return rows


def _path_errors(path: Float, truth: Float, merged_at: float, prefix: str) -> dict[str, float]:
    """Return the RMS position errors of all poses and of those since the first merge."""
    error_m = np.linalg.norm(path[:, :2] - truth[: len(path), :2], axis=1)
    parts = {
        "path_rmse_m": error_m,
        "merged_path_rmse_m": error_m[np.arange(len(path)) > merged_at],
    }
    known = {name: values[np.isfinite(values)] for name, values in parts.items()}
    return {
        f"{prefix}{name}": float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
        for name, values in known.items()
    }


def _landmark_errors(
    rows: pd.DataFrame, member: TeamMember, point_world_m: Mapping[str, Float]
) -> dict[str, Any]:
    """Return errors and consistency of the landmarks that other robots observed first."""
    adopted = rows[rows["origin"] != member.name]
    result: dict[str, Any] = {"n_landmarks": len(rows), "n_adopted": len(adopted)}
    nothing = dict.fromkeys(
        ("landmark_rmse_m", "gross_share", "frame_nees_per_dof", "frame_coverage_95"), np.nan
    )
    if not len(adopted):
        return result | nothing
    true_m = np.array(
        [
            point_world_m[name][row]
            for name, row in zip(adopted["origin"], adopted["row"], strict=True)
        ]
    )
    position, covariance = points_from(pa.Table.from_pandas(adopted, preserve_index=False))
    in_map = se2.transform_points(se2.inverse(member.path.T_world_map), true_m[:, :2])
    error_m = position[:, :2] - in_map
    known = np.isfinite(error_m).all(axis=1)
    error_m, covariance = error_m[known], covariance[known][:, :2, :2]
    if not len(error_m):
        return result | nothing
    gross = np.linalg.norm(error_m, axis=1) > GROSS_M
    squares = squared_mahalanobis(error_m, covariance)
    too_many = bool(np.mean(gross) > MOST_GROSS)
    return result | {
        "landmark_rmse_m": np.inf if too_many else _rms(error_m[~gross]),
        "gross_share": float(np.mean(gross)),
        "frame_nees_per_dof": np.nan if too_many else float(np.mean(squares[~gross]) / 2),
        "frame_coverage_95": float(np.mean(squares <= chi_square_bound(_COVERED, 2))),
    }


def _rms(error_m: Float) -> float:
    return float(np.sqrt(np.mean(np.sum(error_m**2, axis=1))))


def false_adoptions(adoptions: pd.DataFrame) -> int:
    """Return the number of wrong maps that robots adopted and did not drop later."""
    wrong = 0
    for _, rows in adoptions.groupby(["robot", "other"]):
        kept = rows[rows["event"].isin((ADOPTED, DROPPED))].iloc[-1:]
        adopted = kept[kept["event"] == ADOPTED]
        right = is_right(adopted["translation_error_m"], adopted["rotation_error_rad"])
        wrong += int((~right).sum())
    return wrong
