"""Truth joined to estimates; only the evaluation imports this module."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from experiments.scenario.settings import AnyScenario, Recording
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import TRUTH_TABLES, RobotTruth
from mapfusion.tables import table_path


def landmark_truth(
    truth: RobotTruth, owners_at: Callable[[int, int], np.ndarray], maps: Mapping[int, LandmarkMap]
) -> dict[int, Float]:
    """The true world point (N, 3) of each landmark of each evaluated map; NaN where unknown.

    It is the median of the true points of all observations that went into the landmark.

    Args:
        truth: of the robot.
        owners_at: by iteration and number of observations, (n,) the `source_observation` of the
            landmark that each of the log's first observations went into then; -1 for none.
        maps: by iteration.
    """
    point_m, has_point = truth.point_world_m, np.isfinite(truth.point_world_m).all(axis=1)
    n = len(point_m)
    # Both by `source_observation`, their last row, which is that of -1, of none. From one map to
    # the next few landmarks gain or lose an observation: the medians of all others stay.
    median_m, points = np.full((n + 1, 3), np.nan), {}
    before = np.full(n, -1)
    for iteration, landmarks in maps.items():
        owner = owners_at(iteration, n)
        changed, anew = np.flatnonzero(owner != before), np.zeros(n + 1, dtype=bool)
        anew[before[changed]] = anew[owner[changed]] = True
        anew[-1] = False
        median_m[anew] = np.nan
        counts = np.flatnonzero(anew[owner] & has_point)
        found, found_m = _medians(owner[counts], point_m[counts])
        median_m[found] = found_m
        points[iteration] = median_m[landmarks.source_observation]
        before = owner
    return points


def _medians(group: np.ndarray, values: Float) -> tuple[np.ndarray, Float]:
    """The groups there are (G,), sorted, and by column the median (G, D) of each one's values.

    Args:
        group: (N,) of each row.
        values: (N, D), finite.
    """
    found, place, counts = np.unique(group, return_inverse=True, return_counts=True)
    if len(found) <= 1 + np.iinfo(np.uint16).max:
        place = place.astype(np.uint16)  # such numbers NumPy sorts digit by digit, far sooner
    first = np.cumsum(counts) - counts
    lower, upper = first + (counts - 1) // 2, first + counts // 2
    medians = np.empty((len(found), values.shape[1]))
    for k, column in enumerate(values.T):
        by_value = np.argsort(column)
        ranked = column[by_value[np.argsort(place[by_value], kind="stable")]]
        medians[:, k] = (ranked[lower] + ranked[upper]) / 2
    return found, medians


def true_pairs(
    points_a: Float, points_b: Float, index_a: np.ndarray, index_b: np.ndarray, radius_m: float
) -> np.ndarray:
    """(N,) bool: index pairs whose true points lie within the radius; unknown points never do."""
    distance = np.linalg.norm(points_a[index_a] - points_b[index_b], axis=1)
    return distance <= radius_m  # False for NaN


def common_landmarks(points_a: Float, points_b: Float, radius_m: float) -> int:
    """How many landmarks of two maps truly correspond: mutual nearest true points within radius."""
    known_a, known_b = (own[np.isfinite(own).all(axis=1)] for own in (points_a, points_b))
    if not len(known_a) or not len(known_b):
        return 0
    distance, nearest_b = KDTree(known_b).query(known_a)
    _, nearest_a = KDTree(known_a).query(known_b)
    mutual = np.asarray(nearest_a)[nearest_b] == np.arange(len(known_a))
    return int(np.sum(mutual & (distance <= radius_m)))


@dataclass(frozen=True)
class PathTruth:
    """True poses (T, 3) of a robot in its own map frame, which is its pose at the first frame."""

    T_map_robot: Float
    T_world_map: Float

    @classmethod
    def of(cls, truth: RobotTruth) -> "PathTruth":
        """The start is the first known pose: robots stand still until their truth begins."""
        known = np.isfinite(truth.T_world_robot).all(axis=1)
        start = truth.T_world_robot[int(np.argmax(known))]
        return cls(se2.between(start, truth.T_world_robot), start)


def fit_rmse_m(position_m: Float, point_world_m: Float) -> tuple[int, float]:
    """How many landmarks have a known truth, and their RMSE after the best rigid fit to it."""
    known = np.isfinite(point_world_m).all(axis=1)
    points, target = position_m[known], point_world_m[known]
    if len(points) < 2:
        return len(points), np.nan
    T_world_map = np.array(fit_rigid(target, points, np.arange(len(points))))
    residual = se2.transform_points(T_world_map, points) - target
    return len(points), float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def degrees_of_freedom(landmarks: LandmarkMap) -> int:
    """Coordinates that a landmark was estimated in."""
    return 2 if landmarks.planar else 3


def squared_mahalanobis(error: Float, covariance: Float) -> Float:
    """Of errors (..., D) by their covariances (..., D, D)."""
    return np.vecdot(error, np.linalg.solve(covariance, error[..., None])[..., 0])


def why_no_truth(scenario: AnyScenario) -> str:
    """Which log of a scenario has no truth beside it; empty where all have.

    Errors are told of all robots or of none: a map is judged against another's, too.
    """
    logs = map(Path, scenario.logs) if isinstance(scenario, Recording) else ()
    for log in logs:
        lacking = [name for name in TRUTH_TABLES if not table_path(log, name).is_file()]
        if lacking and log.is_dir():
            return f"no truth is known: {log} has no {lacking[0]}.parquet or .csv"
    return ""
