"""Schemas of the result tables: what the figures, the checks and other people's scripts read.

All are Parquet, in `RESULT/tables/`. Units are in the names; rotations are counter-clockwise.
`elapsed_s` columns live in `timings` and `aligner_timings` alone: every other table is the same,
bit for bit, whenever the scenario and the seed are.
"""

from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from experiments.run.frames import BOOL as _BOOL
from experiments.run.frames import FLOAT as _FLOAT
from experiments.run.frames import INT as _INT
from experiments.run.frames import TEXT as _TEXT
from experiments.run.frames import fields as _fields
from experiments.run.frames import read_rows, write_rows
from experiments.run.stage_tables import CORRESPONDENCES, ESTIMATES, TRACKS
from mapfusion.storage import point_fields, schema

_SINGLE = pa.float32()  # for looking at, not for computing with: hundreds of maps, half the size


# One row per (robot pair, iteration, aligner, repetition), the estimates joined with the truth.
# The aligner named "oracle" was given the true pairs; it has one repetition.
ERRORS = schema(
    "result.errors",
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

# One row per (robot, iteration); best particle online, anchored at the start, no fit.
ROBOTS = schema(
    "result.robots",
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
PATHS = schema(
    "result.paths",
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
CLOUDS = schema(
    "result.clouds",
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
LANDMARKS = schema(
    "result.landmarks",
    1,
    [
        pa.field("robot", _TEXT),
        pa.field("landmark", _INT),
        *point_fields(),
        *_fields(count=_INT, truth_x_m=_FLOAT, truth_y_m=_FLOAT, truth_z_m=_FLOAT),
    ],
)

# The fused map in the frame of the first robot. Parents are rows of the robots' last maps.
FUSED = schema(
    "result.fused",
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

# The robots' maps at each evaluated iteration, in plan, each in its own frame. `landmark` is the
# row of the map at that iteration, which correspondences of that iteration refer to.
_PLAN = _fields(x_m=_SINGLE, y_m=_SINGLE, cov_xx_m2=_SINGLE, cov_xy_m2=_SINGLE, cov_yy_m2=_SINGLE)
MAP_HISTORY = schema(
    "result.map_history", 1, [*_fields(robot=_TEXT, iteration=_INT, landmark=_INT), *_PLAN]
)

# Landmarks that the merging aligner's inliers joined at that iteration, fused, in robot a's frame.
FUSED_HISTORY = schema(
    "result.fused_history",
    1,
    [
        *_fields(robot_a=_TEXT, robot_b=_TEXT, iteration=_INT, landmark_a=_INT, landmark_b=_INT),
        *_PLAN,
    ],
)

# Which of the correspondences are true: one bit each, in their order in `correspondences`.
TRUE_PAIRS = schema(
    "result.true_pairs",
    1,
    _fields(
        robot_a=_TEXT, robot_b=_TEXT, iteration=_INT, n_correspondences=_INT, true_pair=pa.binary()
    ),
)

# One row per fused landmark with two parents, per robot pair: was fusing worth it?
FUSION = schema(
    "result.fusion",
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
MAP_FITS = schema(
    "result.map_fits",
    1,
    _fields(map=_TEXT, n_landmarks=_INT, rmse_m=_FLOAT),
)

# Errors of whole paths with evo's seven statistics; see experiments/judge/path_errors.py.
PATH_STATISTICS = schema(
    "result.path_statistics",
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
LANDMARK_NEES = schema(
    "result.landmark_nees",
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

TIMINGS = schema("result.timings", 1, _fields(stage=_TEXT, name=_TEXT, elapsed_s=_FLOAT))

# Serial, warmed, repeated: figure 6.
ALIGNER_TIMINGS = schema(
    "result.aligner_timings",
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

ALL = {
    "estimates": ESTIMATES,
    "correspondences": CORRESPONDENCES,
    "errors": ERRORS,
    "robots": ROBOTS,
    "paths": PATHS,
    "clouds": CLOUDS,
    "landmarks": LANDMARKS,
    "fused": FUSED,
    "map_history": MAP_HISTORY,
    "fused_history": FUSED_HISTORY,
    "true_pairs": TRUE_PAIRS,
    "fusion": FUSION,
    "map_fits": MAP_FITS,
    "path_statistics": PATH_STATISTICS,
    "landmark_nees": LANDMARK_NEES,
    "tracks": TRACKS,
    "timings": TIMINGS,
    "aligner_timings": ALIGNER_TIMINGS,
}


def table_path(result: Path, name: str) -> Path:
    """Where a result folder keeps the table of that name."""
    return result / "tables" / f"{name}.parquet"


def write(path: Path, name: str, rows: pd.DataFrame | list[dict[str, Any]]) -> None:
    """Write rows as the table of that name."""
    write_rows(path, ALL[name], rows)


def read(path: Path, name: str) -> pd.DataFrame:
    """Read the table of that name; raises InputError that names the file."""
    return read_rows(path, ALL[name])
