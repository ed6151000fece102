"""Methods compared on the very same maps, pair by pair."""

from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
import scipy.stats

from experiments.judge.metrics import MIN_TRUE_PAIRS
from experiments.study.statistics.bootstrap import (
    Interval,
    WeightedMedian,
    clusters_of,
    percentile_interval,
)
from experiments.study.statistics.judged_maps import MAP_KEYS, methods_in
from mapfusion.se2 import Float

_KEYS = ["run_id", *MAP_KEYS]


def compare_methods(
    maps: pd.DataFrame, rng: np.random.Generator, column: str = "translation_error_m"
) -> pd.DataFrame:
    """Every two methods on the same maps: ratio of their errors, and who is nearer how often.

    On maps with 30 or more true pairs. A method without an estimate on a map is infinitely far off
    there; where both have none it is a draw.

    Args:
        maps: rows of `maps_of`.
        rng: decides the resamples.
        column: of `maps`, the error to compare.

    Returns:
        One row per pair of methods: first, second, n_runs, n_maps, unit; ratio, the median over the
        maps of the first one's error over the second's, with its interval (whole runs resampled);
        first_wins, the share of maps on which the first is nearer (draws count half), likewise;
        p_wilcoxon, of the signed ranks of the runs' median log ratios (NaN for a single run), and
        p_holm, corrected for the number of pairs.
    """
    rich = maps[maps["n_true"] >= MIN_TRUE_PAIRS]
    wide = rich.pivot_table(index=_KEYS, columns="aligner", values=column, dropna=False)
    frame = wide.reset_index()
    clusters = clusters_of(frame)
    rows = []
    for first, second in combinations(methods_in(rich), 2):
        both = frame[[first, second]].notna().all(axis=1).to_numpy()
        codes = clusters.codes[both]
        log_ratio = _log_ratio(frame[first].to_numpy()[both], frame[second].to_numpy()[both])
        median = WeightedMedian(log_ratio, codes)
        ratio = Interval(*np.exp(percentile_interval(median, clusters.n, rng)))
        wins = win_share(log_ratio, codes, clusters.n, rng)
        per_run = pd.Series(log_ratio).groupby(frame["run_id"].to_numpy()[both]).median()
        row: dict[str, Any] = {"first": first, "second": second, "n_runs": len(per_run)}
        row |= {"n_maps": len(log_ratio), "unit": clusters.unit}
        row |= dict(zip(("ratio", "ratio_low", "ratio_high"), ratio, strict=True))
        row |= dict(zip(("first_wins", "first_wins_low", "first_wins_high"), wins, strict=True))
        rows.append(row | {"p_wilcoxon": signed_rank_p(per_run.to_numpy())})
    compared = pd.DataFrame(rows)
    return compared.assign(p_holm=holm(compared["p_wilcoxon"].to_numpy())) if rows else compared


def _log_ratio(first: Float, second: Float) -> Float:
    """log(first / second); 0 where both are infinite or both are 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(first == second, 0.0, np.log(first) - np.log(second))


def win_share(
    log_ratio: Float, codes: np.ndarray, n_clusters: int, rng: np.random.Generator
) -> Interval:
    """Share of maps with a negative log ratio, ties counted half, whole clusters resampled."""
    wins = (log_ratio < 0) + 0.5 * (log_ratio == 0)
    won = np.bincount(codes, wins, minlength=n_clusters)
    played = np.bincount(codes, minlength=n_clusters)

    def share(counts: Float) -> Float:
        n = counts @ played
        return counts @ won / np.where(n > 0, n, np.nan)

    return percentile_interval(share, n_clusters, rng)


def signed_rank_p(values: Float) -> float:
    """Two-sided p of Wilcoxon's signed-rank test on independent values; zeros keep their ranks."""
    if len(values) < 2:
        return np.nan
    if not np.any(values):
        return 1.0
    tested: Any = scipy.stats.wilcoxon(values, zero_method="pratt")
    return float(tested.pvalue)


def holm(p_values: Float) -> Float:
    """Adjusted p values (Holm 1979): the chance of any false finding among all stays below p.

    NaN are no tests: they stay, and do not count.
    """
    adjusted = np.full(len(p_values), np.nan)
    tests = np.flatnonzero(~np.isnan(p_values))
    order = tests[np.argsort(p_values[tests], kind="stable")]
    factors = len(order) - np.arange(len(order))
    adjusted[order] = np.minimum(np.maximum.accumulate(p_values[order] * factors), 1.0)
    return adjusted
