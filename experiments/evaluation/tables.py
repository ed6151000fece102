"""Schemas of the result tables: what the figures, the checks and other people's scripts read.

All are Parquet, in `RESULT/tables/`. Units are in the names; rotations are counter-clockwise.
`elapsed_s` columns live in `timings` and `aligner_timings` alone: every other table is the same,
bit for bit, whenever the scenario and the seed are. A column's type follows from its name, which
means the same in all tables: what is not listed in `_NAMES` is a float.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pyarrow as pa

from experiments.pipeline import tables
from experiments.pipeline.tables import CORRESPONDENCES, ESTIMATES, RIVALS, TRACKS
from mapfusion.files import COVARIANCE_FIELDS, POSITION_FIELDS, schema

if TYPE_CHECKING:  # as in `frames`
    import pandas as pd

# Names that are no floats.
_NAMES = {
    tables.TEXT: """acceptance_reason aligner check delta_unit fallback finding fuser landmarks
        left_out map name not_smoothed place quantity reason refined_reason refined_status robot
        robot_a robot_b source stage status verdict""",
    tables.INT: """component count degrees_of_freedom frame iteration landmark landmark_a landmark_b
        n n_common n_confirmed n_contradicted n_correspondences n_inliers n_landmarks n_parents
        n_robots n_steps n_team n_true particle repetition""",
    tables.BOOL: "accepted resampled true_pair",
}
# In plan: single precision, for looking at and not for computing with, takes half the size.
_PLAN = ("x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
_OTHER_TYPES = {
    "map_history": dict.fromkeys(_PLAN, pa.float32()),
    "fused_history": dict.fromkeys(_PLAN, pa.float32()),
    "true_pairs": {"true_pair": pa.binary()},
}
_VERSIONS = {"errors": 4}  # of the others: 1
UNKNOWN = -1  # a count that only the truth could tell
_POINT = " ".join(POSITION_FIELDS + COVARIANCE_FIELDS)
_COLUMNS = {
    # One row per (robot pair, iteration, aligner, repetition), the estimates joined with the truth.
    # The aligner named "oracle" was given the true pairs; it has one repetition. rotation_error_rad
    # is signed, estimate minus truth; verdict to acceptance_reason are of the refined alignment
    # (mapfusion/evidence); oracle_distance: of the refined alignment from the oracle's;
    # n_true: true ones among the correspondences; n_common: landmarks of the two maps that truly
    # correspond; precision and recall: of the refined inliers; alignment_nees: refined, 3 degrees
    # of freedom.
    "errors": """robot_a robot_b iteration aligner repetition status reason
        translation_error_m rotation_error_rad
        refined_status refined_reason refined_translation_error_m refined_rotation_error_rad
        verdict accepted log10_false_alarms log10_evidence n_confirmed n_contradicted
        probability acceptance_reason oracle_distance_m oracle_distance_rad
        n_correspondences n_true n_common n_inliers precision recall alignment_nees""",
    # One row per (robot, iteration); best particle online, anchored at the start, no fit. spread_m:
    # root of the trace of the particles' weighted position covariance. n_landmarks: of the best
    # particle, however often seen; its map holds those that were seen `slam.min_count` times.
    "robots": """robot iteration path_error_m path_error_rad odometry_error_m odometry_error_rad
        effective_sample_size resampled n_landmarks spread_m""",
    # Paths in the robot's own frame: the best particle's whole path at the end, the online
    # estimate, odometry alone, and the truth.
    "paths": """robot iteration final_x_m final_y_m final_theta_rad
        online_x_m online_y_m online_theta_rad odometry_x_m odometry_y_m odometry_theta_rad
        truth_x_m truth_y_m truth_theta_rad""",
    # When the frames of `paths` were, by the robot's log.
    "frame_times": "robot iteration time_s",
    # What the filter loses against a batch: each robot's log smoothed whole, its last map and path;
    # see evaluation/smoothed_robots.py and map_consistency.py. Paths from the same start;
    # landmarks after the best rigid fit without the gross ones, which are counted; their
    # consistency with the gauge removed. filter_: of FastSLAM's last map and final path. The
    # degrees of freedom are of the Student-t's that observations and tracks' offsets were found to
    # be of; observation_level is the factor on the observations' stated covariances that the log
    # told. not_smoothed: why there is nothing, and what stands in (else empty).
    "smoother": """robot n_landmarks path_rmse_m filter_path_rmse_m filter_over_smoother
        landmark_rmse_m gross_share filter_landmark_rmse_m filter_gross_share
        nees_per_dof marginal_nees_per_dof coverage_95
        n_steps observation_dof offset_dof observation_level not_smoothed""",
    # What each robot's log says against itself, see datasets/log_consistency.py. check: odometry
    # (as a whole), truth, jump (a single increment, which is not used) or gate (most observations
    # fell outside that of their landmark); iteration: of a jump, else -1.
    "findings": "robot check iteration finding",
    # The smoothed path, in the robot's own frame, up to each iteration that maps are fused at.
    "smoothed_paths": "robot iteration frame x_m y_m theta_rad",
    # Particles at the kept iterations, in the robot's own frame.
    "clouds": "robot iteration particle x_m y_m theta_rad log_weight",
    # The robots' last maps, each in its own frame; the true point is given in the same frame.
    "landmarks": f"robot landmark {_POINT} count truth_x_m truth_y_m truth_z_m",
    # The maps fused as the paper does (eq. 12 to 16 with drift, the fuser kalman-drift), in the
    # frame of the first robot that is in them. The parents are rows of the robots' last maps;
    # robot_b is empty for a landmark that was carried over from one map.
    "fused": f"""landmark {_POINT} n_parents robot_a landmark_a robot_b landmark_b
        truth_x_m truth_y_m truth_z_m""",
    # The map that `merge.fuser` made of the robots' last maps, likewise; the parents are rows of
    # the maps that it was given: the smoothed ones, where it takes these.
    "fused_map": f"""landmark {_POINT} n_parents robot_a landmark_a robot_b landmark_b
        truth_x_m truth_y_m truth_z_m""",
    # One row per (fuser, iteration): the map of the most robots against the truth; see
    # evaluation/fused_map_errors.py and map_consistency.py. landmark_rmse_m: in the frame of
    # the first robot in it; fitted: after the best rigid fit; gross landmarks are left out of both
    # and counted. over_better_parent: landmarks that two robots have, over the better of the maps
    # that the fuser was given, over_better_filter: of FastSLAM's, each map fitted for itself;
    # medians over pairs of robots. nees_per_dof, marginal_nees_per_dof and coverage_95: with the
    # gauge removed, the first of all landmarks at once; a map that has no joint covariance (all but
    # the last of each fuser) is taken for one of independent errors. frame_: in the frame, of each
    # landmark for itself. alignment_: how the other robots' maps were moved, medians; sigma:
    # as stated, see se2.motion_sigma. fallback: whether a simpler fuser stood in, or another map
    # for a robot's smoothed one, which and why (else empty).
    "fusers": """fuser iteration n_robots n_landmarks landmark_rmse_m fitted_rmse_m fitted_median_m
        gross_share over_better_parent over_better_filter
        nees_per_dof marginal_nees_per_dof coverage_95 frame_nees_per_dof frame_coverage_95
        alignment_error_m alignment_error_rad alignment_sigma_m alignment_sigma_rad
        alignment_nees_per_dof duplicate_share fallback""",
    # Share of the true points inside the ellipses of a nominal probability, at the last iteration,
    # of each fuser's map and before: map is fused, or filter or smoothed with no fuser, which are
    # all robots' maps together. coverage: each map after its best rigid fit, with the gauge
    # removed; frame_coverage: in its own frame. Without the gross ones, n_landmarks in all.
    "fuser_coverage": "map fuser iteration n_landmarks nominal coverage frame_coverage",
    # What becomes of the alignment of each two robots' last maps in the team: confirmed by a loop
    # of others, a bridge that nothing confirms, contradicted, ambiguous, unconfirmed or refused.
    "team_edges": "robot_a robot_b place",
    # Each two robots against the truth: the merging aligner's last alignment by itself, as in
    # `errors`, and T_a_b between the two as all believed alignments together place them; NaN where
    # they are in no map together.
    "team_pairs": """robot_a robot_b place accepted n_common
        refined_translation_error_m refined_rotation_error_rad
        team_translation_error_m team_rotation_error_rad""",
    # Position errors of n_robots of a run's n_team: moved into one frame as their maps were, then
    # all of them by one rigid fit. component: 1 for the fused map of most robots. source: as in
    # `path_statistics`, smoothed paths as a fuser of smoothed maps moved
    # these; n: poses.
    "team": "component source n_robots n_team n rmse mean median std min max sse",
    # How each robot's last map was moved into the fused map, the first robot's own among them; NaN
    # for a map that was left out, with the reason (else empty). drift_sigma_m: as added to the
    # landmarks' covariance in x and y.
    "fused_motions": "robot tx_m ty_m theta_rad drift_sigma_m left_out",
    # The robots' maps at each evaluated iteration, in plan, each in its own frame. `landmark` is
    # the row of the map at that iteration, which correspondences of that iteration refer to.
    "map_history": " ".join(("robot iteration landmark", *_PLAN)),
    # Landmarks that the merging aligner's inliers joined at that iteration, fused, in robot a's
    # frame.
    "fused_history": " ".join(("robot_a robot_b iteration landmark_a landmark_b", *_PLAN)),
    # Which of the correspondences are true: one bit each, in their order in `correspondences`.
    "true_pairs": "robot_a robot_b iteration n_correspondences true_pair",
    # One row per fused landmark with two parents, per robot pair: was fusing worth it? error_b_m is
    # moved into frame a by the estimate.
    "fusion": """robot_a robot_b landmark_a landmark_b error_a_m error_b_m error_fused_m
        nees_with_drift nees_without_drift degrees_of_freedom true_pair""",
    # Per map, after the best rigid fit to the truth; "fused" is the fused map.
    "map_fits": "map n_landmarks rmse_m",
    # Errors of whole paths with evo's seven statistics; see experiments/evaluation/path_errors.py.
    # source: final, online (as in `paths`) or odometry; quantity: ate_m (after the best rigid fit),
    # ate_from_start_m, rpe_m or rpe_rad, these over delta (frames or m); n: poses, or pairs of
    # them.
    "path_statistics": """robot source quantity delta delta_unit n
        rmse mean median std min max sse""",
    # NEES of each map's landmarks (map: a robot, or "fused"), before merging and after; see
    # evaluation/fused_landmarks.py. landmarks: own, all of a robot's map; before fusing,
    # those of them that were truly fused; fused, of the merged map, with several parents; carried
    # over, with one. n_landmarks: with a known truth. share_in_gate: of 95 %.
    "landmark_nees": """map landmarks n_landmarks degrees_of_freedom
        nees_mean nees_median share_in_gate""",
    # Seconds of work by stage; what a run needs beside its stages (start, tables, timing the
    # aligners, figures) has rows named like stages.
    "timings": "stage name elapsed_s",
    # Serial, warmed, repeated: figure 6. Median of the repeats, 10th and 90th percentile; n_common
    # is -1 where the truth is unknown.
    "aligner_timings": """robot_a robot_b iteration aligner n_correspondences n_common
        elapsed_s elapsed_low_s elapsed_high_s""",
}


def _schema(name: str) -> pa.Schema:
    types = {column: kind for kind, names in _NAMES.items() for column in names.split()}
    types |= _OTHER_TYPES.get(name, {})
    columns = {column: types.get(column, tables.FLOAT) for column in _COLUMNS[name].split()}
    return schema(f"result.{name}", _VERSIONS.get(name, 1), tables.fields(**columns))


ALL = {"estimates": ESTIMATES, "correspondences": CORRESPONDENCES, "rivals": RIVALS}
ALL |= {"tracks": TRACKS}
ALL |= {name: _schema(name) for name in _COLUMNS}


class Shown(NamedTuple):
    """How screens and reports show a column of `errors`, one figure a method.

    What follows a line break in the label goes to its second line. An `error` is shown as the
    median of its absolute value over answerable maps, where no estimate is infinitely far off, and
    beside it the share of `given` estimates; a `share` as the mean over maps with common ground.
    """

    label: str
    layout: str
    kind: Literal["error", "given", "share"]


SHOWN = {
    "translation_error_m": Shown("estim.\nm", ".3f", "error"),
    "rotation_error_rad": Shown("estim.\nrad", ".4f", "error"),
    "estimated_share": Shown("estim.\ngiven", ".0%", "given"),
    "refined_translation_error_m": Shown("refined\nm", ".3f", "error"),
    "refined_rotation_error_rad": Shown("refined\nrad", ".4f", "error"),
    "refined_share": Shown("refined\ngiven", ".0%", "given"),
    "accepted": Shown("ok\n", ".0%", "share"),
}


def table_path(result: Path, name: str) -> Path:
    """Where a result folder keeps the table of that name."""
    return result / "tables" / f"{name}.parquet"


def as_table(name: str, rows: pd.DataFrame | list[dict[str, Any]]) -> pd.DataFrame:
    """Rows with the columns of the table of that name alone; of no rows, columns of any type."""
    import pandas as pd

    return pd.DataFrame(rows if len(rows) else [], columns=pd.Index(ALL[name].names))


def write(path: Path, name: str, rows: pd.DataFrame | list[dict[str, Any]]) -> None:
    """Write rows as the table of that name."""
    tables.write_rows(path, ALL[name], as_table(name, rows))


def read(path: Path, name: str) -> pd.DataFrame:
    """Read the table of that name; raises InputError that names the file."""
    return tables.read_rows(path, ALL[name])


def work_by_stage(timings: pd.DataFrame) -> pd.DataFrame:
    """Return seconds of work and the number of tasks by stage, from rows of `timings`.

    A task that several runs share counts once. Columns: `stage`, `seconds`, `tasks`.
    """
    works = timings[timings["name"].str.endswith(":elapsed_s")].drop_duplicates(["stage", "name"])
    stages = works.groupby("stage", sort=False)["elapsed_s"]
    return stages.agg(seconds="sum", tasks="count").reset_index()
