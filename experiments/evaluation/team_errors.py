"""Errors of a whole team: paths in one frame, and the accepted alignments.

The ATE of a team moves the paths of all its robots by the motions that merged their maps, and then
all of them by one rigid fit to the truth: what the robots are off against each other counts. Of one
robot it is evo's.
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
from mapfusion.fusion.team_graph import Place
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float

_PAIR = ["robot_a", "robot_b"]
# What a pair of robots takes over from its row of `errors`.
_ALONE = ["accepted", "n_common", "refined_translation_error_m", "refined_rotation_error_rad"]


def team_rows(
    team: FusedTeam, paths: pd.DataFrame, T_first_smoothed: Float | None = None
) -> list[dict[str, Any]]:
    """Rows of the table `team` from those of the table `paths`; none where nothing was merged.

    `T_first_smoothed` (M, 3) is how a fuser of smoothed maps moved them, NaN for those left out:
    where it merged the same robots, their smoothed paths are moved by it.
    """
    own = dict(iter(paths.groupby("robot", sort=False)))
    rows = []
    for number, T_first_map in enumerate(_placements(team), start=1):
        placed = np.isfinite(T_first_map[:, 0])
        members = [(k, robot) for k, robot in enumerate(team.robots) if placed[k]]
        row = {"component": number, "n_robots": len(members), "n_team": len(team.robots)}
        for source in _sources_of([own[robot.name] for _, robot in members]):
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


def _sources_of(paths: list[pd.DataFrame]) -> list[str]:
    """The kinds of paths that all of these robots have; not every log is smoothed."""
    first = {source: f"{source}_{POSE_FIELDS[0]}" for source in SOURCES}
    return [
        source
        for source, column in first.items()
        if all(column in own and own[column].notna().any() for own in paths)
    ]


def _placements(team: FusedTeam) -> Iterator[Float]:
    """T_first_map (M, 3) of each set of robots that were merged, or of a robot that was alone."""
    if team.fusion is None:
        yield np.zeros((1, 3))
    else:
        yield from (each.T_first_map for each in team.fusion.fused if len(each.members) > 1)


def _poses(paths: pd.DataFrame, source: str) -> Float:
    """(T, 3) of a robot, from one source or the truth."""
    return paths[[f"{source}_{name}" for name in POSE_FIELDS]].to_numpy()


@dataclass(frozen=True)
class PlacedPath:
    """One robot's path beside the truth.

    Attributes:
        poses: (T, 3) estimated, in the robot's map frame.
        truth: (T, 3) true ones, in its own; NaN where unknown.
        T_first_map: (3,) how the robot's map was moved when it was merged.
        T_world_map: (3,) where its frame truly is.
    """

    poses: Float
    truth: Float
    T_first_map: Float
    T_world_map: Float

    def in_one_frame(self) -> tuple[Float, Float]:
        """Estimated poses (n, 3) in the fused frame and true ones in the world, where known."""
        known = np.isfinite(self.truth).all(axis=1)
        poses, truth = self.poses[known], self.truth[known]
        return se2.compose(self.T_first_map, poses), se2.compose(self.T_world_map, truth)


def team_ate_m(paths: Sequence[PlacedPath]) -> Float:
    """Errors (N,) in m of the positions of all robots, after one rigid fit of all of them."""
    together = zip(*(own.in_one_frame() for own in paths), strict=True)
    path, truth = (np.concatenate(poses) for poses in together)
    return ate_m(path, truth)


def team_pair_rows(team: FusedTeam, errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    """Rows of the table `team_pairs`: each two robots, aligned alone and placed with all others."""
    edges = team_edge_rows(team)
    if edges.empty:
        return edges
    used = (errors["aligner"] == aligner) & (errors["repetition"] == 0)
    rows = edges.merge(criteria.at_the_end(errors[used])[[*_PAIR, *_ALONE]], "left", _PAIR)
    place = {robot.name: k for k, robot in enumerate(team.robots)}
    index = rows[_PAIR].map(place.get).to_numpy()
    off = _placed_errors(team, index)
    return rows.assign(team_translation_error_m=off[:, 0], team_rotation_error_rad=off[:, 1])


def _placed_errors(team: FusedTeam, pairs: np.ndarray) -> Float:
    """Errors (E, 2) in m and rad of T_a_b between robots (E, 2) as the team places them.

    NaN where it does not place both in one map.
    """
    T_world_map = np.array([robot.path.T_world_map for robot in team.robots])
    a, b = pairs.T
    off = np.full((len(pairs), 2), np.nan)
    for T_first_map in _placements(team):
        error = se2.between(T_first_map[a], T_first_map[b]) - se2.between(
            T_world_map[a], T_world_map[b]
        )
        own = np.column_stack([np.hypot(error[:, 0], error[:, 1]), se2.wrap(error[:, 2])])
        off = np.where(np.isfinite(own), own, off)
    return off


def is_used_by_team(pairs: pd.DataFrame) -> pd.Series:
    """Bool per row of `team_pairs`: whether the team's map was placed by this alignment."""
    return pairs["place"].isin([Place.CONFIRMED, Place.BRIDGE])


def edge_precision(pairs: pd.DataFrame) -> float:
    """Share of right ones among the alignments that were believed; NaN where none were."""
    used = pairs[is_used_by_team(pairs)]
    return float(1 - criteria.is_false_merge(used).mean())


def edge_recall(pairs: pd.DataFrame) -> float:
    """Share of the pairs with common ground whose alignment is right and was believed."""
    met = pairs[criteria.has_common_ground(pairs)]
    return float((criteria.right_refined(met) & is_used_by_team(met)).mean())
