"""Methods against the oracle, and against each other on the very same maps, with intervals."""

from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE, rich
from experiments.judge.judged_maps import MAP_PAIR, methods_in
from experiments.study.statistics import intervals
from experiments.study.statistics.better import change_of_each_run, holm, log_ratio, mean_change
from experiments.study.statistics.intervals import RUN, Interval, WeightedMedian, clusters_of
from mapfusion.se2 import Float

STAGES = {"estimated": "translation_error_m", "refined": "refined_translation_error_m"}


def oracle_ratios(maps: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Median translation error over the oracle's, for each method, as estimated and refined.

    On the rich ones of rows of `maps_of`: `error_over_oracle` with intervals. Medians run over
    runs, robot pairs and iterations; whole runs are resampled, the same for method and oracle.

    Returns:
        One row a method: aligner, n_runs, n_maps, unit, and for estimated and refined the share of
        answers with an estimate (_share; without one the error is infinite), the median error in
        metres (_m), the ratio (_ratio) and its interval (_ratio_low, _ratio_high).
    """
    maps = rich(maps)
    clusters = clusters_of(maps)

    def median(aligner: str, column: str) -> WeightedMedian:
        own = (maps["aligner"] == aligner).to_numpy()
        return WeightedMedian(maps[column].to_numpy()[own], clusters.codes[own])

    below = median(ORACLE, STAGES["refined"])
    rows = []
    for aligner in methods_in(maps, oracle=True):
        own = maps[maps["aligner"] == aligner]
        row: dict[str, Any] = {"aligner": aligner, "n_runs": own["run_id"].nunique()}
        row |= {"n_maps": len(own), "unit": clusters.unit}
        for stage, column in STAGES.items():
            ratio = partial(_ratio, median(aligner, column), below)
            interval = intervals.percentile_interval(ratio, clusters.n, rng)
            row |= {f"{stage}_share": own[f"{stage}_share"].mean()}
            row |= {f"{stage}_m": own[column].median()} | interval.columns(f"{stage}_ratio")
        rows.append(row)
    return pd.DataFrame(rows)


def _ratio(above: WeightedMedian, below: WeightedMedian, counts: Float) -> Float:
    divisor = below(counts)
    return above(counts) / np.where(divisor > 0, divisor, np.nan)


def compare_methods(maps: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Every two methods on the same rich maps: ratio of their errors, and who is nearer how often.

    A method without an estimate on a map is infinitely far off there; where both have none it is a
    draw. Compared are translation errors as estimated.

    Returns:
        One row per pair of methods: first, second, n_runs, n_maps, unit; ratio, the median over the
        maps of the first one's error over the second's, with its interval (whole runs resampled);
        first_wins, the share of maps on which the first is nearer (draws count half), likewise;
        p, of the runs' median log ratios (NaN for a single run), and p_holm, corrected for the
        number of pairs.
    """
    frame = paired_values(rich(maps), "translation_error_m").reset_index()
    clusters = clusters_of(frame)
    rows = []
    for first, second in combinations(methods_in(rich(maps)), 2):
        known = frame[[first, second]].notna().all(axis=1).to_numpy()
        both, judged = frame[known], clusters._replace(codes=clusters.codes[known])
        change = log_ratio(both[first].to_numpy(), both[second].to_numpy())
        ratio = intervals.median_interval(change, judged, rng)
        won = (change < 0) + 0.5 * (change == 0)
        wins = intervals.weighted_mean_interval(won, np.ones(len(won)), judged, rng)
        row: dict[str, Any] = {"first": first, "second": second}
        row |= {"n_runs": both["run_id"].nunique(), "n_maps": len(both), "unit": clusters.unit}
        row |= Interval(*np.exp(ratio)).columns("ratio") | wins.columns("first_wins")
        of_runs = change_of_each_run(change, both["run_id"], clusters.n)
        rows.append(row | {"p": mean_change(of_runs).p if clusters.unit == RUN else np.nan})
    compared = pd.DataFrame(rows)
    return compared.assign(p_holm=holm(compared["p"].to_numpy())) if rows else compared


def paired_values(maps: pd.DataFrame, column: str) -> pd.DataFrame:
    """A column of `maps_of`: one row per pair of maps, one column a method."""
    return maps.pivot_table(index=MAP_PAIR, columns="aligner", values=column, dropna=False)
