"""Teams of many runs: paths in one frame, and the alignments that were believed."""

from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import has_common_ground, is_false_merge, right_refined
from experiments.judge.path_errors import STATISTICS
from experiments.judge.team_figures import believed
from experiments.study.statistics import intervals

_ERRORS = {
    "alone_m": "refined_translation_error_m",
    "alone_rad": "refined_rotation_error_rad",
    "team_m": "team_translation_error_m",
    "team_rad": "team_rotation_error_rad",
}


def team_paths(team: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """One row per source (final, online, odometry), of each run's largest set of merged robots.

    Returns:
        source, n_runs, n_robots of n_team (sums over the runs), evo's seven statistics of all
        their positions under one rigid fit (medians over the runs), and the interval of the median
        rmse.
    """
    rows = []
    for source, own in team[team["component"] == 1].groupby("source", sort=False):
        row: dict[str, Any] = {"source": source, "n_runs": len(own)}
        row |= dict(own[["n_robots", "n_team"]].sum()) | dict(own[list(STATISTICS)].median())
        runs = intervals.clusters_of(own)
        _, low, high = intervals.median_interval(own["rmse"].to_numpy(), runs, rng)
        rows.append(row | {"rmse_low": low, "rmse_high": high})
    return pd.DataFrame(rows)


def team_alignments(pairs: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """One row: what became of the alignments of all pairs of robots.

    Returns:
        n_runs, n_pairs, n_met (with common ground), n_believed; precision, the share of right ones
        of the believed, and recall, the share of those that met whose alignment is right and
        believed, with Wilson's intervals; medians over the pairs placed in one map of the errors of
        T_a_b, aligned alone (alone_m, alone_rad) and placed by all (team_m, team_rad), with
        intervals, whole runs resampled.
    """
    used, met = believed(pairs), has_common_ground(pairs)
    right = pd.Series(right_refined(pairs) & used)
    row: dict[str, Any] = {"n_runs": pairs["run_id"].nunique(), "n_pairs": len(pairs)}
    row |= {"n_met": int(met.sum()), "n_believed": int(used.sum())}
    row |= _share("precision", pairs[used], ~is_false_merge(pairs[used]))
    row |= _share("recall", pairs[met], right[met])
    placed = pairs[pairs["team_translation_error_m"].notna()]
    runs = intervals.clusters_of(placed)
    for name, column in _ERRORS.items():
        values = placed[column].abs().to_numpy()
        row |= intervals.median_interval(values, runs, rng).columns(name)
    return pd.DataFrame([row])


def _share(name: str, rows: pd.DataFrame, holds: pd.Series) -> dict[str, float]:
    """A share of rows with its interval; all rows of a run may share one fate."""
    if rows.empty:
        return intervals.Interval(np.nan, np.nan, np.nan).columns(name)
    n = intervals.effective_trials(rows.groupby("run_id").size())
    share = float(holds.mean())
    low, high = map(float, intervals.wilson(share * n, n))
    return intervals.Interval(share, low, high).columns(name)
