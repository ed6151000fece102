"""Fused landmarks against the truth: was fusing worth it, and do the covariances say so?"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.errors import EvaluatedRobot, MetMaps
from experiments.judge.truth import degrees_of_freedom, fit_rmse_m, squared_mahalanobis
from mapfusion import se2
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import FusedMap, MergeParameters, merge
from mapfusion.se2 import Float
from mapfusion.storage import named_columns, point_columns


@dataclass(frozen=True)
class MergeSettings:
    """Whose alignments maps are merged by, and how."""

    aligner: str
    parameters: MergeParameters


@dataclass(frozen=True)
class FusedTeam:
    """Robots' maps at one iteration, and what they were merged into.

    Attributes:
        robots: the first one's frame is the fused map's.
        met: their maps pair by pair, at all iterations.
        iteration: of the merged maps.
        fused: None for a single robot.
    """

    robots: Sequence[EvaluatedRobot]
    met: Sequence[MetMaps]
    iteration: int
    fused: FusedMap | None

    @classmethod
    def of(
        cls, robots: Sequence[EvaluatedRobot], met: Sequence[MetMaps], settings: MergeSettings
    ) -> "FusedTeam":
        """Merge the robots' last maps by their last alignments with the first one's."""
        last = max(max(robot.maps) for robot in robots)
        if len(robots) < 2:
            return cls(robots, met, last, None)
        first, *others = robots
        # a pair's last iteration is at the later of its two robots' last frames
        ends = {each.b.name: each for each in met if each.a is first}
        fused = merge(
            [robot.at(last)[0] for robot in robots],
            [ends[other.name].alignment(settings.aligner) for other in others],
            [ends[other.name].offered for other in others],
            settings.parameters,
        )
        return cls(robots, met, last, fused)

    def truth_of(self, fused: FusedMap) -> Float:
        """True points (N, 3) of fused landmarks: the mean of their parents'; NaN if unknown."""
        points = self.parent_points(fused)
        known = np.all(np.isfinite(points), axis=2)
        total = np.where(known[:, :, None], points, 0.0).sum(axis=1)
        count = np.count_nonzero(known, axis=1, keepdims=True)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def parent_points(self, fused: FusedMap) -> Float:
        """True points (N, M, 3) of each fused landmark's parents; NaN where none or unknown."""
        points = np.full((*fused.parents.shape, 3), np.nan)
        for k, robot in enumerate(self.robots):
            has = fused.parents[:, k] != ABSENT
            points[has, k] = robot.at(self.iteration)[1][fused.parents[has, k]]
        return points

    def judged(self) -> list[tuple[str, LandmarkMap, Float]]:
        """Name, map and true points (N, 3) in the world of each robot's map and the fused one."""
        found = [(robot.name, *robot.at(self.iteration)) for robot in self.robots]
        if self.fused is not None:
            found.append(("fused", self.fused.landmarks, self.truth_of(self.fused)))
        return found


def fusion_rows(
    robots: Sequence[EvaluatedRobot],
    met: Sequence[MetMaps],
    settings: MergeSettings,
    radius_m: float,
) -> pd.DataFrame:
    """Rows of the table `fusion`: landmarks of one pair fused at the last iteration."""
    with_drift, without_drift = (
        _pair_rows(FusedTeam.of(robots, met, replace(settings, parameters=parameters)))
        for parameters in (
            replace(settings.parameters, use_drift=use_drift) for use_drift in (True, False)
        )
    )
    parents = ["landmark_a", "landmark_b"]
    without_drift = without_drift[[*parents, "nees"]]
    rows = with_drift.merge(
        without_drift, how="left", on=parents, suffixes=("_with_drift", "_without_drift")
    )
    return rows.assign(true_pair=rows["apart_m"] <= radius_m)


def _pair_rows(pair: FusedTeam) -> pd.DataFrame:
    """Landmarks with two parents, held against the middle of what both of these show."""
    (a, b), fused = pair.robots, pair.fused
    assert fused is not None
    (map_a, points_a), (map_b, points_b) = a.at(pair.iteration), b.at(pair.iteration)
    both = np.flatnonzero((fused.parents != ABSENT).all(axis=1))
    i, j = fused.parents[both].T
    # points one by one, [:, None]: products of matrices differ in their last bits from these
    truth = a.in_map_frame(((points_a[i] + points_b[j]) / 2)[:, None])[:, 0]
    moved_b = se2.transform_points(fused.T_first_map[1], map_b.position_m[j][:, None])[:, 0]
    error = fused.landmarks.position_m[both] - truth
    used = degrees_of_freedom(fused.landmarks)
    covariance = fused.landmarks.covariance_m2[both, :used, :used]
    return pd.DataFrame(
        {
            "robot_a": a.name,
            "robot_b": b.name,
            "landmark_a": i,
            "landmark_b": j,
            "error_a_m": _lengths(map_a.position_m[i] - truth),
            "error_b_m": _lengths(moved_b - truth),
            "error_fused_m": _lengths(error),
            "nees": squared_mahalanobis(error[:, :used], covariance),
            "degrees_of_freedom": used,
            "apart_m": _lengths(points_a[i] - points_b[j]),
        }
    )


def _lengths(vectors: Float) -> Float:
    return np.sqrt(np.vecdot(vectors, vectors))


def landmark_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `landmarks`."""
    parts = []
    for robot in team.robots:
        landmarks, points = robot.at(team.iteration)
        rows = _landmark_columns(landmarks, robot.in_map_frame(points))
        parts.append(rows.assign(robot=robot.name, count=landmarks.count))
    return pd.concat(parts, ignore_index=True)


def _landmark_columns(landmarks: LandmarkMap, truth: Float) -> pd.DataFrame:
    columns = point_columns(landmarks.position_m, landmarks.covariance_m2)
    columns |= named_columns(("truth_x_m", "truth_y_m", "truth_z_m"), truth)
    return pd.DataFrame({"landmark": np.arange(len(landmarks)), **columns})


def fused_rows(team: FusedTeam) -> pd.DataFrame:
    """Rows of the table `fused`; none for a single robot."""
    fused, first_robot = team.fused, team.robots[0]
    if fused is None:
        return pd.DataFrame()
    rows = _landmark_columns(fused.landmarks, first_robot.in_map_frame(team.truth_of(fused)))
    has = fused.parents != ABSENT
    names = np.array([robot.name for robot in team.robots], dtype=object)
    first = np.argmax(has, axis=1)
    later = has & (np.arange(len(names)) > first[:, None])
    second, several = np.argmax(later, axis=1), later.any(axis=1)
    each = np.arange(len(rows))
    return rows.assign(
        n_parents=has.sum(axis=1),
        robot_a=names[first],
        landmark_a=fused.parents[each, first],
        robot_b=np.where(several, names[second], ""),
        landmark_b=np.where(several, fused.parents[each, second], ABSENT),
    )


def fused_motion_rows(team: FusedTeam, use_drift: bool) -> list[dict[str, Any]]:
    """Rows of the table `fused_motions`: how each robot's map was moved into the fused one."""
    if team.fused is None:
        return []
    why = dict(team.fused.left_out)
    drift_sigma_m = team.fused.drift_sigma_m if use_drift else np.zeros(len(team.robots))
    return [
        {
            "robot": robot.name,
            **dict(zip(("tx_m", "ty_m", "theta_rad"), motion, strict=True)),
            "drift_sigma_m": sigma_m,
            "left_out": why.get(robot.name, ""),
        }
        for robot, motion, sigma_m in zip(
            team.robots, team.fused.T_first_map, drift_sigma_m, strict=True
        )
    ]


def map_fit_rows(team: FusedTeam) -> list[dict[str, Any]]:
    """Rows of the table `map_fits`: each robot's map, and the fused one, against the truth."""
    rows = []
    for name, landmarks, points in team.judged():
        n, rmse_m = fit_rmse_m(landmarks.position_m, points)
        rows.append({"map": name, "n_landmarks": n, "rmse_m": rmse_m})
    return rows
