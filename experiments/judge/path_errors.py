"""Absolute and relative errors of paths, with the seven statistics that evo reports.

ATE and RPE as Sturm et al. (2012) define them, in the plane; numbers equal evo's (its `evo_ape -a`
and `evo_rpe --pairs_from_reference`), which the tests hold them to.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from mapfusion import se2
from mapfusion.align.rigid import fit_rigid
from mapfusion.se2 import Float

SOURCES = ("final", "online", "odometry")
_POSE = ("x_m", "y_m", "theta_rad")
# From frame to frame, and along a metre of the way: what a filter step and a short drive add.
RPE_DELTAS = ((1.0, "frames"), (1.0, "m"))
STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")


def seven_statistics(errors: Float) -> dict[str, float]:
    """Evo's statistics of errors (N,); NaN where there is none. `std` is the population's."""
    if not len(errors):
        return dict.fromkeys(STATISTICS, np.nan)
    squared = errors**2
    return {
        "rmse": float(np.sqrt(squared.mean())),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "std": float(errors.std()),
        "min": float(errors.min()),
        "max": float(errors.max()),
        "sse": float(squared.sum()),
    }


def rms(values: pd.Series) -> float:
    """Root mean square of what is known; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values.dropna())))) if values.notna().any() else np.nan


def path_rms(robots: pd.DataFrame, by: Sequence[str] = ("robot",)) -> pd.DataFrame:
    """RMS position errors over a run, of FastSLAM's online path and of odometry alone.

    Args:
        robots: the table of that name, of one run, or of several that columns of `by` tell apart.
        by: columns that name a robot of a run.

    Returns:
        The columns of `by`; path_m, odometry_m, over_odometry (their ratio); n_landmarks at the
        end and n_frames.
    """
    groups = robots.groupby(list(by), sort=False)
    path_m, odometry_m = (groups[f"{of}_error_m"].agg(rms) for of in ("path", "odometry"))
    found = {"path_m": path_m, "odometry_m": odometry_m, "n_frames": groups.size()}
    found |= {"over_odometry": path_m / odometry_m.where(odometry_m > 0)}
    if "n_landmarks" in robots:
        found |= {"n_landmarks": groups["n_landmarks"].last()}
    return pd.DataFrame(found).reset_index()


def ate_m(path: Float, truth: Float, fit: bool = True) -> Float:
    """Distances (N,) of a path's positions to the true ones.

    Args:
        path: poses (N, 3).
        truth: poses (N, 3), all known.
        fit: move the path onto the truth first by the least-squares motion without scale (Umeyama
            1991; in the plane the closed form of `fit_rigid`). Else both start where they start.
    """
    positions = path[:, :2]
    if fit and len(path) > 1:
        T_truth_path = np.array(fit_rigid(truth[:, :2], positions, np.arange(len(path))))
        positions = se2.transform_points(T_truth_path, positions)
    return np.linalg.norm(positions - truth[:, :2], axis=1)


def rpe(path: Float, truth: Float, pairs: np.ndarray) -> tuple[Float, Float]:
    """Relative pose errors of pairs of poses: lengths (P,) in m and angles (P,) in rad.

    E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Sturm et al. (2012), eq. 2.

    Args:
        path: poses P (N, 3).
        truth: poses Q (N, 3).
        pairs: rows (P, 2) of the first and the second pose.
    """
    true_motion = se2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    motion = se2.between(path[pairs[:, 0]], path[pairs[:, 1]])
    error = se2.between(true_motion, motion)
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])


def pairs_by_frames(known: np.ndarray, delta: int) -> np.ndarray:
    """Rows (P, 2) that are `delta` frames apart and follow on each other, both of them known.

    Args:
        known: (T,) bool; rows count the known poses only, frames count all.
        delta: in frames.
    """
    first = np.arange(0, len(known) - delta, delta)
    row = np.cumsum(known) - 1
    both = known[first] & known[first + delta]
    return np.stack([row[first[both]], row[first[both] + delta]], axis=1)


def pairs_by_length(positions_m: Float, delta_m: float) -> np.ndarray:
    """Rows (P, 2) between which the way is at least `delta_m` long, one after the other."""
    steps = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    ends, gone = [0], 0.0
    for row, step in enumerate(steps, start=1):
        gone += step
        if gone >= delta_m:
            ends.append(row)
            gone = 0.0
    return np.array([ends[:-1], ends[1:]], dtype=np.int64).T


def path_statistics_rows(paths: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of the table `path_statistics` from those of the table `paths`."""
    rows = []
    for robot, own in paths.groupby("robot", sort=False):
        all_poses = {
            source: own[[f"{source}_{name}" for name in _POSE]].to_numpy()
            for source in (*SOURCES, "truth")
        }
        known = np.asarray(np.isfinite(all_poses["truth"]).all(axis=1))
        truth = all_poses["truth"][known]
        for source in SOURCES:
            for entry, errors in _errors(all_poses[source][known], truth, known):
                names = {"robot": robot, "source": source} | entry
                rows.append(names | {"n": len(errors)} | seven_statistics(errors))
    return rows


def _errors(path: Float, truth: Float, known: np.ndarray) -> list[tuple[dict[str, Any], Float]]:
    """What is measured of one path, and the errors."""
    none = {"delta": np.nan, "delta_unit": ""}
    measured = [
        ({"quantity": "ate_m"} | none, ate_m(path, truth)),
        ({"quantity": "ate_from_start_m"} | none, ate_m(path, truth, fit=False)),
    ]
    for delta, unit in RPE_DELTAS:
        if unit == "frames":
            pairs = pairs_by_frames(known, int(delta))
        else:
            pairs = pairs_by_length(truth[:, :2], delta)
        length_m, angle_rad = rpe(path, truth, pairs)
        entry = {"delta": delta, "delta_unit": unit}
        measured.append(({"quantity": "rpe_m"} | entry, length_m))
        measured.append(({"quantity": "rpe_rad"} | entry, angle_rad))
    return measured
