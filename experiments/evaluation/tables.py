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
        event left_out map name not_smoothed other place quantity reason receiver refined_reason
        refined_status robot robot_a robot_b sender source stage status verdict""",
    tables.INT: """component count degrees_of_freedom frame iteration landmark landmark_a landmark_b
        n n_adopted n_bytes n_common n_confirmed n_contradicted n_correspondences n_inliers
        n_landmarks n_parents n_new n_observed n_returned n_robots n_steps n_team n_tracked n_true
        particle repetition""",
    tables.BOOL: "accepted lost lower_bound resampled true_pair",
}
# Columns of a floor plan, for figures: single precision takes half the space.
_PLAN = ("x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
_OTHER_TYPES = {
    "map_history": dict.fromkeys(_PLAN, pa.float32()),
    "fused_history": dict.fromkeys(_PLAN, pa.float32()),
    "true_pairs": {"true_pair": pa.binary()},
}
_VERSIONS = {"errors": 6, "smoothed_paths": 2}  # of the others: 1
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
    "smoothed_paths": """robot iteration frame x_m y_m theta_rad
        cov_xx cov_xy cov_xt cov_yy cov_yt cov_tt""",
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
    # What robots adopt that exchange maps while they drive (`team` in the scenario). event: on
    # trial (accepted once), adopted, kept (adopted, but not accepted at this exchange), dropped, or
    # not smoothed (the robot's own log; it neither sends nor merges).
    # The motion is the pose of the other robot's map in that of the robot.
    "adoptions": """robot iteration other event tx_m ty_m theta_rad
        cov_xx cov_xy cov_xt cov_yy cov_yt cov_tt translation_error_m rotation_error_rad reason""",
    # One row per (robot, iteration) of these robots. alone_: filter of the independent robot.
    # merged_: poses since the first adoption. landmark_rmse_m to frame_coverage_95: landmarks that
    # another robot observed first, in the frame of the robot's map, without gross ones, which are
    # counted.
    # shared_share: share of the observations since then that were assigned to landmarks that other
    # robots mapped, too.
    "team_members": """robot iteration path_rmse_m alone_path_rmse_m merged_path_rmse_m
        alone_merged_path_rmse_m smoothed_path_rmse_m n_landmarks n_adopted landmark_rmse_m
        gross_share frame_nees_per_dof frame_coverage_95 shared_share sent_kb""",
    # Messages of these robots. n_landmarks: landmarks in the message; n_new: those that the
    # receiver does not have. arrives_s: infinite for lost messages.
    "messages": "iteration sender receiver n_bytes n_landmarks n_new arrives_s lost",
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

# Meaning of each column, for the reference. Units are in the names of the columns.
MEANING = {
    # Keys of a row
    "robot": "name of the robot",
    "robot_a": "first robot; T_a_b is the pose of b's map in the frame of a's map",
    "robot_b": "second robot",
    "iteration": "frame at which the maps end, from 0",
    "frame": "frame of the pose, from 0",
    "aligner": "name of the aligner; oracle: the one that is given the true pairs",
    "repetition": "number of the call of a randomised aligner on the same maps",
    "fuser": "name of the fuser",
    "landmark": "row of the landmark in its map",
    "landmark_a": "row in robot_a's map of the parent",
    "landmark_b": "row in robot_b's map of the parent",
    "particle": "number of the particle",
    "component": "fused map; 1 has the most robots",
    "map": "map of a robot, or fused; fuser_coverage: filter, smoothed or fused",
    "source": "path: final, online, odometry or smoothed",
    # An alignment
    "n_correspondences": "correspondences that the aligner was given",
    "status": "accepted, refused, degenerate, failed or absent, as estimated",
    "reason": "why the estimate is not accepted",
    "tx_m": "translation of T_a_b along x",
    "ty_m": "translation of T_a_b along y",
    "theta_rad": "rotation, counter-clockwise",
    "refined_status": "status after the least-squares refinement",
    "refined_reason": "why the refined estimate is not accepted",
    "refined_tx_m": "refined translation along x",
    "refined_ty_m": "refined translation along y",
    "refined_theta_rad": "refined rotation, counter-clockwise",
    "verdict": "accepted, refused, ambiguous or too_uncertain",
    "accepted": "whether the verdict accepts the refined alignment",
    "log10_false_alarms": "log10 of the number of alignments with as much support by chance",
    "log10_evidence": "log10 likelihood ratio of the regions that both robots must have seen",
    "log10_ratio_passed": "log10 of the largest align.evidence.least_ratio that would accept it",
    "n_confirmed": "number of these regions that are in both maps",
    "n_contradicted": "number of these regions that are missing from one map",
    "acceptance_reason": "why the verdict does not accept",
    "drift_sigma_m": "s_drift: standard deviation of residuals beyond the stated covariances",
    "cov_xx": "variance of tx (m2), of the refined T_a_b; smoothed_paths: of the pose",
    "cov_xy": "covariance of tx and ty (m2)",
    "cov_xt": "covariance of tx and theta (m rad)",
    "cov_yy": "variance of ty (m2)",
    "cov_yt": "covariance of ty and theta (m rad)",
    "cov_tt": "variance of theta (rad2)",
    "lower_bound": "whether the covariance omits errors that the landmarks of a map share",
    "inliers": "one bit per correspondence: supports the estimate",
    "refined_inliers": "one bit per correspondence: supports the refined estimate",
    # Errors of an alignment
    "translation_error_m": "distance of the estimated and the true translation",
    "rotation_error_rad": "estimated minus true rotation",
    "refined_translation_error_m": "translation error after refinement",
    "refined_rotation_error_rad": "rotation error after refinement",
    "oracle_distance_m": "distance of the refined translation from the oracle's",
    "oracle_distance_rad": "absolute difference of the refined rotation from the oracle's",
    "n_true": "true pairs among the correspondences",
    "n_common": "landmarks of both maps that are the same point; -1 without truth",
    "n_inliers": "refined inliers",
    "precision": "share of true pairs among the refined inliers",
    "recall": "share of the true pairs that are refined inliers",
    "alignment_nees": "NEES of the refined T_a_b, 3 degrees of freedom",
    # Correspondences and rivals
    "index_a": "row in the map of robot_a",
    "index_b": "row in the map of robot_b",
    "descriptor_distance": "distance of the descriptors",
    "of": "maps that the motion aligns: both, or one with itself",
    "n_support": "correspondences that support the motion",
    "n_regions": "number of regions that both robots must have seen under the motion",
    "own_share": "share of regions that a wrong motion confirms, where no other motion fits",
    "copied_share": "share of regions that a wrong motion confirms, where another motion fits",
    "region_m": "side of a region",
    "copied_a": "one bit per landmark of map a: the motion maps it to a similar one",
    "copied_b": "one bit per landmark of map b: the motion maps it to a similar one",
    "true_pair": "whether both landmarks are the same point; true_pairs: a bit per correspondence",
    # Images
    "track": "number of the track",
    "length": "frames of the track so far",
    "u_px": "column in the left image",
    "v_px": "row in the left image",
    # Paths and filter
    "path_error_m": "position error of the best particle's online path",
    "path_error_rad": "heading error of the best particle's online path",
    "odometry_error_m": "position error of the odometry alone",
    "odometry_error_rad": "heading error of the odometry alone",
    "effective_sample_size": "1 over the sum of squared weights",
    "resampled": "whether the particles were resampled after this frame",
    "spread_m": "root of the trace of the particles' position covariance",
    "n_observed": "observations of the frame",
    "n_tracked": "observations of a track that was seen before",
    "n_new": "observations that created a landmark; messages: landmarks new to the receiver",
    "n_returned": "observations of a landmark that was out of view for a while",
    "log_weight": "logarithm of the normalised weight",
    "time_s": "time of the frame",
    **{
        f"{path}_{axis}": f"{about}, {quantity}"
        for path, about in (
            ("final", "path of the best particle at the end"),
            ("online", "estimate at each frame"),
            ("odometry", "odometry alone"),
        )
        for axis, quantity in (("x_m", "x"), ("y_m", "y"), ("theta_rad", "heading"))
    },
    "truth_x_m": "true x",
    "truth_y_m": "true y",
    "truth_z_m": "true z",
    "truth_theta_rad": "true heading",
    "quantity": "error: ate_m, ate_from_start_m, rpe_m or rpe_rad",
    "delta": "length of the relative poses; 0 for absolute errors",
    "delta_unit": "unit of delta: frames or m",
    "n": "number of poses, or of pairs of poses",
    "rmse": "root mean square of the errors",
    "mean": "mean of the errors",
    "median": "median of the errors",
    "std": "standard deviation of the errors",
    "min": "smallest error",
    "max": "largest error",
    "sse": "sum of squared errors",
    "n_robots": "robots in the fused map",
    "n_team": "robots of the run",
    # Smoother and findings
    "path_rmse_m": "RMS position error without a fit, of the smoothed path; team_members: filter's",
    "filter_path_rmse_m": "RMS position error of the filter's path",
    "filter_over_smoother": "ratio of the two",
    "filter_landmark_rmse_m": "RMS landmark error of the filter's map, after a rigid fit",
    "filter_gross_share": "share of gross landmarks in the filter's map",
    "n_steps": "Gauss-Newton steps",
    "observation_dof": "estimated degrees of freedom of the observations' Student t distribution",
    "offset_dof": "the same of the offsets of tracks",
    "observation_level": "estimated factor of the observations' covariances",
    "not_smoothed": "why the log could not be smoothed, and which map stands in; else empty",
    "check": "what was checked: odometry, truth, jump, gate or direction",
    "finding": "what was found, in words",
    # Robots that exchange maps
    "other": "robot whose map it is",
    "event": "on trial, adopted, kept, dropped or not smoothed",
    "alone_path_rmse_m": "RMS position error of the independent robot's path",
    "merged_path_rmse_m": "RMS position error of the poses since the first adoption",
    "alone_merged_path_rmse_m": "the same of the independent robot",
    "smoothed_path_rmse_m": "RMS position error of the smoothed path of the robot's own log",
    "n_adopted": "landmarks that another robot observed first",
    "shared_share": "share of observations of landmarks that other robots mapped, since adoption",
    "sent_kb": "kilobytes that the robot has sent",
    "sender": "robot that sends",
    "receiver": "robot that receives",
    "n_bytes": "size of the message",
    "arrives_s": "time of arrival; infinite if lost",
    "lost": "whether the message is lost",
    # Landmarks and fused maps
    "x_m": "position along x",
    "y_m": "position along y",
    "z_m": "position along z",
    "cov_xx_m2": "variance of x",
    "cov_xy_m2": "covariance of x and y",
    "cov_xz_m2": "covariance of x and z",
    "cov_yy_m2": "variance of y",
    "cov_yz_m2": "covariance of y and z",
    "cov_zz_m2": "variance of z",
    "count": "number of observations",
    "n_parents": "landmarks of robots' maps that were fused into it",
    "n_landmarks": "number of landmarks; of maps with truth, those that are compared",
    "landmark_rmse_m": "RMS landmark error after a rigid fit; fusers, team_members: in the frame",
    "fitted_rmse_m": "RMS landmark error after a rigid fit",
    "fitted_median_m": "median landmark error after a rigid fit",
    "rmse_m": "RMS landmark error after a rigid fit",
    "gross_share": "share of landmarks with gross errors, which are left out",
    "over_better_parent": "error of common landmarks over that of the better given map",
    "over_better_filter": "the same over the better of the filter's maps",
    "nees_per_dof": "NEES of all landmarks together per degree of freedom, gauge removed",
    "marginal_nees_per_dof": "mean NEES of single landmarks per degree of freedom, gauge removed",
    "coverage_95": "share of true points in the 95 % ellipses, gauge removed",
    "frame_nees_per_dof": "mean NEES of single landmarks in the frame of the map",
    "frame_coverage_95": "share of true points in the 95 % ellipses, in the frame of the map",
    "alignment_error_m": "translation error of the robots' maps in the fused map, median",
    "alignment_error_rad": "rotation error of the same, median",
    "alignment_sigma_m": "stated standard deviation of the translation, median",
    "alignment_sigma_rad": "stated standard deviation of the rotation, median",
    "alignment_nees_per_dof": "NEES of the motions per degree of freedom, median",
    "duplicate_share": "share of landmarks that are in the map twice",
    "fallback": "simpler fuser or other map that stands in, with the reason; else empty",
    "nominal": "probability of the ellipses",
    "coverage": "share of true points in the ellipses, gauge removed",
    "frame_coverage": "share of true points in the ellipses, in the frame of the map",
    "place": "role in the team: confirmed, bridge, contradicted, ambiguous, unconfirmed or refused",
    "team_translation_error_m": "translation error of T_a_b in the fused map",
    "team_rotation_error_rad": "rotation error of T_a_b in the fused map",
    "left_out": "why the robot's map is not in the fused map; else empty",
    "error_a_m": "error of the landmark in robot_a's map",
    "error_b_m": "error in robot_b's map, moved into frame a by the estimate",
    "error_fused_m": "error of the fused landmark",
    "nees_with_drift": "NEES of the fused landmark with s_drift",
    "nees_without_drift": "NEES of the fused landmark without s_drift",
    "degrees_of_freedom": "degrees of freedom of the NEES",
    "landmarks": "which landmarks: own, before fusing, fused or carried over",
    "nees_mean": "mean NEES",
    "nees_median": "median NEES",
    "share_in_gate": "share of NEES in the 95 % gate",
    # Times
    "stage": "stage, or part of the run outside the stages",
    "name": "key of the stage and what was timed",
    "elapsed_s": "time; aligner_timings: median of the repetitions",
    "elapsed_low_s": "10th percentile of the repetitions",
    "elapsed_high_s": "90th percentile of the repetitions",
}


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
