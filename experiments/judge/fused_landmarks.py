"""Fused landmarks against the truth: was fusing worth it, and do the covariances say so?"""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.errors import EvaluatedRobot
from experiments.judge.truth import fit_rmse_m
from experiments.run.estimates import alignment_of, correspondences_of
from mapfusion import se2
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.result import Alignment, degenerate
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import FusedMap, MergeParameters, merge
from mapfusion.se2 import Float


def fused_maps(
    maps: list[LandmarkMap],
    estimates: pd.DataFrame,
    correspondences: pd.DataFrame,
    aligner: str,
    parameters: MergeParameters,
) -> FusedMap:
    """Fuse maps in the frame of the first by an aligner's first repetition.

    Args:
        maps: of the robots, the first's first.
        estimates: rows of the table `estimates` at one iteration, of any pairs.
        correspondences: the pairs offered there.
        aligner: whose refined estimates to merge by.
        parameters: how to merge.
    """
    chosen = first_repetition(estimates, aligner)
    alignments: list[Alignment] = []
    offered: list[Correspondences] = []
    for other in maps[1:]:
        names = {"robot_a": maps[0].name, "robot_b": other.name}
        rows = _of_pair(chosen, names)
        pairs = correspondences_of(_of_pair(correspondences, names))
        offered.append(pairs)
        if len(rows):
            alignments.append(alignment_of(rows.iloc[0].to_dict(), len(pairs)))
        else:
            alignments.append(degenerate("was never aligned", len(pairs)))
    return merge(maps, alignments, offered, parameters)


def first_repetition(estimates: pd.DataFrame, aligner: str) -> pd.DataFrame:
    """What maps are merged by: repetitions are for the spread of a method, not for the map."""
    return estimates[(estimates["aligner"] == aligner) & (estimates["repetition"] == 0)]


def _of_pair(rows: pd.DataFrame, names: dict[str, str]) -> pd.DataFrame:
    keep = (rows["robot_a"] == names["robot_a"]) & (rows["robot_b"] == names["robot_b"])
    return rows[keep]


def fusion_rows(
    a: EvaluatedRobot,
    b: EvaluatedRobot,
    estimates: pd.DataFrame,
    correspondences: pd.DataFrame,
    aligner: str,
    parameters: MergeParameters,
    radius_m: float,
) -> list[dict[str, Any]]:
    """Rows of the table `fusion`: landmarks of one pair fused at the last iteration."""
    last = int(estimates["iteration"].max())
    estimates = estimates[estimates["iteration"] == last]
    correspondences = correspondences[correspondences["iteration"] == last]
    (map_a, points_a), (map_b, points_b) = a.at(last), b.at(last)
    with_drift, without_drift = (
        fused_maps(
            [map_a, map_b],
            estimates,
            correspondences,
            aligner,
            replace(parameters, use_drift=use_drift),
        )
        for use_drift in (True, False)
    )
    nees_without = {
        (int(i), int(j)): value for i, j, value, _ in _judged(without_drift, a, points_a, points_b)
    }
    T_a_b = with_drift.T_first_map[1]
    dof = 2 if map_a.planar else 3
    rows = []
    for i, j, nees, error_m in _judged(with_drift, a, points_a, points_b):
        truth = _truth_in_a(a, points_a[i], points_b[j])
        moved_b = se2.transform_points(T_a_b, map_b.position_m[j][None])[0]
        rows.append(
            {
                "robot_a": a.name,
                "robot_b": b.name,
                "landmark_a": i,
                "landmark_b": j,
                "error_a_m": np.linalg.norm(map_a.position_m[i] - truth),
                "error_b_m": np.linalg.norm(moved_b - truth),
                "error_fused_m": error_m,
                "nees_with_drift": nees,
                "nees_without_drift": nees_without.get((i, j), np.nan),
                "degrees_of_freedom": dof,
                "true_pair": bool(np.linalg.norm(points_a[i] - points_b[j]) <= radius_m),
            }
        )
    return rows


def _truth_in_a(a: EvaluatedRobot, point_a: Float, point_b: Float) -> Float:
    """The true point (3,) in robot a's map frame: the middle of what both landmarks show."""
    middle = ((point_a + point_b) / 2)[None]
    return se2.transform_points(se2.inverse(a.path.T_world_map), middle)[0]


def _judged(
    fused: FusedMap, a: EvaluatedRobot, points_a: Float, points_b: Float
) -> list[tuple[int, int, float, float]]:
    """(row of a, row of b, NEES, error in m) of each landmark with two parents."""
    both = np.flatnonzero((fused.parents != ABSENT).all(axis=1))
    judged = []
    for row in both:
        i, j = (int(parent) for parent in fused.parents[row])
        error = fused.landmarks.position_m[row] - _truth_in_a(a, points_a[i], points_b[j])
        used = 2 if fused.landmarks.planar else 3
        covariance = fused.landmarks.covariance_m2[row, :used, :used]
        nees = float(error[:used] @ np.linalg.solve(covariance, error[:used]))
        judged.append((i, j, nees, float(np.linalg.norm(error))))
    return judged


def parent_points(fused: FusedMap, robots: list[EvaluatedRobot], iteration: int) -> Float:
    """True world points (N, M, 3) of each fused landmark's parents; NaN where none or unknown."""
    points = np.full((*fused.parents.shape, 3), np.nan)
    for k, robot in enumerate(robots):
        has = fused.parents[:, k] != ABSENT
        points[has, k] = robot.at(iteration)[1][fused.parents[has, k]]
    return points


def fused_truth(fused: FusedMap, robots: list[EvaluatedRobot], iteration: int) -> Float:
    """True world points (N, 3) of fused landmarks: the mean of their parents'; NaN if unknown."""
    points = parent_points(fused, robots, iteration)
    known = np.all(np.isfinite(points), axis=2)
    total = np.where(known[:, :, None], points, 0.0).sum(axis=1)
    count = np.count_nonzero(known, axis=1, keepdims=True)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def fused_motion_rows(
    robots: list[EvaluatedRobot], fused: FusedMap | None, parameters: MergeParameters
) -> list[dict[str, Any]]:
    """Rows of the table `fused_motions`: how each robot's map was moved into the fused one."""
    if fused is None:
        return []
    why = dict(fused.left_out)
    return [
        {
            "robot": robot.name,
            **dict(zip(("tx_m", "ty_m", "theta_rad"), fused.T_first_map[place], strict=True)),
            "drift_sigma_m": fused.drift_sigma_m[place] if parameters.use_drift else 0.0,
            "left_out": why.get(robot.name, ""),
        }
        for place, robot in enumerate(robots)
    ]


def map_fit_rows(
    robots: list[EvaluatedRobot], fused: FusedMap | None, iteration: int
) -> list[dict[str, Any]]:
    """Rows of the table `map_fits`: each robot's map, and the fused one, against the truth."""
    rows = []
    for robot in robots:
        landmarks, points = robot.at(iteration)
        n, rmse_m = fit_rmse_m(landmarks.position_m, points)
        rows.append({"map": robot.name, "n_landmarks": n, "rmse_m": rmse_m})
    if fused is not None:
        truth = fused_truth(fused, robots, iteration)
        n, rmse_m = fit_rmse_m(fused.landmarks.position_m, truth)
        rows.append({"map": "fused", "n_landmarks": n, "rmse_m": rmse_m})
    return rows
