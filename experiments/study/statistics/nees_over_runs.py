"""Landmark NEES of many runs beside the chi-square band that consistent maps would keep to."""

from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.fused_landmarks import mean_nees_band
from experiments.study.statistics.bootstrap import Interval, weighted_mean_interval

FUSION_COLUMNS = ("nees_with_drift", "nees_without_drift", "degrees_of_freedom", "true_pair")


def nees_of_maps(landmark_nees: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Mean NEES per degree of freedom, before merging and after.

    Args:
        landmark_nees: the table of that name of some runs.
        rng: decides the resamples.

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
        codes, runs = pd.factorize(own["run_id"])
        weight = own["n_landmarks"].to_numpy(dtype=np.float64)
        dof = own["degrees_of_freedom"].to_numpy()
        per_dof = own["nees_mean"].to_numpy() / dof
        nees = weighted_mean_interval(per_dof, dof * weight, codes, len(runs), rng)
        inside = weighted_mean_interval(
            own["share_in_gate"].to_numpy(), weight, codes, len(runs), rng
        )
        row = {"landmarks": kind, "n_runs": len(runs), "n_landmarks": int(weight.sum())}
        rows.append(row | _columns(nees, inside, float(dof @ weight)))
    return pd.DataFrame(rows)


def nees_of_pairs(fusion: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """The same of landmarks fused pair by pair (table `fusion`), with s_drift and without.

    True pairs only; the share in the gate is not kept there, and left NaN.
    """
    rows = []
    true = fusion[fusion["true_pair"]]
    for name in ("with_drift", "without_drift"):
        own = true[true[f"nees_{name}"].notna()]
        if own.empty:
            continue
        codes, runs = pd.factorize(own["run_id"])
        dof = own["degrees_of_freedom"].to_numpy(dtype=np.float64)
        per_dof = own[f"nees_{name}"].to_numpy() / dof
        nees = weighted_mean_interval(per_dof, dof, codes, len(runs), rng)
        label = f"fused in pairs, {name.replace('_', ' ')}"
        row = {"landmarks": label, "n_runs": len(runs), "n_landmarks": len(own)}
        rows.append(row | _columns(nees, Interval(np.nan, np.nan, np.nan), float(dof.sum())))
    return pd.DataFrame(rows)


def _columns(nees: Interval, inside: Interval, total_dof: float) -> dict[str, Any]:
    band_low, band_high = mean_nees_band(total_dof, 1)  # the sum's degrees of freedom add up
    band = {"band_low": band_low, "band_high": band_high}
    return nees.columns("nees_per_dof") | band | inside.columns("share_in_gate")
