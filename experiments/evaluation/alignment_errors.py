"""Errors of alignments: the table `errors`."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.criteria import COMMON_LANDMARKS, ORACLE
from experiments.evaluation.truth import (
    PathTruth,
    common_landmarks,
    squared_mahalanobis,
    true_pairs,
)
from experiments.pipeline.stages.match import latest_at
from experiments.pipeline.tables import (
    MOTION,
    alignment_of,
    correspondences_of,
    estimate_row,
    evidence_of,
    records,
)
from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.refinement import Oracle
from mapfusion.fusion.fusers import AlignedPair
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.verdict import Verifier

_MAP_PAIR = ["robot_a", "robot_b", "iteration"]


@dataclass(frozen=True)
class EvaluatedRobot:
    """Maps of one robot with the truth.

    Attributes:
        name: name of the robot.
        maps: maps by iteration.
        points_world_m: true points of the landmarks of each map, shape (N, 3).
        path: true path.
    """

    name: str
    maps: Mapping[int, LandmarkMap]
    points_world_m: dict[int, Float]
    path: PathTruth

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

    def is_true(self, radius_m: float) -> np.ndarray:
        """Return, shape (N,), True for correspondences of the same world point."""
        pairs = self.offered
        return true_pairs(*self.points_world_m, pairs.index_a, pairs.index_b, radius_m)

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


def alignment_nees(T_estimate: Float, covariance: Float, T_true: Float) -> Float:
    """Return the NEES (...) of alignments; chi-square with 3 degrees of freedom if consistent.

    Args:
        T_estimate: estimated motions, shape (..., 3).
        covariance: covariances of the estimates, shape (..., 3, 3). NaN gives NaN.
        T_true: true motion, shape (3,).
    """
    error = T_estimate - T_true
    error[..., 2] = se2.wrap(error[..., 2])
    known = np.isfinite(covariance).all(axis=(-2, -1)) & np.isfinite(error).all(axis=-1)
    nees = np.full(known.shape, np.nan)
    nees[known] = squared_mahalanobis(error[known], covariance[known])
    return nees


def error_rows(map_pair: MapPair, judge: Verifier, radius_m: float) -> pd.DataFrame:
    """Return the rows of the table `errors` of one pair of maps; the first is the oracle's.

    The oracle is the aligner that is given the true correspondences.
    """
    is_true, pairs = map_pair.is_true(radius_m), Pairs(*map_pair.maps, map_pair.offered)
    oracle = Oracle(judge.refinement).align(pairs, is_true)
    evidence = evidence_of(map_pair.rivals, map_pair.maps, judge.evidence)
    row = map_pair.keys | {"aligner": ORACLE, "repetition": 0}
    row |= estimate_row(len(pairs), oracle, oracle, judge.on(pairs, evidence).verify(oracle))
    rows = [row, *map_pair.estimates]
    alignments = [alignment_of(each, len(pairs)) for each in rows]
    T_true = se2.between(map_pair.a.path.T_world_map, map_pair.b.path.T_world_map)
    T_refined = np.array([alignment.T_a_b for alignment in alignments])
    inlier = np.array([alignment.inlier for alignment in alignments])
    covariance = np.array([alignment.covariance for alignment in alignments])
    T_estimated = np.array([[each[name] for name in MOTION] for each in rows])
    error_m, error_rad = _motion_errors(T_estimated, T_true)
    refined_m, refined_rad = _motion_errors(T_refined, T_true)
    oracle_m, oracle_rad = _motion_errors(T_refined, oracle.T_a_b)
    n_inliers, n_hits = inlier.sum(axis=1), (inlier & is_true).sum(axis=1)
    errors = {
        "translation_error_m": error_m,
        "rotation_error_rad": error_rad,
        "refined_translation_error_m": refined_m,
        "refined_rotation_error_rad": refined_rad,
        "oracle_distance_m": oracle_m,
        "oracle_distance_rad": np.abs(oracle_rad),
        "n_true": is_true.sum(),
        "n_common": common_landmarks(*map_pair.points_world_m, radius_m),
        "n_inliers": n_inliers,
        "precision": n_hits / np.where(n_inliers, n_inliers, np.nan),
        "recall": n_hits / (is_true.sum() or np.nan),
        "alignment_nees": alignment_nees(T_refined, covariance, T_true),
    }
    # one DataFrame of all columns: adding columns one by one is slow in pandas
    return pd.DataFrame({name: [each[name] for each in rows] for name in row} | errors)


def _motion_errors(T: Float, T_true: Float) -> tuple[Float, Float]:
    """Return translation errors in m and signed rotation errors in rad of motions (N, 3)."""
    error = T - T_true
    return np.hypot(error[:, 0], error[:, 1]), se2.wrap(error[:, 2])


def first_shared_iteration(robots: Sequence[EvaluatedRobot], radius_m: float) -> int | None:
    """Return the first evaluated iteration at which any two maps have common ground.

    Args:
        robots: robots of a team.
        radius_m: distance of true points below which two landmarks are the same.

    Returns:
        The iteration; None if no two maps ever have common ground.
    """
    for k in sorted({k for robot in robots for k in robot.maps}):
        points = [robot.at(k)[1] for robot in robots]
        for a, b in itertools.combinations(points, 2):
            if common_landmarks(a, b, radius_m) >= COMMON_LANDMARKS:
                return k
    return None
