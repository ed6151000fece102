"""Files of a result folder: schemas of its tables, and its JSON files.

The tables are Parquet files in `RESULT/tables/`. Names of columns contain the unit. Rotations are
counter-clockwise. Only `timings` and `aligner_timings` have measured times: all other tables are
bit for bit the same for the same scenario and seed. A column has the same type in all tables.
Columns that are not in `_NAMES` are floats.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pyarrow as pa
from pydantic import BaseModel, ValidationError

from experiments.pipeline import tables
from experiments.pipeline.store import FileEntry, require_unchanged
from experiments.pipeline.tables import CORRESPONDENCES, ESTIMATES, RIVALS, TRACKS
from mapfusion.errors import DamagedFileError, InputError
from mapfusion.files import COVARIANCE_FIELDS, POSITION_FIELDS, read_json, require_version, schema

if TYPE_CHECKING:
    import pandas as pd


# Columns that are not floats.
_NAMES = {
    tables.TEXT: """acceptance_reason aligner check delta_unit fallback finding fuser landmarks
        left_out map name not_smoothed place quantity reason refined_reason refined_status robot
        robot_a robot_b source stage status verdict""",
    tables.INT: """component count degrees_of_freedom frame iteration landmark landmark_a landmark_b
        n n_common n_confirmed n_contradicted n_correspondences n_inliers n_landmarks n_parents
        n_new n_observed n_returned n_robots n_steps n_team n_tracked n_true particle repetition""",
    tables.BOOL: "accepted lower_bound resampled true_pair",
}
# Columns of a floor plan, for figures: single precision takes half the space.
_PLAN = ("x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
_OTHER_TYPES = {
    "map_history": dict.fromkeys(_PLAN, pa.float32()),
    "fused_history": dict.fromkeys(_PLAN, pa.float32()),
    "true_pairs": {"true_pair": pa.binary()},
}
_VERSIONS = {"errors": 6}  # of the others: 1
UNKNOWN = -1  # a count that needs the truth, without truth
_POINT = " ".join(POSITION_FIELDS + COVARIANCE_FIELDS)
_COLUMNS = {
    # One row per (robot pair, iteration, aligner, repetition): estimates compared with the truth.
    # The aligner "oracle" is given the true pairs and has one repetition. rotation_error_rad is
    # signed: estimate minus truth. Columns from verdict to acceptance_reason belong to the refined
    # alignment (mapfusion/verification). oracle_distance: distance of the refined alignment from
    # the oracle's. log10_ratio_passed: log10 of the largest `align.evidence.least_ratio` that the
    # alignment passes, infinite if it passes any. n_true: true pairs among the correspondences.
    # n_common: common landmarks of the maps. precision, recall: of the refined inliers.
    # alignment_nees: NEES of the refined alignment, 3 degrees of freedom. lower_bound: its
    # covariance excludes errors that the landmarks of a map share.
    "errors": """robot_a robot_b iteration aligner repetition status reason
        translation_error_m rotation_error_rad
        refined_status refined_reason refined_translation_error_m refined_rotation_error_rad
        verdict accepted log10_false_alarms log10_evidence log10_ratio_passed
        n_confirmed n_contradicted acceptance_reason oracle_distance_m oracle_distance_rad
        n_correspondences n_true n_common n_inliers precision recall alignment_nees lower_bound""",
    # One row per (robot, iteration): online path of the best particle and odometry, both from the
    # true start without a fit. spread_m: root of the trace of the particles' weighted position
    # covariance. n_landmarks: all landmarks of the best particle, also those that were seen less
    # than `slam.min_count` times.
    "robots": """robot iteration path_error_m path_error_rad odometry_error_m odometry_error_rad
        effective_sample_size resampled n_landmarks spread_m""",
    # One row per (robot, iteration): observations by the final associations of the best particle.
    # n_tracked: those of a track that was seen before. n_new: those that created a landmark.
    # n_returned: those of a landmark that was out of view for a while; see
    # evaluation/loop_closures.py.
    "sightings": "robot iteration n_observed n_tracked n_new n_returned",
    # Paths in the frame of the robot's map. final: path of the best particle at the end. online:
    # estimate at each frame. odometry: odometry alone.
    "paths": """robot iteration final_x_m final_y_m final_theta_rad
        online_x_m online_y_m online_theta_rad odometry_x_m odometry_y_m odometry_theta_rad
        truth_x_m truth_y_m truth_theta_rad""",
    # Times of the frames of `paths`, from the robot's log.
    "frame_times": "robot iteration time_s",
    # Last smoothed map and path of each robot, compared with FastSLAM's (filter_); see
    # evaluation/map_errors.py and map_consistency.py. Paths have the true start and no fit.
    # Landmarks are compared after a rigid fit without gross landmarks, which are counted. Their
    # consistency is computed with the gauge removed. observation_dof, offset_dof: estimated degrees
    # of freedom of the Student t distributions of observations and of tracks' offsets.
    # observation_level: estimated factor of the observations' covariances. not_smoothed: reason
    # why smoothing failed and the map that is used instead; else empty.
    "smoother": """robot n_landmarks path_rmse_m filter_path_rmse_m filter_over_smoother
        landmark_rmse_m gross_share filter_landmark_rmse_m filter_gross_share
        nees_per_dof marginal_nees_per_dof coverage_95
        n_steps observation_dof offset_dof observation_level not_smoothed""",
    # Contradictions in each robot's log, see datasets/log_consistency.py. check: odometry (as a
    # whole), truth, jump (a single increment, which is not used) or gate (most observations are
    # outside the gate of their landmark). iteration: frame of a jump, else -1.
    "findings": "robot check iteration finding",
    # Smoothed paths in the frame of the robot's map, until each iteration with a fusion.
    "smoothed_paths": "robot iteration frame x_m y_m theta_rad",
    # Particles at the stored iterations, in the frame of the robot's map.
    "clouds": "robot iteration particle x_m y_m theta_rad log_weight",
    # Last maps of the robots with true points, each in its own frame.
    "landmarks": f"robot landmark {_POINT} count truth_x_m truth_y_m truth_z_m",
    # The last maps, fused by the fuser of the paper (kalman-drift, eq. 12 to 16 with drift), in the
    # frame of the first robot in the fused map. landmark_a, landmark_b: rows of the parents in the
    # robots' last maps. robot_b is empty for a landmark of one map.
    "fused": f"""landmark {_POINT} n_parents robot_a landmark_a robot_b landmark_b
        truth_x_m truth_y_m truth_z_m""",
    # The last maps, fused by `merge.fuser`. landmark_a, landmark_b: rows of the maps that the fuser
    # was given, filtered or smoothed.
    "fused_map": f"""landmark {_POINT} n_parents robot_a landmark_a robot_b landmark_b
        truth_x_m truth_y_m truth_z_m""",
    # One row per (fuser, iteration): errors of the fused map of the most robots; see
    # evaluation/map_errors.py and map_consistency.py. landmark_rmse_m: in the frame of the
    # first robot in the map. fitted: after a rigid fit. Gross landmarks are counted and left out.
    # over_better_parent: error of common landmarks of two robots over the error of the better of
    # their maps that the fuser was given. over_better_filter: likewise for FastSLAM's maps. Each
    # map is fitted separately; medians over pairs of robots. nees_per_dof (all landmarks together),
    # marginal_nees_per_dof and coverage_95: with the gauge removed. Only the last map of a fuser
    # has a joint covariance; errors of other maps are taken to be independent. frame_: in the frame
    # of the map, of single landmarks. alignment_: medians of the motions of the other robots' maps;
    # sigma: standard deviations by the covariance, see se2.motion_sigma. fallback: simpler fuser or
    # other map that was used, with the reason; else empty.
    "fusers": """fuser iteration n_robots n_landmarks landmark_rmse_m fitted_rmse_m fitted_median_m
        gross_share over_better_parent over_better_filter
        nees_per_dof marginal_nees_per_dof coverage_95 frame_nees_per_dof frame_coverage_95
        alignment_error_m alignment_error_rad alignment_sigma_m alignment_sigma_rad
        alignment_nees_per_dof duplicate_share fallback""",
    # Share of true points inside the ellipses of a nominal probability, at the last iteration. map:
    # fused (of a fuser), or filter or smoothed (before fusion, of all robots, fuser empty).
    # coverage: after a rigid fit of each map, with the gauge removed. frame_coverage: in the frame
    # of the map. n_landmarks: number of landmarks, without gross ones.
    "fuser_coverage": "map fuser iteration n_landmarks nominal coverage frame_coverage",
    # Role of the alignment of each robot pair in the team: confirmed by a loop of other alignments,
    # bridge (used without confirmation), contradicted, ambiguous, unconfirmed or refused.
    "team_edges": "robot_a robot_b place",
    # One row per robot pair. refined_: error of the last alignment of the merging aligner, as in
    # `errors`. team_: error of T_a_b in the fused map; NaN for robots in different maps.
    "team_pairs": """robot_a robot_b place accepted n_common
        refined_translation_error_m refined_rotation_error_rad
        team_translation_error_m team_rotation_error_rad""",
    # ATE of the n_robots of a fused map, of n_team robots of the run: paths are moved as the maps
    # were, then all together by one rigid fit. component: 1 for the fused map of most robots.
    # source: as in `path_statistics`; a fuser of smoothed maps moves smoothed paths. n: number of
    # poses.
    "team": "component source n_robots n_team n rmse mean median std min max sse",
    # Motion of each robot's last map into the fused map. left_out: reason why a map is not in the
    # fused map (the motion is NaN), else empty. drift_sigma_m: standard deviation that was added to
    # the landmarks in x and y.
    "fused_motions": "robot tx_m ty_m theta_rad drift_sigma_m left_out",
    # Maps at each evaluated iteration in plan view, each in its own frame. landmark: row of the map
    # at that iteration, as in `correspondences`.
    "map_history": " ".join(("robot iteration landmark", *_PLAN)),
    # Fused inliers of the merging aligner at each iteration, in the frame of robot a.
    "fused_history": " ".join(("robot_a robot_b iteration landmark_a landmark_b", *_PLAN)),
    # One bit for each row of `correspondences`, in its order: 1 for true pairs.
    "true_pairs": "robot_a robot_b iteration n_correspondences true_pair",
    # One row per robot pair and fused landmark with two parents: errors before and after fusion.
    # error_b_m: after the motion into frame a by the estimate.
    "fusion": """robot_a robot_b landmark_a landmark_b error_a_m error_b_m error_fused_m
        nees_with_drift nees_without_drift degrees_of_freedom true_pair""",
    # RMSE of each robot's map and of the fused map ("fused"), after a rigid fit to the truth.
    "map_fits": "map n_landmarks rmse_m",
    # Errors of whole paths with evo's seven statistics; see experiments/evaluation/path_errors.py.
    # source: final, online (as in `paths`), odometry or smoothed. quantity: ate_m (after a rigid
    # fit), ate_from_start_m (without a fit), rpe_m or rpe_rad (over delta frames or m). n: number
    # of poses or of pairs of poses.
    "path_statistics": """robot source quantity delta delta_unit n
        rmse mean median std min max sse""",
    # NEES of the landmarks of each map (a robot or "fused"), before and after fusion; see
    # evaluation/fused_landmarks.py. landmarks: own (all landmarks of a robot), before fusing (those
    # that were fused with the same true point), fused (several parents) or carried over (one
    # parent). n_landmarks: landmarks with a known true point. share_in_gate: share in the 95 %
    # gate.
    "landmark_nees": """map landmarks n_landmarks degrees_of_freedom
        nees_mean nees_median share_in_gate""",
    # Times of stages, and of parts of the run outside stages (start, tables, timing the aligners,
    # figures).
    "timings": "stage name elapsed_s",
    # Times of aligners, one after the other and after a warm-up call, for figure 6: median, 10th
    # and 90th percentile of the repetitions. n_common is -1 without truth.
    "aligner_timings": """robot_a robot_b iteration aligner n_correspondences n_common
        elapsed_s elapsed_low_s elapsed_high_s""",
}


ALL = {"estimates": ESTIMATES, "correspondences": CORRESPONDENCES, "rivals": RIVALS}
ALL |= {"tracks": TRACKS}
_TYPES = {column: kind for kind, names in _NAMES.items() for column in names.split()}
for _name, _columns in _COLUMNS.items():
    _own = dict.fromkeys(_columns.split(), tables.FLOAT)
    _own |= {column: _TYPES[column] for column in _own if column in _TYPES}
    _fields = tables.fields(**(_own | _OTHER_TYPES.get(_name, {})))
    ALL[_name] = schema(f"result.{_name}", _VERSIONS.get(_name, 1), _fields)
# Alignments of smoothed maps, at the iterations at which maps are fused.
for _name in ("estimates", "errors"):
    ALL[f"smoothed_{_name}"] = schema(f"result.smoothed_{_name}", 1, list(ALL[_name]))


class Shown(NamedTuple):
    """Presentation of a column of `errors` on screens and in reports, one value for each method.

    Attributes:
        label: header; a line break separates its two lines.
        layout: format of the value.
        kind: `error`: median absolute error over answerable pairs, infinite for missing estimates;
            `given`: share of estimates; `share`: mean over pairs with common ground.
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
    """Return the path of a table in a result folder."""
    return result / "tables" / f"{name}.parquet"


def as_table(name: str, rows: pd.DataFrame | list[dict[str, Any]]) -> pd.DataFrame:
    """Return rows as a DataFrame with the columns of a table; other columns are dropped."""
    import pandas as pd

    return pd.DataFrame(rows if len(rows) else [], columns=pd.Index(ALL[name].names))


def write(path: Path, name: str, rows: pd.DataFrame | list[dict[str, Any]]) -> None:
    """Write rows as a table."""
    tables.write_rows(path, ALL[name], as_table(name, rows))


def read(path: Path, name: str) -> pd.DataFrame:
    """Read a table; raise InputError with the name of the file."""
    return tables.read_rows(path, ALL[name])


def work_by_stage(timings: pd.DataFrame) -> pd.DataFrame:
    """Return seconds of work and the number of tasks by stage, from rows of `timings`.

    A task that several runs share counts once. Columns: `stage`, `seconds`, `tasks`.
    """
    works = timings[timings["name"].str.endswith(":elapsed_s")].drop_duplicates(["stage", "name"])
    stages = works.groupby("stage", sort=False)["elapsed_s"]
    return stages.agg(seconds="sum", tasks="count").reset_index()


RESULT_SCHEMA_VERSION = 1


class _ResolvedScenario(BaseModel):
    name: str
    seed: int
    description: str = ""
    expect: dict[str, dict[str, float | None]] = {}
    merge: dict[str, Any] = {}


class _World(BaseModel):
    walls: list[list[tuple[float, float]]] = []
    robots: dict[str, tuple[float, float, float]] = {}


class _Provenance(BaseModel):
    stages: dict[str, Any] = {}
    tables: list[str] = []
    files: dict[str, FileEntry] = {}  # empty in results of earlier versions
    libraries: dict[str, str] = {}


def read_scenario(path: Path) -> dict[str, Any]:
    """Return `scenario.json` of a result; raises DamagedFileError."""
    return _checked(path, "resolved scenario", _ResolvedScenario)


def read_world(path: Path) -> dict[str, Any]:
    """Return `world.json` of a result; raises DamagedFileError."""
    return _checked(path, "world of a result", _World)


def read_provenance(path: Path) -> dict[str, Any]:
    """Return `provenance.json` of a result; raises DamagedFileError."""
    return _checked(path, "provenance of a result", _Provenance)


def require_tables(result: Path) -> None:
    """Raise InputError if a table is missing that the run wrote into its result folder.

    Results of earlier versions do not list their tables.
    """
    path = result / "provenance.json"
    written = read_provenance(path).get("tables", ()) if path.is_file() else ()
    gone = [name for name in written if not table_path(result, name).is_file()]
    if gone:
        others = f" (and {len(gone) - 1} more)" if len(gone) > 1 else ""
        remedy = "put it back, or run the scenario again"
        missing = table_path(result, gone[0])
        raise InputError(f"{missing}: is missing{others}, but the run wrote it; {remedy}")


def require_as_written(result: Path) -> None:
    """Raise DamagedFileError if a table, map or JSON file was changed after the run."""
    path = result / "provenance.json"
    if path.is_file():
        require_unchanged(result, _Provenance.model_validate(read_provenance(path)).files)


def _checked(path: Path, what: str, model: type[BaseModel]) -> dict[str, Any]:
    content = read_json(path, what)
    require_version(path, content, RESULT_SCHEMA_VERSION)
    try:
        model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise DamagedFileError(path, f"{field}: {first['msg']} (expected a {what})") from error
    return content
