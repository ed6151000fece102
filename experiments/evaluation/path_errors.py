"""Errors of the paths of robots and teams: absolute trajectory error, relative pose error.

Both are defined as in Sturm et al. (2012), in the plane. The tests compare them with evo (`evo_ape
-a` and `evo_rpe --pairs_from_reference`), whose seven statistics are used.

The ATE of a team is computed in two steps. First each path is moved as the robot's map was moved
into the fused map. Then one rigid fit moves all paths together onto the truth. So relative errors
between robots count. For one robot the value is the ATE of evo.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import alignment_criteria
from experiments.evaluation.fused_landmarks import FusedTeam, team_edge_rows
from experiments.evaluation.truth import PathTruth, motion_errors
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.files import POSE_FIELDS
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float

SMOOTHED = "smoothed"  # path of the smoother; some robots have none
SOURCES = ("final", "online", "odometry", SMOOTHED)
# Frames and metres between the two poses of an RPE: the errors of a step and of a short drive.
RPE_DELTA = 1
STATISTICS: dict[str, Callable[[Float], float]] = {
    "rmse": lambda errors: np.sqrt(np.mean(errors**2)),
    **{of.__name__: of for of in (np.mean, np.median, np.std, np.min, np.max)},
    "sse": lambda errors: np.sum(errors**2),
}


def seven_statistics(errors: Float) -> dict[str, float]:
    """Return the statistics of evo of errors (N,); NaN for N = 0. `std` is the population's."""
    return {name: of(errors) if len(errors) else np.nan for name, of in STATISTICS.items()}


def ate_m(path: Float, truth: Float, fit: bool = True) -> Float:
    """Return the absolute trajectory errors: distances to the true positions.

    Args:
        path: estimated poses, shape (N, 3).
        truth: true poses, shape (N, 3), all known.
        fit: move the path onto the truth by the least-squares rigid motion without scale (Umeyama
            1991; in the plane the closed form of `fit_rigid`).

    Returns:
        Errors in m, shape (N,).
    """
    positions = path[:, :2]
    if fit and len(path) > 1:
        T_truth_path = np.array(fit_rigid(truth[:, :2], positions, np.arange(len(path))))
        positions = se2.transform_points(T_truth_path, positions)
    return np.linalg.norm(positions - truth[:, :2], axis=1)


def rpe(path: Float, truth: Float, pairs: np.ndarray) -> tuple[Float, Float]:
    """Return the relative pose errors E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Sturm et al. (2012), eq. 2.

    Args:
        path: estimated poses P, shape (N, 3).
        truth: true poses Q, shape (N, 3).
        pairs: rows i and j of both, shape (M, 2).

    Returns:
        Lengths in m and angles in rad of E, shape (M,) each.
    """
    i, j = pairs.T
    error = se2.between(se2.between(truth[i], truth[j]), se2.between(path[i], path[j]))
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def pairs_by_frames(known: np.ndarray, delta: int) -> np.ndarray:
    """Return consecutive pairs of known poses that are `delta` frames apart.

    Args:
        known: True for known poses, shape (T,).
        delta: number of frames.

    Returns:
        Rows among the known poses, shape (P, 2).
    """
    first = np.arange(0, len(known) - delta, delta)
    row = np.cumsum(known) - 1
    both = known[first] & known[first + delta]
    return np.stack([row[first[both]], row[first[both] + delta]], axis=1)


def pairs_by_length(positions_m: Float, delta_m: float) -> np.ndarray:
    """Return consecutive pairs of rows (P, 2) between which the path is at least `delta_m` long."""
    ends, length_m = [0], 0.0
    for row, step_m in enumerate(np.linalg.norm(np.diff(positions_m, axis=0), axis=1), start=1):
        length_m += step_m
        if length_m >= delta_m:
            ends.append(row)
            length_m = 0.0
    return np.array([ends[:-1], ends[1:]], dtype=np.int64).T


def robot_paths(poses: pd.DataFrame, odometry: Float, truth: PathTruth) -> pd.DataFrame:
    """Return the rows of the tables `paths` and `robots` of one robot.

    Args:
        poses: poses of the stage `slam`.
        odometry: motions from frame to frame, shape (T, 3).
        truth: true path.
    """
    dead_reckoned = np.array([*accumulate(odometry[1:], se2.compose, initial=np.zeros(3))])
    rows = poses.copy()
    for source, values in (("odometry", dead_reckoned), ("truth", truth.T_map_robot)):
        rows[[f"{source}_{name}" for name in POSE_FIELDS]] = values[: len(rows)]
    for source, path in (("path", "online"), ("odometry", "odometry")):
        x, y, turn = (rows[f"{path}_{name}"] - rows[f"truth_{name}"] for name in POSE_FIELDS)
        rows[f"{source}_error_m"], rows[f"{source}_error_rad"] = np.hypot(x, y), se2.wrap(turn)
    return rows


def path_statistics_rows(paths: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of the table `path_statistics`.

    Args:
        paths: rows of the table `paths`, and optionally columns of the smoothed path.
    """
    rows = []
    for robot, own in paths.groupby("robot", sort=False):
        all_poses = {
            source: own[[f"{source}_{name}" for name in POSE_FIELDS]].to_numpy()
            for source in (*SOURCES, "truth")
            if f"{source}_{POSE_FIELDS[0]}" in own
            and own[f"{source}_{POSE_FIELDS[0]}"].notna().any()
        }
        truth = all_poses.pop("truth", np.full((len(own), 3), np.nan))
        known = np.asarray(np.isfinite(truth).all(axis=1))
        truth = truth[known]
        by_frames = pairs_by_frames(known, RPE_DELTA)
        by_length = pairs_by_length(truth[:, :2], RPE_DELTA)
        for source, poses in all_poses.items():
            path = poses[known]
            measured = [
                ("ate_m", np.nan, "", ate_m(path, truth)),
                ("ate_from_start_m", np.nan, "", ate_m(path, truth, fit=False)),
            ]
            for unit, pairs in (("frames", by_frames), ("m", by_length)):
                length_m, angle_rad = rpe(path, truth, pairs)
                measured.append(("rpe_m", RPE_DELTA, unit, length_m))
                measured.append(("rpe_rad", RPE_DELTA, unit, angle_rad))
            for quantity, delta, unit, errors in measured:
                key = {"robot": robot, "source": source, "quantity": quantity}
                key |= {"delta": delta, "delta_unit": unit, "n": len(errors)}
                rows.append(key | seven_statistics(errors))
    return rows


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


def team_ate_m(paths: Sequence[PlacedPath]) -> Float:
    """Return position errors (N,) in m of all robots after one rigid fit of all paths."""
    estimated, true = [], []  # in the fused frame, and in the world
    for own in paths:
        known = np.isfinite(own.truth).all(axis=1)
        estimated.append(se2.compose(own.T_first_map, own.poses[known]))
        true.append(se2.compose(own.T_world_map, own.truth[known]))
    return ate_m(np.concatenate(estimated), np.concatenate(true))


def team_pair_rows(team: FusedTeam, errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    """Return the rows of the table `team_pairs`: own alignment and relative pose in the team."""
    edges = team_edge_rows(team)
    if edges.empty:
        return edges
    used = (errors["aligner"] == aligner) & (errors["repetition"] == 0)
    of_judged = alignment_criteria.at_last_iteration(errors[used])[[*_PAIR, *_OWN_ALIGNMENT]]
    rows = edges.merge(of_judged, "inner", _PAIR)
    if rows.empty:
        return rows
    index = {robot.name: k for k, robot in enumerate(team.robots)}
    a, b = rows[_PAIR].map(index.get).to_numpy().T
    # errors of T_a_b in the fused maps; NaN for robots in different maps
    T_world_map = np.array([robot.path.T_world_map for robot in team.robots])
    T_true = se2.between(T_world_map[a], T_world_map[b])
    errors_of_team = np.full((2, len(a)), np.nan)
    for T_first_map in _placements(team):
        known = np.stack(motion_errors(se2.between(T_first_map[a], T_first_map[b]), T_true))
        errors_of_team = np.where(np.isfinite(known), known, errors_of_team)
    translation_m, rotation_rad = errors_of_team
    return rows.assign(team_translation_error_m=translation_m, team_rotation_error_rad=rotation_rad)
