"""Path errors of many runs, and landmark NEES beside the band that consistent maps keep to."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from experiments.judge.fused_landmarks import mean_nees_band
from experiments.judge.judged_fusers import last_fused
from experiments.judge.path_errors import STATISTICS
from experiments.study.statistics import intervals

FUSION_COLUMNS = ("nees_with_drift", "nees_without_drift", "degrees_of_freedom", "true_pair")
SMOOTHER_COLUMNS = ("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share")
SMOOTHER_COLUMNS += ("nees_per_dof", "coverage_95")
_FUSER_FIGURES = ("landmark_rmse_m", "over_better_filter", "nees_per_dof", "coverage_95")
FUSER_COLUMNS = ("fuser", "iteration", *_FUSER_FIGURES)
_PATH_KEYS = ["source", "quantity", "delta", "delta_unit"]


def path_summary(path_statistics: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """One row per source (final, online, odometry) and quantity (ATE, RPE).

    Returns:
        source, quantity, delta, delta_unit, n_runs, n_paths, the seven statistics that evo reports
        (medians over the paths), and the interval of the median rmse, whole runs resampled.
    """
    rows = []
    for keys, own in path_statistics.groupby(_PATH_KEYS, sort=False, dropna=False):
        runs = intervals.clusters_of(own)
        row = dict(zip(_PATH_KEYS, keys, strict=True)) | {"n_runs": runs.n, "n_paths": len(own)}
        row |= dict(own[list(STATISTICS)].median())
        _, low, high = intervals.median_interval(own["rmse"].to_numpy(), runs, rng)
        rows.append(row | {"rmse_low": low, "rmse_high": high})
    return pd.DataFrame(rows)


def nees_of_maps(landmark_nees: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Mean NEES per degree of freedom, before merging and after.

    Returns:
        One row per kind of landmark (see `judge.tables`): landmarks, n_runs, n_landmarks,
        nees_per_dof with its interval over the runs, band_low and band_high (where the mean of so
        many independent landmarks would lie 95 times of 100), share_in_gate (0.95 if consistent)
        with its interval. Landmarks of one map drift together, so a mean outside the band alone is
        no proof for a single map; the interval over runs is the one to trust.
    """
    rows = []
    known = landmark_nees[landmark_nees["n_landmarks"] > 0]
    for kind, own in known.groupby("landmarks", sort=False):
        runs, weight = intervals.clusters_of(own), own["n_landmarks"].to_numpy(dtype=np.float64)
        dof, share = own["degrees_of_freedom"].to_numpy(), own["share_in_gate"].to_numpy()
        per_dof = own["nees_mean"].to_numpy() / dof
        nees = intervals.weighted_mean_interval(per_dof, dof * weight, runs, rng)
        inside = intervals.weighted_mean_interval(share, weight, runs, rng)
        # the degrees of freedom of a sum add up
        band = dict(zip(("band_low", "band_high"), mean_nees_band(dof @ weight, 1), strict=True))
        row = {"landmarks": kind, "n_runs": runs.n, "n_landmarks": int(weight.sum())}
        row |= nees.columns("nees_per_dof") | band | inside.columns("share_in_gate")
        rows.append(row)
    return pd.DataFrame(rows)


def nees_of_pairs(fusion: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """The same of landmarks fused pair by pair (table `fusion`), with s_drift and without.

    True pairs only; the share in the gate is not kept there, and left NaN.
    """
    labels = {name: f"fused in pairs, {name[5:].replace('_', ' ')}" for name in FUSION_COLUMNS[:2]}
    true = fusion[fusion["true_pair"]].rename(columns=labels)
    keys, values = ["run_id", "degrees_of_freedom"], list(labels.values())
    known = true.melt(keys, values, "landmarks", "nees_mean").dropna(subset="nees_mean")
    return nees_of_maps(known.assign(n_landmarks=1, share_in_gate=np.nan), rng)


def smoother_summary(smoother: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """One row: the batch smoother beside the filter (table `smoother`), medians over the robots.

    Returns:
        n_runs, n_robots, and each column of numbers with the interval of its median over the runs.
    """
    about = {"n_runs": intervals.clusters_of(smoother).n, "n_robots": len(smoother)}
    return pd.DataFrame([about | _medians(smoother, SMOOTHER_COLUMNS, rng)])


def fuser_summary(fusers: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """One row per fuser (table `fusers`): medians over the runs, each at its last iteration.

    Returns:
        fuser, n_runs, and each column of numbers with the interval of its median over the runs.
    """
    rows = []
    for fuser, own in last_fused(fusers).groupby("fuser", sort=False):
        about = {"fuser": fuser, "n_runs": intervals.clusters_of(own).n}
        rows.append(about | _medians(own, _FUSER_FIGURES, rng))
    return pd.DataFrame(rows)


def _medians(
    rows: pd.DataFrame, names: Sequence[str], rng: np.random.Generator
) -> dict[str, float]:
    runs, found = intervals.clusters_of(rows), dict[str, float]()
    for name in names:
        values = intervals.median_interval(rows[name].to_numpy(), runs, rng)
        found |= dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
    return found
