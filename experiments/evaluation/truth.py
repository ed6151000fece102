"""True poses and points for estimated paths and landmarks; only the evaluation uses this module."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy

from experiments.pipeline.stages.align import alignment_of, correspondences_of
from experiments.pipeline.stages.smooth import (
    ROBOTS_KEPT,
    RobotFolders,
    latest_at,
    read_smoothed_path,
    smoothed_maps,
    smoothed_owners,
    stored_maps,
)
from experiments.pipeline.tables import records
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.errors import InputError
from mapfusion.fusion.fusers import AlignedPair
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import (
    TRUTH_TABLES,
    RobotLog,
    RobotTruth,
    read_log,
    read_true_points,
    read_true_poses,
)
from mapfusion.tables import table_path

_SAME = 0.95  # probability that true points placed by poses are found to be one point
_MAP_PAIR = ["robot_a", "robot_b", "iteration"]


def truth_or_unknown(folder: Path, log: RobotLog) -> RobotTruth:
    """Return the truth in the folder of a log; NaN where it is unknown.

    If only poses are known, the true poses place the observations in the world. The median of a
    landmark's placed observations identifies the landmark. It is no independent measurement of
    the landmark, so errors of landmarks are not judged by it (see `EvaluatedRobot.surveyed`).

    Raises:
        InputError: a table is damaged, or its number of rows differs from that of the log.
    """
    poses, points = read_true_poses(folder), read_true_points(folder)
    for name, true, logged in zip(
        TRUTH_TABLES, (poses, points), (log, log.observations), strict=True
    ):
        if true is not None and len(true) != len(logged):
            counts = f"{len(true)} rows, the log has {len(logged)} of them"
            raise InputError(f"{table_path(folder, name)}: {counts}")
    if points is None and poses is not None:
        T_world_robot, points = poses[log.iteration], log.observations.position_m.copy()
        R = se2.rotation(T_world_robot[:, 2])
        points[:, :2] = np.einsum("nij,nj->ni", R, points[:, :2]) + T_world_robot[:, :2]
        points[np.isnan(points).any(axis=1)] = np.nan
    unknown = (np.full((n, 3), np.nan) for n in (len(log), len(log.observations)))
    true_poses, true_points = (
        nothing if true is None else true
        for true, nothing in zip((poses, points), unknown, strict=True)
    )
    return RobotTruth(true_poses, true_points)


def is_surveyed(folder: Path) -> bool:
    """Return True unless the true points of a log are placed by its true poses."""
    poses, points = (table_path(folder, name).is_file() for name in TRUTH_TABLES)
    return points or not poses


def landmark_truth(
    truth: RobotTruth, owners_at: Callable[[int, int], np.ndarray], maps: Mapping[int, LandmarkMap]
) -> dict[int, Float]:
    """Return the true points of the landmarks of each map, by iteration.

    The true point of a landmark is the median of the true points of its observations.

    Args:
        truth: truth of the robot.
        owners_at: takes an iteration and the number n of observations of the log. Returns, shape
            (n,), the `source_observation` of the landmark that each observation was assigned to at
            that iteration; -1 for none.
        maps: maps by iteration.

    Returns:
        World points, shape (N, 3), by iteration; NaN where unknown.
    """
    point_m, has_point = truth.point_world_m, np.isfinite(truth.point_world_m).all(axis=1)
    n = len(point_m)
    # Arrays over `source_observation`; the last row belongs to -1. Few landmarks gain or lose an
    # observation between two maps, so only the medians of these are computed again.
    median_m, points = np.full((n + 1, 3), np.nan), {}
    before = np.full(n, -1)
    for iteration, landmarks in maps.items():
        owner = owners_at(iteration, n)
        changed, outdated = np.flatnonzero(owner != before), np.zeros(n + 1, dtype=bool)
        outdated[before[changed]] = outdated[owner[changed]] = True
        outdated[-1] = False
        median_m[outdated] = np.nan
        used = np.flatnonzero(outdated[owner] & has_point)
        # Medians by landmark: sort by landmark, then by value, and take the middle of each group.
        found, group, counts = np.unique(owner[used], return_inverse=True, return_counts=True)
        if len(found) <= 1 + np.iinfo(np.uint16).max:
            group = group.astype(np.uint16)  # NumPy sorts these by radix sort, which is faster
        first = np.cumsum(counts) - counts
        lower, upper = first + (counts - 1) // 2, first + counts // 2
        for k, column in enumerate(point_m[used].T):
            by_value = np.argsort(column)
            ranked = column[by_value[np.argsort(group[by_value], kind="stable")]]
            median_m[found, k] = (ranked[lower] + ranked[upper]) / 2
        points[iteration] = median_m[landmarks.source_observation]
        before = owner
    return points


def true_pairs(
    points_a: Float, points_b: Float, index_a: np.ndarray, index_b: np.ndarray, radius_m: float
) -> np.ndarray:
    """Return, shape (N,), True for pairs of landmarks whose true points lie within the radius.

    Pairs with an unknown point are False.
    """
    distance = np.linalg.norm(points_a[index_a] - points_b[index_b], axis=1)
    return distance <= radius_m  # False for NaN


def common_landmarks(points_a: Float, points_b: Float, radius_m: float) -> int:
    """Return the number of common landmarks: mutual nearest true points within the radius."""
    known_a, known_b = (own[np.isfinite(own).all(axis=1)] for own in (points_a, points_b))
    if not len(known_a) or not len(known_b):
        return 0
    distance, nearest_b = scipy.spatial.KDTree(known_b).query(known_a)
    _, nearest_a = scipy.spatial.KDTree(known_a).query(known_b)
    mutual = np.asarray(nearest_a)[nearest_b] == np.arange(len(known_a))
    return int(np.sum(mutual & (distance <= radius_m)))


@dataclass(frozen=True)
class PathTruth:
    """True path of a robot.

    Attributes:
        T_map_robot: true poses, shape (T, 3), in the frame of the robot's map.
        T_world_map: origin of this frame, shape (3,): the first known pose of the robot.
        fitted: True if the origin is that of the last map fitted to the true points, for robots
            whose poses are unknown. Errors against it exclude the error of this fit.
    """

    T_map_robot: Float
    T_world_map: Float
    fitted: bool = False

    @classmethod
    def of(cls, truth: RobotTruth) -> "PathTruth":
        """Return the path from the first known pose; robots stand still until then."""
        known = np.isfinite(truth.T_world_robot).all(axis=1)
        start = truth.T_world_robot[int(np.argmax(known))]
        return cls(se2.between(start, truth.T_world_robot), start)

    def or_fitted(
        self, maps: Mapping[int, LandmarkMap], points_world_m: Mapping[int, Float]
    ) -> "PathTruth":
        """Return the path with the origin of the last map if the poses are unknown."""
        if np.isfinite(self.T_world_map).all() or not maps:
            return self
        last = max(maps)
        T_world_map, _, _ = _fit_to_points(maps[last].position_m, points_world_m[last])
        return PathTruth(self.T_map_robot, T_world_map, fitted=True)


def fit_rmse_m(position_m: Float, point_world_m: Float) -> tuple[int, float]:
    """Return the number of landmarks with a known true point, and their RMSE after a rigid fit."""
    _, n, rmse_m = _fit_to_points(position_m, point_world_m)
    return n, rmse_m


def _fit_to_points(position_m: Float, point_world_m: Float) -> tuple[Float, int, float]:
    """Return the rigid motion (3,) of landmarks to known true points, their number and the RMSE."""
    known = np.isfinite(point_world_m).all(axis=1)
    points, target = position_m[known], point_world_m[known]
    if len(points) < 2:
        return np.full(3, np.nan), len(points), np.nan
    T_world_map = np.array(fit_rigid(target, points, np.arange(len(points))))
    residual = se2.transform_points(T_world_map, points) - target
    return T_world_map, len(points), float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def motion_errors(T: Float, T_true: Float) -> tuple[Float, Float]:
    """Return translation errors in m and signed rotation errors in rad of motions (..., 3)."""
    error = T - T_true
    return np.hypot(error[..., 0], error[..., 1]), se2.wrap(error[..., 2])


@dataclass(frozen=True)
class EvaluatedRobot:
    """Maps of one robot with the truth.

    Attributes:
        name: name of the robot.
        maps: maps by iteration.
        points_world_m: true points of the landmarks of each map, shape (N, 3).
        path: true path.
        surveyed: False if true poses placed the true points: they identify landmarks, and errors
            of landmarks are unknown.
    """

    name: str
    maps: Mapping[int, LandmarkMap]
    points_world_m: dict[int, Float]
    path: PathTruth
    surveyed: bool = True

    def at(self, iteration: int) -> tuple[LandmarkMap, Float]:
        """Return map and true points at an iteration; the last ones if the log ended earlier."""
        return latest_at(self.maps, iteration), latest_at(self.points_world_m, iteration)

    def in_map_frame(self, points_world_m: Float) -> Float:
        """Transform world points (..., 3) into the frame of this robot's maps."""
        return se2.transform_points(se2.inverse(self.path.T_world_map), points_world_m)


@dataclass(frozen=True)
class MapPair:
    """Maps of two robots at one iteration, with correspondences and estimates.

    Attributes:
        a: first robot.
        b: second robot.
        iteration: iteration of the maps.
        maps: maps of a and b.
        points_world_m: true points of their landmarks, shapes (N, 3) and (M, 3).
        offered: correspondences that all aligners were given.
        estimates: rows of the table `estimates`.
        rivals: rows of the table `rivals`: other motions that align the maps as well.
    """

    a: EvaluatedRobot
    b: EvaluatedRobot
    iteration: int
    maps: tuple[LandmarkMap, LandmarkMap]
    points_world_m: tuple[Float, Float]
    offered: Correspondences
    estimates: Sequence[Mapping[str, Any]]
    rivals: pd.DataFrame

    @property
    def keys(self) -> dict[str, Any]:
        """Values of the columns that identify this pair of maps."""
        return dict(zip(_MAP_PAIR, (self.a.name, self.b.name, self.iteration), strict=True))

    def same_within_m(self, radius_m: float) -> float:
        """Return the distance below which true points of the two robots are one point.

        It is `radius_m`, or more if true points are placed by true poses: such a point is as
        uncertain as the landmark, and two of them lie within this distance with probability 0.95.
        """
        if self.a.surveyed and self.b.surveyed:
            return radius_m
        variance_m2 = 0.0
        for landmarks in self.maps:
            by_axis = np.trace(landmarks.covariance_m2, axis1=1, axis2=2) / 3
            variance_m2 += float(np.median(by_axis)) if len(by_axis) else 0.0
        return max(radius_m, math.sqrt(chi_square_bound(_SAME, 3) * variance_m2))

    def is_true(self, radius_m: float) -> np.ndarray:
        """Return, shape (N,), True for correspondences of the same world point."""
        pairs, within_m = self.offered, self.same_within_m(radius_m)
        return true_pairs(*self.points_world_m, pairs.index_a, pairs.index_b, within_m)

    def n_common(self, radius_m: float) -> int:
        """Return the number of landmarks of both maps that are the same world point."""
        return common_landmarks(*self.points_world_m, self.same_within_m(radius_m))

    def aligned(self, aligner: str, a: int, b: int) -> AlignedPair:
        """Return the alignment that a merge uses: the first repetition of an aligner.

        Args:
            aligner: name of the aligner.
            a: index of the first map among the maps that are merged.
            b: index of the second map.
        """
        rows = (row for row in self.estimates if row["aligner"] == aligner)
        row = next(row for row in rows if row["repetition"] == 0)
        alignment = alignment_of(row, len(self.offered))
        return AlignedPair(a, b, alignment, self.offered, row["log10_false_alarms"])


def join_map_pairs(
    robots: Sequence[EvaluatedRobot],
    estimates: pd.DataFrame,
    correspondences: pd.DataFrame,
    rivals: pd.DataFrame,
) -> list[MapPair]:
    """Return all pairs of maps of the tables `estimates`, `correspondences` and `rivals`.

    The order is that of `estimates`.
    """
    by_name = {robot.name: robot for robot in robots}
    offered, rival = (dict(iter(rows.groupby(_MAP_PAIR))) for rows in (correspondences, rivals))
    estimated: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for row in records(estimates):  # much faster than `groupby` for many small groups
        estimated.setdefault((row["robot_a"], row["robot_b"], row["iteration"]), []).append(row)
    map_pairs = []
    for key, rows in estimated.items():
        name_a, name_b, iteration = key
        a, b = by_name[name_a], by_name[name_b]
        (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
        pairs = correspondences_of(offered.get(key, correspondences.iloc[:0]))
        maps, points = (map_a, map_b), (points_a, points_b)
        others = rival.get(key, rivals.iloc[:0])
        map_pairs.append(MapPair(a, b, iteration, maps, points, pairs, rows, others))
    return map_pairs


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def load_robot(folders: RobotFolders, viewing: bool = True) -> EvaluatedRobot:
    """Load a robot's maps with the true points of their landmarks; NaN where unknown.

    The result stays in memory, as that of `stored_maps`.

    Args:
        folders: folders of the log and of the maps.
        viewing: whether to load the viewing evidence of the maps.

    Raises:
        InputError: the truth and the log differ in their number of rows.
    """
    log = read_log(folders.log)
    truth = truth_or_unknown(folders.log, log)
    maps = stored_maps(folders, viewing=viewing)
    points = landmark_truth(truth, maps.associations.at, maps)
    path = PathTruth.of(truth).or_fitted(maps, points)
    return EvaluatedRobot(log.robot, maps, points, path, is_surveyed(folders.log))


@functools.lru_cache(maxsize=ROBOTS_KEPT)
def load_robot_smoothed(folders: RobotFolders) -> EvaluatedRobot:
    """Load a robot's smoothed maps as `load_robot` does; see `smoothed_maps`."""
    robot, maps = load_robot(folders), smoothed_maps(folders, viewing=True)
    assert folders.smooth is not None
    smooth, smoothed = folders.smooth, {*read_smoothed_path(folders.smooth)}
    associations = stored_maps(folders, viewing=True).associations

    def owners_at(iteration: int, n: int) -> np.ndarray:
        if iteration in smoothed:
            return smoothed_owners(smooth, folders.slam, iteration, n)
        return associations.at(iteration, n)

    truth = truth_or_unknown(folders.log, read_log(folders.log))
    points = landmark_truth(truth, owners_at, maps)
    path = PathTruth.of(truth).or_fitted(maps, points)
    return replace(robot, maps=maps, points_world_m=points, path=path)
