"""Errors of paths at each frame, and absolute and relative ones with evo's seven statistics.

ATE and RPE as Sturm et al. (2012) define them, in the plane; numbers equal evo's (its `evo_ape -a`
and `evo_rpe --pairs_from_reference`), which the tests hold them to.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.truth import PathTruth
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.files import POSE_FIELDS
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float

SMOOTHED = "smoothed"  # a path that not every robot has
SOURCES = ("final", "online", "odometry", SMOOTHED)
# From frame to frame, and along a metre of the way: what a filter step and a short drive add.
RPE_DELTA = 1
STATISTICS: dict[str, Callable[[Float], float]] = {
    "rmse": lambda errors: np.sqrt(np.mean(errors**2)),
    **{of.__name__: of for of in (np.mean, np.median, np.std, np.min, np.max)},
    "sse": lambda errors: np.sum(errors**2),
}


def seven_statistics(errors: Float) -> dict[str, float]:
    """Evo's statistics of errors (N,); NaN where there is none. `std` is the population's."""
    return {name: of(errors) if len(errors) else np.nan for name, of in STATISTICS.items()}


def rms(values: pd.Series) -> float:
    """Root mean square of what is known; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values.dropna())))) if values.notna().any() else np.nan


def path_rms(robots: pd.DataFrame, by: Sequence[str] = ("robot",)) -> pd.DataFrame:
    """RMS position errors over a run, of FastSLAM's online path and of odometry alone.

    `by` names a robot of a run. Columns: those of `by`; path_m, odometry_m, over_odometry (their
    ratio); n_landmarks at the end and n_frames.
    """
    groups = robots.groupby(list(by), sort=False)
    path_m, odometry_m = (groups[f"{of}_error_m"].agg(rms) for of in ("path", "odometry"))
    found = {"path_m": path_m, "odometry_m": odometry_m, "n_frames": groups.size()}
    found |= {"over_odometry": path_m / odometry_m.where(odometry_m > 0)}
    if "n_landmarks" in robots:
        found |= {"n_landmarks": groups["n_landmarks"].last()}
    return pd.DataFrame(found).reset_index()


def ate_m(path: Float, truth: Float, fit: bool = True) -> Float:
    """Distances (N,) of a path's positions to the true ones; both are poses (N, 3), all known.

    A fit moves the path onto the truth first by the least-squares motion without scale (Umeyama
    1991; in the plane the closed form of `fit_rigid`). Without it both start where they start.
    """
    positions = path[:, :2]
    if fit and len(path) > 1:
        T_truth_path = np.array(fit_rigid(truth[:, :2], positions, np.arange(len(path))))
        positions = se2.transform_points(T_truth_path, positions)
    return np.linalg.norm(positions - truth[:, :2], axis=1)


def rpe(path: Float, truth: Float, pairs: np.ndarray) -> tuple[Float, Float]:
    """Relative pose errors of pairs of poses: lengths (P,) in m and angles (P,) in rad.

    E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Sturm et al. (2012), eq. 2, of a path P (N, 3) and the truth Q
    (N, 3); pairs (P, 2) are rows i and j of both.
    """
    i, j = pairs.T
    error = se2.between(se2.between(truth[i], truth[j]), se2.between(path[i], path[j]))
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def pairs_by_frames(known: np.ndarray, delta: int) -> np.ndarray:
    """Rows (P, 2) that are `delta` frames apart and follow on each other, both of them known.

    Rows count the `known` (T,) poses only, frames count all.
    """
    first = np.arange(0, len(known) - delta, delta)
    row = np.cumsum(known) - 1
    both = known[first] & known[first + delta]
    return np.stack([row[first[both]], row[first[both] + delta]], axis=1)


def pairs_by_length(positions_m: Float, delta_m: float) -> np.ndarray:
    """Rows (P, 2) between which the way is at least `delta_m` long, one after the other."""
    ends, gone = [0], 0.0
    for row, step in enumerate(np.linalg.norm(np.diff(positions_m, axis=0), axis=1), start=1):
        gone += step
        if gone >= delta_m:
            ends.append(row)
            gone = 0.0
    return np.array([ends[:-1], ends[1:]], dtype=np.int64).T


def robot_paths(poses: pd.DataFrame, odometry: Float, truth: PathTruth) -> pd.DataFrame:
    """Rows of the tables `paths` and `robots` of one robot, from what the SLAM stage tells.

    Odometry (T, 3) are the motions from frame to frame.
    """
    dead_reckoned = np.array([*accumulate(odometry[1:], se2.compose, initial=np.zeros(3))])
    rows = poses.copy()
    for source, values in (("odometry", dead_reckoned), ("truth", truth.T_map_robot)):
        rows[[f"{source}_{name}" for name in POSE_FIELDS]] = values[: len(rows)]
    for source, path in (("path", "online"), ("odometry", "odometry")):
        x, y, turn = (rows[f"{path}_{name}"] - rows[f"truth_{name}"] for name in POSE_FIELDS)
        rows[f"{source}_error_m"], rows[f"{source}_error_rad"] = np.hypot(x, y), se2.wrap(turn)
    return rows


def path_statistics_rows(paths: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of the table `path_statistics` from those of the table `paths`.

    These may have a smoothed path beside the columns of the table.
    """
    rows = []
    for robot, own in paths.groupby("robot", sort=False):
        all_poses = {
            source: own[[f"{source}_{name}" for name in POSE_FIELDS]].to_numpy()
            for source in (*SOURCES, "truth")
            if f"{source}_{POSE_FIELDS[0]}" in own
            and own[f"{source}_{POSE_FIELDS[0]}"].notna().any()
        }
        truth = all_poses.pop("truth", np.full((len(own), 3), np.nan))
        known = np.asarray(np.isfinite(truth).all(axis=1))
        truth = truth[known]
        for source in all_poses:
            for quantity, delta, unit, errors in _errors(all_poses[source][known], truth, known):
                what = {"quantity": quantity, "delta": delta, "delta_unit": unit, "n": len(errors)}
                rows.append({"robot": robot, "source": source} | what | seven_statistics(errors))
    return rows


def _errors(
    path: Float, truth: Float, known: np.ndarray
) -> Iterator[tuple[str, float, str, Float]]:
    """What is measured of one path, over how many of which unit, and the errors."""
    yield "ate_m", np.nan, "", ate_m(path, truth)
    yield "ate_from_start_m", np.nan, "", ate_m(path, truth, fit=False)
    by_frames, along = pairs_by_frames(known, RPE_DELTA), pairs_by_length(truth[:, :2], RPE_DELTA)
    for unit, pairs in (("frames", by_frames), ("m", along)):
        length_m, angle_rad = rpe(path, truth, pairs)
        yield "rpe_m", RPE_DELTA, unit, length_m
        yield "rpe_rad", RPE_DELTA, unit, angle_rad
