"""Estimates joined with the truth: the rows of the tables `errors`, `robots` and `paths`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE
from experiments.judge.truth import PathTruth, common_landmarks, true_pairs
from experiments.run.estimates import alignment_of, correspondences_of, estimate_row
from experiments.run.stages.match import map_at
from mapfusion import se2
from mapfusion.align.acceptance import Acceptance
from mapfusion.align.oracle import Oracle
from mapfusion.align.pairs import Pairs
from mapfusion.align.refine import Refinement
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

POSE_FIELDS = ("x_m", "y_m", "theta_rad")


@dataclass(frozen=True)
class EvaluatedRobot:
    """What is known of one robot when its maps are judged.

    Attributes:
        name: of the robot.
        maps: by iteration.
        points_world_m: true point (N, 3) of each landmark of each map, by iteration.
        path: true poses.
    """

    name: str
    maps: dict[int, LandmarkMap]
    points_world_m: dict[int, Float]
    path: PathTruth

    def at(self, iteration: int) -> tuple[LandmarkMap, Float]:
        """Map and true points at an iteration (the last ones of a log that ended earlier)."""
        landmarks = map_at(self.maps, iteration)
        known = max((k for k in self.maps if k <= iteration), default=min(self.maps))
        return landmarks, self.points_world_m[known]


@dataclass(frozen=True)
class _MapsOfPair:
    """What is true of the maps of one pair at one iteration, for all aligners alike."""

    T_true: Float
    T_oracle: Float
    is_true: np.ndarray
    n_common: int

    def row(self, estimate: Mapping[Any, Any]) -> dict[str, Any]:
        """One estimate, judged."""
        estimated = np.array([estimate["tx_m"], estimate["ty_m"], estimate["theta_rad"]])
        alignment = alignment_of(estimate, len(self.is_true))
        refined, inlier = alignment.T_a_b, alignment.inlier
        n_hits, n_true = int(np.sum(inlier & self.is_true)), int(self.is_true.sum())
        return {
            "aligner": estimate["aligner"],
            "repetition": estimate["repetition"],
            "status": estimate["status"],
            "reason": estimate["reason"],
            "translation_error_m": np.hypot(*(estimated - self.T_true)[:2]),
            "rotation_error_rad": float(se2.wrap(estimated[2] - self.T_true[2])),
            "refined_status": estimate["refined_status"],
            "refined_translation_error_m": np.hypot(*(refined - self.T_true)[:2]),
            "refined_rotation_error_rad": float(se2.wrap(refined[2] - self.T_true[2])),
            "accepted": estimate["accepted"],
            "log10_false_alarms": estimate["log10_false_alarms"],
            "oracle_distance_m": np.hypot(*(refined - self.T_oracle)[:2]),
            "oracle_distance_rad": float(abs(se2.wrap(refined[2] - self.T_oracle[2]))),
            "n_correspondences": len(self.is_true),
            "n_true": n_true,
            "n_common": self.n_common,
            "n_inliers": int(inlier.sum()),
            "precision": n_hits / inlier.sum() if inlier.any() else np.nan,
            "recall": n_hits / n_true if n_true else np.nan,
            "alignment_nees": alignment_nees(refined, alignment.covariance, self.T_true),
        }


def alignment_nees(T_estimate: Float, covariance: Float, T_true: Float) -> float:
    """Squared Mahalanobis distance of an alignment (3,) to the truth; 3 degrees of freedom."""
    error = T_estimate - T_true
    error[2] = se2.wrap(error[2])
    if not np.isfinite(covariance).all() or not np.isfinite(error).all():
        return np.nan
    return float(error @ np.linalg.solve(covariance, error))


def error_rows(
    a: EvaluatedRobot,
    b: EvaluatedRobot,
    estimates: pd.DataFrame,
    correspondences: pd.DataFrame,
    refinement: Refinement,
    acceptance: Acceptance,
    radius_m: float,
) -> list[dict[str, Any]]:
    """Rows of the table `errors` for one robot pair, the oracle's among them."""
    T_true = se2.between(a.path.T_world_map, b.path.T_world_map)
    rows = []
    for iteration in np.unique(estimates["iteration"].to_numpy()).tolist():
        group = estimates[estimates["iteration"] == iteration]
        map_a, points_a = a.at(iteration)
        map_b, points_b = b.at(iteration)
        pairs = correspondences_of(correspondences[correspondences["iteration"] == iteration])
        is_true = true_pairs(points_a, points_b, pairs.index_a, pairs.index_b, radius_m)
        side_by_side = Pairs(map_a, map_b, pairs)
        oracle = Oracle(refinement).align(side_by_side, is_true)
        of_pair = _MapsOfPair(
            T_true, oracle.T_a_b, is_true, common_landmarks(points_a, points_b, radius_m)
        )
        verdict = acceptance.judge(side_by_side, oracle)
        oracle_row = {"aligner": ORACLE, "repetition": 0}
        oracle_row |= estimate_row(len(pairs), oracle, oracle, verdict)
        names = {"robot_a": a.name, "robot_b": b.name, "iteration": iteration}
        for estimate in [oracle_row, *group.to_dict("records")]:
            rows.append(names | of_pair.row(estimate))
    return rows


def path_columns(poses: pd.DataFrame, odometry: Float, path: PathTruth) -> pd.DataFrame:
    """Rows of the table `paths` of one robot: final, online, odometry and true poses."""
    dead_reckoned = np.zeros((len(odometry), 3))
    for i in range(1, len(odometry)):
        dead_reckoned[i] = se2.compose(dead_reckoned[i - 1], odometry[i])
    frame = poses[["iteration"]].copy()
    for source in ("final", "online"):
        for name in POSE_FIELDS:
            frame[f"{source}_{name}"] = poses[f"{source}_{name}"]
    for source, values in (("odometry", dead_reckoned), ("truth", path.T_map_robot)):
        for i, name in enumerate(POSE_FIELDS):
            frame[f"{source}_{name}"] = values[: len(frame), i]
    return frame


def robot_rows(poses: pd.DataFrame, paths: pd.DataFrame) -> pd.DataFrame:
    """Rows of the table `robots` of one robot, from its poses and the joined paths."""
    rows = poses[
        ["iteration", "effective_sample_size", "resampled", "n_landmarks", "spread_m"]
    ].copy()
    for source, target in (("online", "path"), ("odometry", "odometry")):
        dx = paths[f"{source}_x_m"] - paths["truth_x_m"]
        dy = paths[f"{source}_y_m"] - paths["truth_y_m"]
        turn = paths[f"{source}_theta_rad"] - paths["truth_theta_rad"]
        rows[f"{target}_error_m"] = np.hypot(dx, dy)
        rows[f"{target}_error_rad"] = se2.wrap(turn)
    return rows
