"""Errors and times of alignments: rows of the tables `errors` and `aligner_timings`."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import tables
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
from experiments.plugins.discovery import callable_aligner
from experiments.scenario.seeds import generator
from experiments.scenario.settings import AnyScenario
from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.oracle import Oracle
from mapfusion.fusion.fused_map import AlignedPair
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.registration import Aligner
from mapfusion.verification.verdict import Judge

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
        return latest_at(self.maps, iteration), latest_at(self.points_world_m, iteration)

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


def first_shared_iteration(robots: Sequence[EvaluatedRobot], radius_m: float) -> int | None:
    """The first evaluated iteration at which the maps of any two have common ground; None if never.

    Args:
        robots: all of a team.
        radius_m: landmarks whose true points lie this near are one.
    """
    for k in sorted({k for robot in robots for k in robot.maps}):
        points = [robot.at(k)[1] for robot in robots]
        for a, b in itertools.combinations(points, 2):
            if common_landmarks(a, b, radius_m) >= COMMON_LANDMARKS:
                return k
    return None


_PERCENTILES = {"elapsed_low_s": 10, "elapsed_s": 50, "elapsed_high_s": 90}
_WARM_UP = "warm-up"  # names the generators of calls that are not timed


@dataclass(frozen=True)
class AlignerTiming:
    """Aligners made ready to be timed on the maps of one pair of robots.

    Attributes:
        seed: of the scenario.
        repeats: timings of each aligner on each maps.
        aligners: by name; what they run is compiled and loaded.
        maps: evenly spread over the run.
        n_common: landmarks that truly correspond, of each of these; UNKNOWN without truth.
    """

    seed: int
    repeats: int
    aligners: Mapping[str, Aligner]
    maps: Sequence[MetMaps]
    n_common: Sequence[int]

    @classmethod
    def of(cls, scenario: AnyScenario, met: Sequence[MetMaps]) -> "AlignerTiming":
        """Of the pair's maps at all iterations; other work may go on beside."""
        settings = scenario.evaluate
        spread = np.linspace(0, len(met) - 1, settings.timing_points)
        maps = [met[k] for k in np.unique(spread.round().astype(int))]
        aligners = {
            entry.name: callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
            for entry in scenario.align.aligners
        }
        n_common = [_n_common(each, settings.true_pair_radius_m) for each in maps]
        ready = cls(scenario.seed, settings.timing_repeats, aligners, maps, n_common)
        for fewest_or_most in (maps[0], maps[-1]):  # of little, some turn to other code
            for name in aligners:
                ready._call(name, fewest_or_most, _WARM_UP)
        return ready

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table `aligner_timings`; nothing else may be running."""
        rows, elapsed_s = [], []
        for maps, n_common in zip(self.maps, self.n_common, strict=True):
            self._call(next(iter(self.aligners)), maps, _WARM_UP)  # the maps into the caches
            of_all = {"n_correspondences": len(maps.offered), "n_common": n_common}
            for name in self.aligners:
                rows.append(maps.names | of_all | {"aligner": name})
                elapsed_s.append([self._call(name, maps, k) for k in range(self.repeats)])
        times = np.percentile(elapsed_s, list(_PERCENTILES.values()), axis=1).T
        named = (dict(zip(_PERCENTILES, each, strict=True)) for each in times.tolist())
        return [row | each for row, each in zip(rows, named, strict=True)]

    def _call(self, name: str, maps: MetMaps, repeat: int | str) -> float:
        """Seconds that an aligner takes."""
        rng = generator(self.seed, "timing", name, repeat)
        return self.aligners[name].align(*maps.maps, maps.offered, rng).elapsed_s


def _n_common(maps: MetMaps, radius_m: float) -> int:
    known = all(np.isfinite(points).any() for points in maps.points_world_m)
    return common_landmarks(*maps.points_world_m, radius_m) if known else tables.UNKNOWN
