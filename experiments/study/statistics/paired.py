"""Methods compared on the very same maps, pair by pair."""

from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import rich
from experiments.judge.judged_maps import MAP_PAIR, methods_in
from experiments.study.statistics.better import (
    change_of_each_run,
    holm,
    log_ratio,
    mean_change,
)
from experiments.study.statistics.bootstrap import (
    RUN,
    Interval,
    WeightedMedian,
    clusters_of,
    percentile_interval,
    weighted_mean_interval,
)


def compare_methods(
    maps: pd.DataFrame, rng: np.random.Generator, column: str = "translation_error_m"
) -> pd.DataFrame:
    """Every two methods on the same rich maps: ratio of their errors, and who is nearer how often.

    A method without an estimate on a map is infinitely far off there; where both have none it is a
    draw.

    Args:
        maps: rows of `maps_of`.
        rng: decides the resamples.
        column: of `maps`, the error to compare.

    Returns:
        One row per pair of methods: first, second, n_runs, n_maps, unit; ratio, the median over the
        maps of the first one's error over the second's, with its interval (whole runs resampled);
        first_wins, the share of maps on which the first is nearer (draws count half), likewise;
        p, of the runs' median log ratios (NaN for a single run), and p_holm, corrected for the
        number of pairs.
    """
    wide = paired_values(rich(maps), column)
    frame = wide.reset_index()
    clusters = clusters_of(frame)
    rows = []
    for first, second in combinations(methods_in(rich(maps)), 2):
        both = frame[[first, second]].notna().all(axis=1).to_numpy()
        codes, run_id = clusters.codes[both], frame["run_id"].to_numpy()[both]
        change = log_ratio(frame[first].to_numpy()[both], frame[second].to_numpy()[both])
        median = WeightedMedian(change, codes)
        ratio = Interval(*np.exp(percentile_interval(median, clusters.n, rng)))
        won = (change < 0) + 0.5 * (change == 0)
        wins = weighted_mean_interval(won, np.ones(len(won)), codes, clusters.n, rng)
        p = np.nan
        if clusters.unit == RUN:
            p = mean_change(change_of_each_run(change, run_id, clusters.n)).p
        row: dict[str, Any] = {"first": first, "second": second, "n_runs": len(np.unique(run_id))}
        row |= {"n_maps": len(change), "unit": clusters.unit}
        row |= ratio.columns("ratio") | wins.columns("first_wins")
        rows.append(row | {"p": p})
    compared = pd.DataFrame(rows)
    return compared.assign(p_holm=holm(compared["p"].to_numpy())) if rows else compared


def paired_values(maps: pd.DataFrame, column: str) -> pd.DataFrame:
    """A column of `maps_of`: one row per pair of maps, one column a method."""
    return maps.pivot_table(index=MAP_PAIR, columns="aligner", values=column, dropna=False)
