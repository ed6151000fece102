"""Errors of a team of robots: paths in a common frame, and alignments that the team uses.

The ATE of a team is computed in two steps. First each path is moved as the robot's map was moved
into the fused map. Then one rigid fit moves all paths together onto the truth. So relative errors
between robots count. For one robot the value is the ATE of evo.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import criteria
from experiments.evaluation.fused_landmarks import FusedTeam, team_edge_rows
from experiments.evaluation.path_errors import SMOOTHED, SOURCES, ate_m, seven_statistics
from mapfusion.files import POSE_FIELDS
from mapfusion.fusion.team_graph import EdgeStatus
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float

_PAIR = ["robot_a", "robot_b"]
# Columns of `team_pairs` from the row of `errors` of the pair.
_OWN_ALIGNMENT = [
    "accepted",
    "n_common",
    "refined_translation_error_m",
    "refined_rotation_error_rad",
]


def team_rows(
    team: FusedTeam, paths: pd.DataFrame, T_first_smoothed: Float | None = None
) -> list[dict[str, Any]]:
    """Return the rows of the table `team`; none if nothing was merged.

    Args:
        team: last maps, merged.
        paths: rows of the table `paths`.
        T_first_smoothed: motions of the maps by a fuser of smoothed maps, shape (M, 3), NaN for
            maps that it left out. If it merged the same robots, it moves their smoothed paths.
    """
    own = dict(iter(paths.groupby("robot", sort=False)))
    rows = []
    for number, T_first_map in enumerate(_placements(team), start=1):
        placed = np.isfinite(T_first_map[:, 0])
        members = [(k, robot) for k, robot in enumerate(team.robots) if placed[k]]
        row = {"component": number, "n_robots": len(members), "n_team": len(team.robots)}
        member_paths = [own[robot.name] for _, robot in members]
        for source in SOURCES:
            column = f"{source}_{POSE_FIELDS[0]}"
            if not all(column in path and path[column].notna().any() for path in member_paths):
                continue
            T_moved = T_first_map
            if source == SMOOTHED and T_first_smoothed is not None:
                same = np.array_equal(np.isfinite(T_first_smoothed[:, 0]), placed)
                T_moved = T_first_smoothed if same else T_first_map
            errors = team_ate_m(
                [
                    PlacedPath(
                        _poses(own[robot.name], source),
                        _poses(own[robot.name], "truth"),
                        T_moved[k],
                        robot.path.T_world_map,
                    )
                    for k, robot in members
                ]
            )
            rows.append(row | {"source": source, "n": len(errors)} | seven_statistics(errors))
    return rows


def _placements(team: FusedTeam) -> Iterator[Float]:
    """Yield T_first_map (M, 3) of each group of merged robots, or of a single robot."""
    if team.fusion is None:
        yield np.zeros((1, 3))
    else:
        yield from (each.T_first_map for each in team.fusion.fused if len(each.members) > 1)


def _poses(paths: pd.DataFrame, source: str) -> Float:
    """Return the poses (T, 3) of a robot from a source or from the truth."""
    return paths[[f"{source}_{name}" for name in POSE_FIELDS]].to_numpy()


@dataclass(frozen=True)
class PlacedPath:
    """Path of one robot with the truth.

    Attributes:
        poses: estimated poses in the frame of the robot's map, shape (T, 3).
        truth: true poses in the same frame, shape (T, 3); NaN where unknown.
        T_first_map: motion of the robot's map into the fused map, shape (3,).
        T_world_map: true origin of the frame, shape (3,).
    """

    poses: Float
    truth: Float
    T_first_map: Float
    T_world_map: Float

    def in_one_frame(self) -> tuple[Float, Float]:
        """Return estimated poses in the fused frame and true poses in the world, shape (n, 3)."""
        known = np.isfinite(self.truth).all(axis=1)
        poses, truth = self.poses[known], self.truth[known]
        return se2.compose(self.T_first_map, poses), se2.compose(self.T_world_map, truth)


def team_ate_m(paths: Sequence[PlacedPath]) -> Float:
    """Return position errors (N,) in m of all robots after one rigid fit of all paths."""
    estimated_and_true = zip(*(own.in_one_frame() for own in paths), strict=True)
    path, truth = (np.concatenate(poses) for poses in estimated_and_true)
    return ate_m(path, truth)


def team_pair_rows(team: FusedTeam, errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    """Return the rows of the table `team_pairs`: own alignment and relative pose in the team."""
    edges = team_edge_rows(team)
    if edges.empty:
        return edges
    used = (errors["aligner"] == aligner) & (errors["repetition"] == 0)
    rows = edges.merge(criteria.at_the_end(errors[used])[[*_PAIR, *_OWN_ALIGNMENT]], "left", _PAIR)
    index = {robot.name: k for k, robot in enumerate(team.robots)}
    a, b = rows[_PAIR].map(index.get).to_numpy().T
    # errors of T_a_b in the fused maps; NaN for robots in different maps
    T_world_map = np.array([robot.path.T_world_map for robot in team.robots])
    T_true, errors_of_team = (
        se2.between(T_world_map[a], T_world_map[b]),
        np.full((2, len(a)), np.nan),
    )
    for T_first_map in _placements(team):
        error = se2.between(T_first_map[a], T_first_map[b]) - T_true
        found = np.stack([np.hypot(error[:, 0], error[:, 1]), se2.wrap(error[:, 2])])
        errors_of_team = np.where(np.isfinite(found), found, errors_of_team)
    translation_m, rotation_rad = errors_of_team
    return rows.assign(team_translation_error_m=translation_m, team_rotation_error_rad=rotation_rad)


def is_used_by_team(pairs: pd.DataFrame) -> pd.Series:
    """Return True for rows of `team_pairs` whose alignment moved maps in the fusion."""
    return pairs["place"].isin([EdgeStatus.CONFIRMED, EdgeStatus.BRIDGE])


def edge_precision(pairs: pd.DataFrame) -> float:
    """Return the share of right alignments among those that the team uses; NaN if it uses none."""
    used = pairs[is_used_by_team(pairs)]
    return float(1 - criteria.is_false_merge(used).mean())


def edge_recall(pairs: pd.DataFrame) -> float:
    """Return the share of pairs with common ground whose right alignment the team uses."""
    overlapping = pairs[criteria.has_common_ground(pairs)]
    return float((criteria.right_refined(overlapping) & is_used_by_team(overlapping)).mean())
