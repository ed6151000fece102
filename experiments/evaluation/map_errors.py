"""Errors of alignments (table `errors`), and of smoothed and fused maps.

The tables of maps are `smoother`, `fusers` and `fuser_coverage`.

The true point of a fused landmark is the mean of the true points of its parents. `map_consistency`
defines gross landmarks, which are left out, and consistency.

Coverage is the share of landmarks whose confidence ellipse contains the true point. It is computed
for fused maps, and for the landmarks of all robots before fusion. A coverage below the nominal
probability shows an overconfident map, one above it a conservative map.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import COMMON_LANDMARKS, ORACLE
from experiments.evaluation.fused_landmarks import FusedTeam, MergeSettings, fusion_rows
from experiments.evaluation.map_consistency import (
    Consistency,
    FittedMap,
    consistencies,
    fit_to_truth,
    relative_consistency,
)
from experiments.evaluation.truth import (
    EvaluatedRobot,
    MapPair,
    common_landmarks,
    join_map_pairs,
    landmark_truth,
    load_robot,
    load_robot_smoothed,
    motion_errors,
    truth_or_unknown,
)
from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages.align import (
    alignment_of,
    estimate_row,
    evidence_of,
)
from experiments.pipeline.stages.slam import final_path
from experiments.pipeline.stages.smooth import (
    RobotFolders,
    folders_of_both,
    read_endings,
    read_path_covariance,
    read_smoothed,
    read_smoothed_path,
    smoothed_owners,
)
from experiments.pipeline.tables import COVARIANCE, MOTION
from mapfusion.align.alignment import Pairs
from mapfusion.align.refinement import Oracle
from mapfusion.files import POSE_FIELDS, covariance_columns, named_columns
from mapfusion.fusion.fusers import FusedMap, Fusion
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, chi_square_bound, squared_mahalanobis
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog
from mapfusion.verification.verdict import Verifier


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


def error_rows(map_pair: MapPair, verifier: Verifier, radius_m: float) -> pd.DataFrame:
    """Return the rows of the table `errors` of one pair of maps; the first is the oracle's.

    The oracle is the aligner that is given the true correspondences.
    """
    is_true, pairs = map_pair.is_true(radius_m), Pairs(*map_pair.maps, map_pair.offered)
    oracle = Oracle(verifier.refinement).align(pairs, is_true)
    evidence = evidence_of(map_pair.rivals, map_pair.maps, verifier.evidence)
    row = map_pair.keys | {"aligner": ORACLE, "repetition": 0}
    row |= estimate_row(len(pairs), oracle, oracle, verifier.on(pairs, evidence).verify(oracle))
    rows = [row, *map_pair.estimates]
    alignments = [alignment_of(each, len(pairs)) for each in rows]
    T_true = se2.between(map_pair.a.path.T_world_map, map_pair.b.path.T_world_map)
    T_refined = np.array([alignment.T_a_b for alignment in alignments])
    inlier = np.array([alignment.inlier for alignment in alignments])
    covariance = np.array([alignment.covariance for alignment in alignments])
    T_estimated = np.array([[each[name] for name in MOTION] for each in rows])
    error_m, error_rad = motion_errors(T_estimated, T_true)
    refined_m, refined_rad = motion_errors(T_refined, T_true)
    oracle_m, oracle_rad = motion_errors(T_refined, oracle.T_a_b)
    n_inliers, n_hits = inlier.sum(axis=1), (inlier & is_true).sum(axis=1)
    errors = {
        "translation_error_m": error_m,
        "rotation_error_rad": error_rad,
        "refined_translation_error_m": refined_m,
        "refined_rotation_error_rad": refined_rad,
        "oracle_distance_m": oracle_m,
        "oracle_distance_rad": np.abs(oracle_rad),
        "n_true": is_true.sum(),
        "n_common": map_pair.n_common(radius_m),
        "n_inliers": n_inliers,
        "precision": n_hits / np.where(n_inliers, n_inliers, np.nan),
        "recall": n_hits / (is_true.sum() or np.nan),
        "alignment_nees": alignment_nees(T_refined, covariance, T_true),
    }
    if map_pair.a.path.fitted or map_pair.b.path.fitted:
        errors["alignment_nees"] = np.full(len(rows), np.nan)  # of another error than that of T
    # one DataFrame of all columns: adding columns one by one is slow in pandas
    return pd.DataFrame({name: [each[name] for each in rows] for name in row} | errors)


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


# Tables of the stage `align`, in the order of the arguments of `join_map_pairs`.
ALIGNED = ("estimates", "correspondences", "rivals")


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of the evaluation of alignments."""

    verifier: Verifier
    merge: MergeSettings
    true_pair_radius_m: float


def run_evaluation(settings: EvaluationSettings, job: Job) -> None:
    """Write the pair's `errors.parquet`, `smoothed_errors.parquet` and `fusion.parquet`."""
    folders, radius_m, map_pairs = folders_of_both(job), settings.true_pair_radius_m, []
    for name, load, align in (
        ("smoothed_errors", load_robot_smoothed, job.inputs["align_smoothed"]),
        ("errors", load_robot, job.inputs["align"]),
    ):
        aligned = [tables.read(align / f"{table}.parquet", table) for table in ALIGNED]
        map_pairs = join_map_pairs([load(each) for each in folders], *aligned)
        errors = pd.concat([error_rows(pair, settings.verifier, radius_m) for pair in map_pairs])
        tables.write(job.output / f"{name}.parquet", name, errors)
    is_known = all(robot.surveyed for robot in (map_pairs[0].a, map_pairs[0].b))
    fusion = fusion_rows(map_pairs, settings.merge, radius_m) if is_known else []
    tables.write(job.output / "fusion.parquet", "fusion", fusion)


EVALUATION_STAGE = StageKind(
    "judge",
    "compare with the truth",
    run_evaluation,
    ("errors.parquet", "smoothed_errors.parquet", "fusion.parquet"),
)


@dataclass(frozen=True)
class SmoothedRobot:
    """Smoothed maps and paths of a robot, by iteration, with the truth.

    Attributes:
        robot: maps of the filter, and true path.
        filter_path: path of the filter at the end, shape (T, 3).
        maps: smoothed maps; only the last one has its joint covariance.
        points_world_m: true points of each map, shape (N, 3), NaN where unknown.
        paths: smoothed paths until each iteration k, shape (k + 1, 3).
        path_covariance: covariances of their poses, shape (k + 1, 3, 3).
        ending: convergence of the smoother at the last iteration.
        not_smoothed: reasons by iteration where smoothing failed.
    """

    robot: EvaluatedRobot
    filter_path: Float
    maps: dict[int, LandmarkMap]
    points_world_m: dict[int, Float]
    paths: dict[int, Float]
    path_covariance: dict[int, Float]
    ending: dict[str, Any]
    not_smoothed: Mapping[int, str] = field(default_factory=dict)

    @property
    def last_path(self) -> Float:
        """Smoothed path of the whole log, shape (T, 3); NaN if smoothing failed."""
        unknown = np.full_like(self.filter_path, np.nan)
        return self.paths.get(len(self.filter_path) - 1, unknown)

    def given_at(self, iteration: int) -> tuple[int | None, str]:
        """Return the iteration of the smoothed map that a fuser is given at an iteration.

        Returns:
            The iteration of the last smoothed map until then, or None: the fuser is given the
            filter's map. And the reason if smoothing failed at the iteration; else empty.
        """
        at = max((k for k in self.maps if k <= iteration), default=None)
        lacking = max((k for k in self.not_smoothed if k <= iteration), default=-1)
        if (at is not None and at > lacking) or lacking < 0:
            return at, ""
        instead = "FastSLAM's map" if at is None else f"its map until frame {at}"
        return at, f"{self.not_smoothed[lacking]}; {instead} stands in"

    def row(self) -> dict[str, Any]:
        """Return the row of the table `smoother`: last map and whole path."""
        robot, last = self.robot, len(self.filter_path) - 1
        path_m, filter_m = (
            path_rmse_m(path, robot.path.T_map_robot) for path in (self.last_path, self.filter_path)
        )
        row = {"robot": robot.name, "path_rmse_m": path_m, "filter_path_rmse_m": filter_m}
        row |= {"filter_over_smoother": filter_m / path_m if path_m > 0 else np.nan} | self.ending
        row["not_smoothed"] = self.given_at(last)[1]
        of_filter = _fit_to_survey([robot], robot.maps[last], robot.points_world_m[last])
        row |= {
            "filter_landmark_rmse_m": of_filter.rmse_m,
            "filter_gross_share": of_filter.gross_share,
        }
        if last not in self.maps:
            return row | {"n_landmarks": 0}
        landmarks = self.maps[last]
        fit = _fit_to_survey([robot], landmarks, self.points_world_m[last])
        row |= {"landmark_rmse_m": fit.rmse_m, "gross_share": fit.gross_share}
        row |= {"n_landmarks": len(landmarks)}
        consistency = relative_consistency(landmarks, fit)
        names = ("nees_per_dof", "marginal_nees_per_dof", "coverage_95")
        return row | {name: getattr(consistency, name) for name in names}


def load_smoothed(
    robot: EvaluatedRobot, folders: RobotFolders, log: RobotLog, smooth: Path
) -> SmoothedRobot:
    """Load a robot's smoothed maps and paths with the truth; NaN where unknown.

    Args:
        robot: maps of the filter, and true path.
        folders: folders of its log and of the stage `slam`.
        log: its log.
        smooth: folder of the stage `smooth`.
    """
    truth, maps = truth_or_unknown(folders.log, log), read_smoothed(smooth, only_last_joint=True)
    points = landmark_truth(truth, partial(smoothed_owners, smooth, folders.slam), maps)
    endings = read_endings(smooth)
    reasons = dict(zip(endings["iteration"].tolist(), endings["not_smoothed"], strict=True))
    not_smoothed = {k: str(why) for k, why in reasons.items() if why}
    ending = {str(name): value for name, value in endings.to_dict("records")[-1].items()}
    paths = final_path(folders.slam), maps, points, read_smoothed_path(smooth)
    return SmoothedRobot(robot, *paths, read_path_covariance(smooth), ending, not_smoothed)


def smoothed_path_rows(smoothed: Sequence[SmoothedRobot]) -> pd.DataFrame:
    """Return the rows of the table `smoothed_paths`."""
    rows = [
        pd.DataFrame(
            named_columns(POSE_FIELDS, path)
            | covariance_columns(COVARIANCE, each.path_covariance[k])
        ).assign(robot=each.robot.name, iteration=k, frame=np.arange(len(path)))
        for each in smoothed
        for k, path in each.paths.items()
    ]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def _fit_to_survey(
    robots: Sequence[EvaluatedRobot], landmarks: LandmarkMap, point_m: Float
) -> FittedMap:
    """Fit true points (N, 3) to a map of some robots; none unless all robots are surveyed."""
    surveyed = all(robot.surveyed for robot in robots)
    return fit_to_truth(landmarks, point_m if surveyed else np.full_like(point_m, np.nan))


def path_rmse_m(path: Float, truth: Float) -> float:
    """Return the RMS position error without a fit; NaN if no pose is known in both paths."""
    known = np.isfinite(path).all(axis=1) & np.isfinite(truth).all(axis=1)
    if not known.any():
        return np.nan
    error_m = np.linalg.norm(path[known, :2] - truth[known, :2], axis=1)
    return float(np.sqrt(np.mean(error_m**2)))


_MOTION_FIGURES = ("alignment_error_m", "alignment_error_rad")
_MOTION_FIGURES += ("alignment_sigma_m", "alignment_sigma_rad", "alignment_nees_per_dof")
_LEAST = 3  # common landmarks: a rigid fit of two is always exact


@dataclass(frozen=True)
class GivenMap:
    """Map of a robot that a fuser was given.

    Attributes:
        robot: the robot.
        landmarks: the map, of the filter or smoothed.
        points_world_m: its true points, shape (N, 3).
        of_filter: map of the filter at the same iteration.
        of_filter_world_m: its true points, shape (L, 3).
        fallback: map that replaces a missing smoothed map, with the reason; else empty.
    """

    robot: EvaluatedRobot
    landmarks: LandmarkMap
    points_world_m: Float
    of_filter: LandmarkMap
    of_filter_world_m: Float
    fallback: str = ""

    @classmethod
    def at(cls, robot: EvaluatedRobot, smoothed: SmoothedRobot | None, k: int) -> "GivenMap":
        """Choose the map at an iteration as the stage `fuse` does (`given_teams`).

        Args:
            robot: the robot.
            smoothed: its smoothed maps, for a fuser of smoothed maps. The last one until the
                iteration is chosen, or the filter's map if there is none.
            k: the iteration.
        """
        filtered = robot.at(k)
        if smoothed is None:
            return cls(robot, *filtered, *filtered)
        at, why = smoothed.given_at(k)
        fallback = f"{robot.name} is not smoothed: {why}" if why else ""
        if at is None:
            return cls(robot, *filtered, *filtered, fallback)
        return cls(robot, smoothed.maps[at], smoothed.points_world_m[at], *filtered, fallback)


@dataclass(frozen=True)
class EvaluatedFusion:
    """Fused map with the maps that it was made of.

    Attributes:
        fuser: name of the fuser.
        iteration: iteration of the maps.
        fusion: fused map of the most robots.
        given: maps of all M robots.
    """

    fuser: str
    iteration: int
    fusion: FusedMap
    given: Sequence[GivenMap]

    def team(self) -> FusedTeam:
        """Return the fusion as a team of robots with the maps that the fuser was given."""
        k, robots = self.iteration, []
        for given in self.given:
            maps, points = {k: given.landmarks}, {k: given.points_world_m}
            robots.append(replace(given.robot, maps=maps, points_world_m=points))
        return FusedTeam(robots, (), k, Fusion((self.fusion,), ()))

    @property
    def fallback(self) -> str:
        """Fallback fuser or map with the reason; else empty."""
        own = f"a simpler fuser stands in: {self.fusion.fallback}" if self.fusion.fallback else ""
        maps = (self.given[k].fallback for k in self.fusion.members)
        return "; ".join(filter(None, (own, *maps)))

    @cached_property
    def fit(self) -> FittedMap:
        """Fit of the true points to the fused map."""
        frame = self.given[self.fusion.members[0]].robot
        members = [self.given[k].robot for k in self.fusion.members]
        points = frame.in_map_frame(self.team().truth_of(self.fusion))
        return _fit_to_survey(members, self.fusion.landmarks, points)

    @cached_property
    def consistency(self) -> tuple[Consistency, Consistency]:
        """Consistency of the fused map after the rigid fit, and in its frame."""
        return consistencies(self.fusion.landmarks, self.fit)

    def row(self) -> dict[str, Any]:
        """Return the row of the table `fusers`, with medians over the motions of the maps."""
        first, *others = self.fusion.members
        T_world_first, errors = self.given[first].robot.path.T_world_map, []
        for k in others:
            T_true = se2.between(T_world_first, self.given[k].robot.path.T_world_map)
            T, covariance = self.fusion.T_first_map[k], self.fusion.motion_covariance[k]
            error_m, error_rad = motion_errors(T, T_true)
            fitted = any(self.given[each].robot.path.fitted for each in (first, k))
            nees = np.nan if fitted else alignment_nees(T, covariance, T_true)
            errors.append([error_m, abs(error_rad), *se2.motion_sigma(covariance), nees / 3])
        medians = np.median(errors, axis=0) if errors else np.full(len(_MOTION_FIGURES), np.nan)
        landmarks, fit = self.fusion.landmarks, self.fit
        relative, in_frame = self.consistency
        return {
            "fuser": self.fuser,
            "iteration": self.iteration,
            "n_robots": len(self.fusion.members),
            "n_landmarks": len(landmarks),
            "landmark_rmse_m": fit.frame_rmse_m,
            "fitted_rmse_m": fit.rmse_m,
            "fitted_median_m": fit.median_m,
            "gross_share": fit.gross_share,
            "over_better_parent": self._over_better_map(of_filter=False),
            "over_better_filter": self._over_better_map(of_filter=True),
            "nees_per_dof": relative.nees_per_dof,
            "marginal_nees_per_dof": relative.marginal_nees_per_dof,
            "coverage_95": relative.coverage_95,
            "frame_nees_per_dof": in_frame.marginal_nees_per_dof,
            "frame_coverage_95": in_frame.coverage_95,
            "duplicate_share": self.fusion.duplicate_share,
            "fallback": self.fallback,
        } | dict(zip(_MOTION_FIGURES, medians.tolist(), strict=True))

    def _over_better_map(self, of_filter: bool) -> float:
        """Return the error of the fused map over the error of the better of two robots' maps.

        The errors are RMS values over the common landmarks of two robots, after a rigid fit of
        each map. The result is the median over pairs of robots.

        Args:
            of_filter: compare with the maps of the filter; else with the maps of the fuser.
        """
        parents, errors = self.fusion.parents, {}
        if of_filter:
            # rows of the same landmarks in the filter's maps, found by their first observation
            parents = np.full_like(self.fusion.parents, ABSENT)
            for k, given in enumerate(self.given):
                origin = given.of_filter.source_observation
                row_of = pd.Series(np.arange(len(origin)), index=origin)
                has = self.fusion.parents[:, k] != ABSENT
                own = given.landmarks.source_observation[self.fusion.parents[has, k]]
                parents[has, k] = row_of.reindex(own).fillna(ABSENT).to_numpy(dtype=np.int64)
        for k in self.fusion.members:
            # errors of a robot's map; NaN for gross landmarks and unknown true points
            given = self.given[k]
            landmarks, points = given.landmarks, given.points_world_m
            if of_filter:
                landmarks, points = given.of_filter, given.of_filter_world_m
            own_fit, errors[k] = fit_to_truth(landmarks, points), np.full(len(landmarks), np.nan)
            if own_fit.too_many_gross:
                continue
            length_m = np.linalg.norm(own_fit.error_m, axis=1)
            errors[k][own_fit.rows] = np.where(own_fit.gross, np.nan, length_m)
        fused, fit = np.full(len(parents), np.nan), self.fit
        if fit.too_many_gross:
            return np.nan
        fused[fit.rows[~fit.gross]] = np.linalg.norm(fit.error_m[~fit.gross], axis=1)
        ratios = []
        for a, b in itertools.combinations(self.fusion.members, 2):
            both = (parents[:, a] != ABSENT) & (parents[:, b] != ABSENT)
            of_a, of_b = errors[a][parents[both, a]], errors[b][parents[both, b]]
            three = np.stack([fused[both], of_a, of_b])
            three = three[:, np.isfinite(three).all(axis=0)]
            if three.shape[1] >= _LEAST:
                rms = np.sqrt(np.mean(three**2, axis=1))
                ratios.append(rms[0] / min(rms[1:]) if min(rms[1:]) > 0 else np.nan)
        return float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else np.nan


def last_fused(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the table `fusers` at the last iteration of each fuser and run."""
    keys = [name for name in ("run_id", "fuser") if name in rows]
    return rows[rows["iteration"] == rows.groupby(keys)["iteration"].transform("max")]


# Nominal probabilities of confidence ellipses; denser where gates and bounds usually are.
NOMINAL_COVERAGES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
FUSED, FILTERED, SMOOTHED = "fused", "filter", "smoothed"  # kinds of maps
_Both = tuple[Consistency, Consistency]  # after the rigid fit, and in the frame of the map


def coverage_rows(fusions: Sequence[EvaluatedFusion]) -> list[dict[str, Any]]:
    """Return the rows of the table `fuser_coverage`: maps before and after the last fusion."""
    last = max((fusion.iteration for fusion in fusions), default=None)
    at_end = [fusion for fusion in fusions if fusion.iteration == last]
    # maps before fusion by kind and robot; several fusers are given the same ones
    maps: dict[str, dict[str, tuple[EvaluatedRobot, LandmarkMap, Float]]] = {}
    for given in (given for fusion in at_end for given in fusion.given):
        robot = given.robot
        of_filter = (robot, given.of_filter, given.of_filter_world_m)
        maps.setdefault(FILTERED, {})[robot.name] = of_filter
        if given.landmarks is not given.of_filter:
            own = (robot, given.landmarks, given.points_world_m)
            maps.setdefault(SMOOTHED, {})[robot.name] = own
    rows = []
    for kind, by_robot in maps.items():
        found = []
        for robot, landmarks, points in by_robot.values():
            fit = _fit_to_survey([robot], landmarks, robot.in_map_frame(points))
            found.append(consistencies(landmarks, fit))
        rows += _coverage_of(found, at_end[0], {"map": kind, "fuser": ""})
    for fusion in at_end:
        keys = {"map": FUSED, "fuser": fusion.fuser}
        rows += _coverage_of([fusion.consistency], fusion, keys)
    return rows


def _coverage_of(
    maps: Sequence[_Both], fusion: EvaluatedFusion, keys: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Yield a row for each nominal coverage; none if no true point is known."""
    relative, frame = (
        np.concatenate([each.own_nees for each in both]) for both in zip(*maps, strict=True)
    )
    d = fusion.fusion.landmarks.n_dimensions
    for nominal in NOMINAL_COVERAGES if len(relative) else ():
        bound = chi_square_bound(nominal, d)
        shares = {"coverage": np.mean(relative <= bound), "frame_coverage": np.mean(frame <= bound)}
        about = {"iteration": fusion.iteration, "n_landmarks": len(relative)}
        yield keys | about | {"nominal": nominal} | shares
