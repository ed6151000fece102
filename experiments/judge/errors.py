"""Estimates joined with the truth: the rows of the table `errors`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE
from experiments.judge.truth import PathTruth, common_landmarks, squared_mahalanobis, true_pairs
from experiments.run.estimates import (
    alignment_of,
    correspondences_of,
    estimate_row,
    evidence_of,
)
from experiments.run.frames import records
from experiments.run.stage_tables import MOTION
from experiments.run.stages.match import known_at
from mapfusion import se2
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.oracle import Oracle
from mapfusion.align.pairs import Pairs
from mapfusion.evidence.judge import Judge
from mapfusion.fused_map import AlignedPair
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

_MEETING = ["robot_a", "robot_b", "iteration"]


@dataclass(frozen=True)
class EvaluatedRobot:
    """What is known of one robot when its maps are judged; maps and true points by iteration."""

    name: str
    maps: Mapping[int, LandmarkMap]
    points_world_m: dict[int, Float]  # (N, 3) for each map
    path: PathTruth

    def at(self, iteration: int) -> tuple[LandmarkMap, Float]:
        """Map and true points at an iteration (the last ones of a log that ended earlier)."""
        return known_at(self.maps, iteration), known_at(self.points_world_m, iteration)

    def in_map_frame(self, points_world_m: Float) -> Float:
        """Points (..., 3) of the world in the frame of this robot's maps."""
        return se2.transform_points(se2.inverse(self.path.T_world_map), points_world_m)


@dataclass(frozen=True)
class MetMaps:
    """Maps of two robots at one iteration, what aligners were offered, and what they answered.

    With the rival motions that were found for them.
    """

    a: EvaluatedRobot
    b: EvaluatedRobot
    iteration: int
    maps: tuple[LandmarkMap, LandmarkMap]
    points_world_m: tuple[Float, Float]
    offered: Correspondences
    estimates: Sequence[Mapping[str, Any]]  # rows of the table of that name
    rivals: pd.DataFrame

    @property
    def names(self) -> dict[str, Any]:
        """Columns that tell it from others."""
        return dict(zip(_MEETING, (self.a.name, self.b.name, self.iteration), strict=True))

    def is_true(self, radius_m: float) -> np.ndarray:
        """Which of the correspondences are true."""
        pairs = self.offered
        return true_pairs(*self.points_world_m, pairs.index_a, pairs.index_b, radius_m)

    def aligned(self, aligner: str, a: int, b: int) -> AlignedPair:
        """What maps are merged by: repetitions are for the spread of a method, not for the map.

        The two are the `a`th and the `b`th of those that are merged.
        """
        ours = (row for row in self.estimates if row["aligner"] == aligner)
        row = next(row for row in ours if row["repetition"] == 0)
        alignment = alignment_of(row, len(self.offered))
        return AlignedPair(a, b, alignment, self.offered, row["log10_false_alarms"])


def met_maps(
    robots: Sequence[EvaluatedRobot],
    estimates: pd.DataFrame,
    correspondences: pd.DataFrame,
    rivals: pd.DataFrame,
) -> list[MetMaps]:
    """All pairs and iterations of the tables of these names, in their order."""
    by_name = {robot.name: robot for robot in robots}
    offered, rival = (dict(iter(rows.groupby(_MEETING))) for rows in (correspondences, rivals))
    said: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for row in records(estimates):  # a group of a frame takes as long as all of these
        said.setdefault((row["robot_a"], row["robot_b"], row["iteration"]), []).append(row)
    met = []
    for key, rows in said.items():
        name_a, name_b, iteration = key
        a, b = by_name[name_a], by_name[name_b]
        (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
        pairs = correspondences_of(offered.get(key, correspondences.iloc[:0]))
        maps, points = (map_a, map_b), (points_a, points_b)
        others = rival.get(key, rivals.iloc[:0])
        met.append(MetMaps(a, b, iteration, maps, points, pairs, rows, others))
    return met


def alignment_nees(T_estimate: Float, covariance: Float, T_true: Float) -> Float:
    """Squared Mahalanobis distances (...) of alignments to the truth; 3 degrees of freedom.

    Args:
        T_estimate: (..., 3).
        covariance: (..., 3, 3) of these; NaN, and so the distance, where there is none.
        T_true: (3,).
    """
    error = T_estimate - T_true
    error[..., 2] = se2.wrap(error[..., 2])
    known = np.isfinite(covariance).all(axis=(-2, -1)) & np.isfinite(error).all(axis=-1)
    nees = np.full(known.shape, np.nan)
    nees[known] = squared_mahalanobis(error[known], covariance[known])
    return nees


def error_rows(met: MetMaps, judge: Judge, radius_m: float) -> pd.DataFrame:
    """Rows of the table `errors` of one pair of maps, the oracle's first."""
    is_true, pairs = met.is_true(radius_m), Pairs(*met.maps, met.offered)
    oracle = Oracle(judge.refinement).align(pairs, is_true)
    evidence = evidence_of(met.rivals, met.maps, judge.evidence)
    row = met.names | {"aligner": ORACLE, "repetition": 0}
    row |= estimate_row(len(pairs), oracle, oracle, judge.on(pairs, evidence).judge(oracle))
    rows = [row, *met.estimates]
    alignments = [alignment_of(each, len(pairs)) for each in rows]
    T_true = se2.between(met.a.path.T_world_map, met.b.path.T_world_map)
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
        "n_common": common_landmarks(*met.points_world_m, radius_m),
        "n_inliers": n_inliers,
        "precision": n_hits / np.where(n_inliers, n_inliers, np.nan),
        "recall": n_hits / (is_true.sum() or np.nan),
        "alignment_nees": alignment_nees(T_refined, covariance, T_true),
    }
    # all columns at once: pandas takes as long to add one as to make a frame
    return pd.DataFrame({name: [each[name] for each in rows] for name in row} | errors)


def _motion_errors(T: Float, T_right: Float) -> tuple[Float, Float]:
    """How far off motions (N, 3) are, in m and, signed, in rad."""
    error = T - T_right
    return np.hypot(error[:, 0], error[:, 1]), se2.wrap(error[:, 2])
