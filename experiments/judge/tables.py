"""Schemas of the result tables: what the figures, the checks and other people's scripts read.

All are Parquet, in `RESULT/tables/`. Units are in the names; rotations are counter-clockwise.
`elapsed_s` columns live in `timings` and `aligner_timings` alone: every other table is the same,
bit for bit, whenever the scenario and the seed are.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import pandas as pd
import pyarrow as pa

from experiments.run import frames
from experiments.run.stage_tables import CORRESPONDENCES, ESTIMATES, TRACKS
from mapfusion.storage import point_fields, schema

_BOOL, _FLOAT, _INT, _TEXT = frames.BOOL, frames.FLOAT, frames.INT, frames.TEXT
_fields = frames.fields
_SINGLE = pa.float32()  # for looking at, not for computing with: hundreds of maps, half the size


ALL: dict[str, pa.Schema] = {
    "estimates": ESTIMATES,
    "correspondences": CORRESPONDENCES,
    "tracks": TRACKS,
}


def _table(name: str, version: int, columns: list[pa.Field]) -> None:
    """Declare a table of results."""
    ALL[name] = schema(f"result.{name}", version, columns)


# One row per (robot pair, iteration, aligner, repetition), the estimates joined with the truth.
# The aligner named "oracle" was given the true pairs; it has one repetition.
_table(
    "errors",
    2,
    _fields(
        robot_a=_TEXT,
        robot_b=_TEXT,
        iteration=_INT,
        aligner=_TEXT,
        repetition=_INT,
        status=_TEXT,
        reason=_TEXT,
        translation_error_m=_FLOAT,
        rotation_error_rad=_FLOAT,  # signed: estimate minus truth
        refined_status=_TEXT,
        refined_translation_error_m=_FLOAT,
        refined_rotation_error_rad=_FLOAT,
        accepted=_BOOL,  # the refined alignment, by the test against chance
        log10_false_alarms=_FLOAT,
        oracle_distance_m=_FLOAT,  # refined translation against the oracle's
        oracle_distance_rad=_FLOAT,
        n_correspondences=_INT,
        n_true=_INT,  # true ones among the correspondences
        n_common=_INT,  # landmarks of the two maps that truly correspond
        n_inliers=_INT,
        precision=_FLOAT,  # of the refined inliers
        recall=_FLOAT,
        alignment_nees=_FLOAT,  # of the refined alignment, 3 degrees of freedom
    ),
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

# One row per (robot, iteration); best particle online, anchored at the start, no fit.
_table(
    "robots",
    1,
    _fields(
        robot=_TEXT,
        iteration=_INT,
        path_error_m=_FLOAT,
        path_error_rad=_FLOAT,
        odometry_error_m=_FLOAT,
        odometry_error_rad=_FLOAT,
        effective_sample_size=_FLOAT,
        resampled=_BOOL,
        n_landmarks=_INT,
        spread_m=_FLOAT,  # root of the trace of the particles' weighted position covariance
    ),
)

# Paths in the robot's own frame: the best particle's whole path at the end, the online estimate,
# odometry alone, and the truth.
_table(
    "paths",
    1,
    _fields(
        robot=_TEXT,
        iteration=_INT,
        **{
            f"{source}_{field}": _FLOAT
            for source in ("final", "online", "odometry", "truth")
            for field in ("x_m", "y_m", "theta_rad")
        },
    ),
)

# Particles at the kept iterations, in the robot's own frame.
_table(
    "clouds",
    1,
    _fields(
        robot=_TEXT,
        iteration=_INT,
        particle=_INT,
        x_m=_FLOAT,
        y_m=_FLOAT,
        theta_rad=_FLOAT,
        log_weight=_FLOAT,
    ),
)

# The robots' last maps, each in its own frame; the true point is given in the same frame.
_table(
    "landmarks",
    1,
    [
        pa.field("robot", _TEXT),
        pa.field("landmark", _INT),
        *point_fields(),
        *_fields(count=_INT, truth_x_m=_FLOAT, truth_y_m=_FLOAT, truth_z_m=_FLOAT),
    ],
)

# The fused map in the frame of the first robot. Parents are rows of the robots' last maps.
_table(
    "fused",
    1,
    [
        pa.field("landmark", _INT),
        *point_fields(),
        *_fields(
            n_parents=_INT,
            robot_a=_TEXT,  # first parent
            landmark_a=_INT,
            robot_b=_TEXT,  # second parent, empty when carried over from one map
            landmark_b=_INT,
            truth_x_m=_FLOAT,
            truth_y_m=_FLOAT,
            truth_z_m=_FLOAT,
        ),
    ],
)

# How each robot's last map was moved into the fused map, the first robot's own among them.
_table(
    "fused_motions",
    1,
    _fields(
        robot=_TEXT,
        tx_m=_FLOAT,  # NaN for a map that was left out
        ty_m=_FLOAT,
        theta_rad=_FLOAT,
        drift_sigma_m=_FLOAT,  # as added to the landmarks' covariance, in x and y
        left_out=_TEXT,  # why; empty for a map that was fused
    ),
)

# The robots' maps at each evaluated iteration, in plan, each in its own frame. `landmark` is the
# row of the map at that iteration, which correspondences of that iteration refer to.
_PLAN = _fields(x_m=_SINGLE, y_m=_SINGLE, cov_xx_m2=_SINGLE, cov_xy_m2=_SINGLE, cov_yy_m2=_SINGLE)
_table("map_history", 1, [*_fields(robot=_TEXT, iteration=_INT, landmark=_INT), *_PLAN])

# Landmarks that the merging aligner's inliers joined at that iteration, fused, in robot a's frame.
_table(
    "fused_history",
    1,
    [
        *_fields(robot_a=_TEXT, robot_b=_TEXT, iteration=_INT, landmark_a=_INT, landmark_b=_INT),
        *_PLAN,
    ],
)

# Which of the correspondences are true: one bit each, in their order in `correspondences`.
_table(
    "true_pairs",
    1,
    _fields(
        robot_a=_TEXT, robot_b=_TEXT, iteration=_INT, n_correspondences=_INT, true_pair=pa.binary()
    ),
)

# One row per fused landmark with two parents, per robot pair: was fusing worth it?
_table(
    "fusion",
    1,
    _fields(
        robot_a=_TEXT,
        robot_b=_TEXT,
        landmark_a=_INT,
        landmark_b=_INT,
        error_a_m=_FLOAT,
        error_b_m=_FLOAT,  # moved into frame a by the estimate
        error_fused_m=_FLOAT,
        nees_with_drift=_FLOAT,
        nees_without_drift=_FLOAT,
        degrees_of_freedom=_INT,
        true_pair=_BOOL,
    ),
)

# Per map, after the best rigid fit to the truth; "fused" is the fused map.
_table(
    "map_fits",
    1,
    _fields(map=_TEXT, n_landmarks=_INT, rmse_m=_FLOAT),
)

# Errors of whole paths with evo's seven statistics; see experiments/judge/path_errors.py.
_table(
    "path_statistics",
    1,
    _fields(
        robot=_TEXT,
        source=_TEXT,  # final, online (as in `paths`) or odometry
        quantity=_TEXT,  # ate_m (after the best rigid fit), ate_from_start_m, rpe_m, rpe_rad
        delta=_FLOAT,  # of the relative errors
        delta_unit=_TEXT,  # frames or m
        n=_INT,  # poses, or pairs of poses
        **dict.fromkeys(("rmse", "mean", "median", "std", "min", "max", "sse"), _FLOAT),
    ),
)

# NEES of each map's landmarks, before merging and after; see experiments/judge/consistency.py.
_table(
    "landmark_nees",
    1,
    _fields(
        map=_TEXT,  # a robot, or "fused"
        # own: all of a robot's map; before fusing: those of them that were truly fused;
        # fused: of the merged map, with several parents; carried over: with one
        landmarks=_TEXT,
        n_landmarks=_INT,  # with a known truth
        degrees_of_freedom=_INT,
        nees_mean=_FLOAT,
        nees_median=_FLOAT,
        share_in_gate=_FLOAT,  # of 95 %
    ),
)

_table("timings", 1, _fields(stage=_TEXT, name=_TEXT, elapsed_s=_FLOAT))

# Serial, warmed, repeated: figure 6.
_table(
    "aligner_timings",
    1,
    _fields(
        robot_a=_TEXT,
        robot_b=_TEXT,
        iteration=_INT,
        aligner=_TEXT,
        n_correspondences=_INT,
        n_common=_INT,
        elapsed_s=_FLOAT,  # median of the repeats
        elapsed_low_s=_FLOAT,  # 10th and 90th percentile
        elapsed_high_s=_FLOAT,
    ),
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
