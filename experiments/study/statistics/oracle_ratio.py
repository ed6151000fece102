"""What each method loses against the oracle: the ratio of the medians, with its interval."""

from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE, rich
from experiments.judge.judged_maps import methods_in
from experiments.study.statistics.bootstrap import (
    WeightedMedian,
    clusters_of,
    percentile_interval,
)
from mapfusion.se2 import Float

STAGES = {"estimated": "translation_error_m", "refined": "refined_translation_error_m"}


def oracle_ratios(maps: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Median translation error over the oracle's, for each method, as estimated and refined.

    On rich maps: `error_over_oracle` with intervals. Medians run over runs, robot pairs and
    iterations; whole runs are resampled, the same for method and oracle.

    Args:
        maps: rows of `maps_of`.
        rng: decides the resamples.

    Returns:
        One row a method: aligner, n_runs, n_maps, unit, and for estimated and refined the median
        error in metres (_m), the ratio (_ratio) and its interval (_ratio_low, _ratio_high).
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
            above = median(aligner, column)

            def ratio(counts: Float, above: WeightedMedian = above) -> Float:
                divisor = below(counts)
                return above(counts) / np.where(divisor > 0, divisor, np.nan)

            value, low, high = percentile_interval(ratio, clusters.n, rng)
            row |= {f"{stage}_m": own[column].median(), f"{stage}_ratio": value}
            row |= {f"{stage}_ratio_low": low, f"{stage}_ratio_high": high}
        rows.append(row)
    return pd.DataFrame(rows)
