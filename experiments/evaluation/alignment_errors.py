"""Errors of alignments: the table `errors`, and the stage that evaluates pairs of robots."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.evaluation.criteria import COMMON_LANDMARKS, ORACLE
from experiments.evaluation.fused_landmarks import MergeSettings, fusion_rows
from experiments.evaluation.truth import (
    EvaluatedRobot,
    MapPair,
    common_landmarks,
    join_map_pairs,
    load_robot,
    load_robot_smoothed,
    motion_errors,
    squared_mahalanobis,
)
from experiments.pipeline.stage import Job, StageKind
from experiments.pipeline.stages.align import (
    alignment_of,
    estimate_row,
    evidence_of,
)
from experiments.pipeline.stages.robot_maps import folders_of_both
from experiments.pipeline.tables import MOTION
from mapfusion.align.alignment import Pairs
from mapfusion.align.refinement import Oracle
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
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
        "n_common": common_landmarks(*map_pair.points_world_m, radius_m),
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
