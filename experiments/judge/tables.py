"""Schemas of the result tables: what the figures, the checks and other people's scripts read.

All are Parquet, in `RESULT/tables/`. Units are in the names; rotations are counter-clockwise.
`elapsed_s` columns live in `timings` and `aligner_timings` alone: every other table is the same,
bit for bit, whenever the scenario and the seed are. A column's type follows from its name, which
means the same in all tables: what is not listed in `_NAMES` is a float.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd
import pyarrow as pa

from experiments.run import frames
from experiments.run.stage_tables import CORRESPONDENCES, ESTIMATES, TRACKS
from mapfusion.storage import point_fields, schema

# Names that are no floats.
_NAMES = {
    frames.TEXT: """aligner delta_unit landmarks left_out map name quantity reason refined_status
        robot robot_a robot_b source stage status""",
    frames.INT: """count degrees_of_freedom iteration landmark landmark_a landmark_b n n_common
        n_correspondences n_inliers n_landmarks n_parents n_true particle repetition""",
    frames.BOOL: "accepted resampled true_pair",
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names.split()}

ALL: dict[str, pa.Schema] = {
    "estimates": ESTIMATES,
    "correspondences": CORRESPONDENCES,
    "tracks": TRACKS,
}


def _table(name: str, version: int, *columns: str | list[pa.Field]) -> None:
    """Declare a table of results: names of columns, and fields of other types, in their order."""
    fields = []
    for each in columns:
        if isinstance(each, str):
            types = {column: _TYPES.get(column, frames.FLOAT) for column in each.split()}
            each = frames.fields(**types)
        fields += each
    ALL[name] = schema(f"result.{name}", version, fields)


# One row per (robot pair, iteration, aligner, repetition), the estimates joined with the truth.
# The aligner named "oracle" was given the true pairs; it has one repetition. rotation_error_rad is
# signed, estimate minus truth; accepted and log10_false_alarms are of the refined alignment, by the
# test against chance; oracle_distance: of the refined alignment from the oracle's; n_true: true
# ones among the correspondences; n_common: landmarks of the two maps that truly correspond;
# precision and recall: of the refined inliers; alignment_nees: refined, 3 degrees of freedom.
_table(
    "errors",
    2,
    "robot_a robot_b iteration aligner repetition status reason",
    "translation_error_m rotation_error_rad",
    "refined_status refined_translation_error_m refined_rotation_error_rad",
    "accepted log10_false_alarms oracle_distance_m oracle_distance_rad",
    "n_correspondences n_true n_common n_inliers precision recall alignment_nees",
)


class Shown(NamedTuple):
    """How screens and reports show a column of `errors`, one figure a method.

    Attributes:
        label: heading; what follows a line break goes to its second line.
        layout: of the figure.
        kind: an `error` is shown as the median of its absolute value over answerable maps, where no
            estimate is infinitely far off; a `share` as the mean over maps with common ground.
    """

    label: str
    layout: str
    kind: Literal["error", "share"]


SHOWN = {
    "translation_error_m": Shown("estim.\nm", ".3f", "error"),
    "rotation_error_rad": Shown("estim.\nrad", ".4f", "error"),
    "refined_translation_error_m": Shown("refined\nm", ".3f", "error"),
    "refined_rotation_error_rad": Shown("refined\nrad", ".4f", "error"),
    "accepted": Shown("ok\n", ".0%", "share"),
}

# One row per (robot, iteration); best particle online, anchored at the start, no fit. spread_m:
# root of the trace of the particles' weighted position covariance.
_table(
    "robots",
    1,
    "robot iteration path_error_m path_error_rad odometry_error_m odometry_error_rad",
    "effective_sample_size resampled n_landmarks spread_m",
)

# Paths in the robot's own frame: the best particle's whole path at the end, the online estimate,
# odometry alone, and the truth.
_table(
    "paths",
    1,
    "robot iteration final_x_m final_y_m final_theta_rad online_x_m online_y_m online_theta_rad",
    "odometry_x_m odometry_y_m odometry_theta_rad truth_x_m truth_y_m truth_theta_rad",
)

# Particles at the kept iterations, in the robot's own frame.
_table("clouds", 1, "robot iteration particle x_m y_m theta_rad log_weight")

# The robots' last maps, each in its own frame; the true point is given in the same frame.
_TRUE_POINT = "truth_x_m truth_y_m truth_z_m"
_table("landmarks", 1, "robot landmark", point_fields(), "count", _TRUE_POINT)

# The fused map in the frame of the first robot. The parents are rows of the robots' last maps;
# robot_b is empty for a landmark that was carried over from one map.
_table(
    "fused",
    1,
    "landmark",
    point_fields(),
    "n_parents robot_a landmark_a robot_b landmark_b",
    _TRUE_POINT,
)

# How each robot's last map was moved into the fused map, the first robot's own among them; NaN for
# a map that was left out, with the reason (else empty). drift_sigma_m: as added to the landmarks'
# covariance in x and y.
_table("fused_motions", 1, "robot tx_m ty_m theta_rad drift_sigma_m left_out")

# The robots' maps at each evaluated iteration, in plan, each in its own frame. `landmark` is the
# row of the map at that iteration, which correspondences of that iteration refer to. Single
# precision, for looking at and not for computing with: hundreds of maps take half the size.
_PLAN = frames.fields(
    **dict.fromkeys(("x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"), pa.float32())
)
_table("map_history", 1, "robot iteration landmark", _PLAN)

# Landmarks that the merging aligner's inliers joined at that iteration, fused, in robot a's frame.
_table("fused_history", 1, "robot_a robot_b iteration landmark_a landmark_b", _PLAN)

# Which of the correspondences are true: one bit each, in their order in `correspondences`.
_table(
    "true_pairs",
    1,
    "robot_a robot_b iteration n_correspondences",
    [pa.field("true_pair", pa.binary())],
)

# One row per fused landmark with two parents, per robot pair: was fusing worth it? error_b_m is
# moved into frame a by the estimate.
_table(
    "fusion",
    1,
    "robot_a robot_b landmark_a landmark_b error_a_m error_b_m error_fused_m",
    "nees_with_drift nees_without_drift degrees_of_freedom true_pair",
)

# Per map, after the best rigid fit to the truth; "fused" is the fused map.
_table("map_fits", 1, "map n_landmarks rmse_m")

# Errors of whole paths with evo's seven statistics; see experiments/judge/path_errors.py.
# source: final, online (as in `paths`) or odometry; quantity: ate_m (after the best rigid fit),
# ate_from_start_m, rpe_m or rpe_rad, these over delta (frames or m); n: poses, or pairs of poses.
_table(
    "path_statistics",
    1,
    "robot source quantity delta delta_unit n rmse mean median std min max sse",
)

# NEES of each map's landmarks (map: a robot, or "fused"), before merging and after; see
# experiments/judge/consistency.py. landmarks: own, all of a robot's map; before fusing, those of
# them that were truly fused; fused, of the merged map, with several parents; carried over, with
# one. n_landmarks: with a known truth. share_in_gate: of 95 %.
_table(
    "landmark_nees",
    1,
    "map landmarks n_landmarks degrees_of_freedom nees_mean nees_median share_in_gate",
)

# Seconds of work by stage.
_table("timings", 1, "stage name elapsed_s")

# Serial, warmed, repeated: figure 6. Median of the repeats, 10th and 90th percentile.
_table(
    "aligner_timings",
    1,
    "robot_a robot_b iteration aligner n_correspondences n_common",
    "elapsed_s elapsed_low_s elapsed_high_s",
)


def table_path(result: Path, name: str) -> Path:
    """Where a result folder keeps the table of that name."""
    return result / "tables" / f"{name}.parquet"


def write(path: Path, name: str, rows: pd.DataFrame | list[dict[str, Any]]) -> None:
    """Write rows as the table of that name."""
    frames.write_rows(path, ALL[name], rows)


def read(path: Path, name: str) -> pd.DataFrame:
    """Read the table of that name; raises InputError that names the file."""
    return frames.read_rows(path, ALL[name])
