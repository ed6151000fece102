"""What each method loses against the oracle: the ratio of the medians, with its interval."""

from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.metrics import MIN_TRUE_PAIRS, ORACLE
from experiments.study.statistics.bootstrap import (
    Interval,
    WeightedMedian,
    clusters_of,
    percentile_interval,
)
from experiments.study.statistics.judged_maps import methods_in
from mapfusion.se2 import Float

STAGES = {"estimated": "translation_error_m", "refined": "refined_translation_error_m"}


def oracle_ratios(maps: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Median translation error over the oracle's, for each method, as estimated and refined.

    Where there are 30 or more true pairs, as the checks take it. Medians run over runs, robot
    pairs and iterations; whole runs are resampled, the same for method and oracle.

    Args:
        maps: rows of `maps_of`.
        rng: decides the resamples.

    Returns:
        One row a method: aligner, n_runs, n_maps, unit, and for estimated and refined the median
        error in metres (_m), the ratio (_ratio) and its interval (_ratio_low, _ratio_high).
    """
    rich = maps[maps["n_true"] >= MIN_TRUE_PAIRS]
    clusters = clusters_of(rich)
    is_oracle = (rich["aligner"] == ORACLE).to_numpy()
    reference = rich["refined_translation_error_m"].to_numpy()[is_oracle]
    rows = []
    for aligner in methods_in(maps, oracle=True):
        own = (rich["aligner"] == aligner).to_numpy()
        row: dict[str, Any] = {"aligner": aligner, "n_runs": rich["run_id"][own].nunique()}
        row |= {"n_maps": int(own.sum()), "unit": clusters.unit}
        for stage, column in STAGES.items():
            values = rich[column].to_numpy()[own]
            ratio = ratio_of_medians(
                (values, clusters.codes[own]), (reference, clusters.codes[is_oracle]), rng
            )
            row |= {
                f"{stage}_m": WeightedMedian(values, clusters.codes[own])(np.ones((1, clusters.n)))[
                    0
                ]
            }
            row |= dict(zip(_names(stage), ratio, strict=True))
        rows.append(row)
    return pd.DataFrame(rows)


def _names(stage: str) -> list[str]:
    return [f"{stage}_ratio{end}" for end in ("", "_low", "_high")]


def ratio_of_medians(
    over: tuple[Float, np.ndarray], under: tuple[Float, np.ndarray], rng: np.random.Generator
) -> Interval:
    """Ratio of the medians of two sets of rows, (values, cluster codes) each; 95 % interval."""
    above, below = WeightedMedian(*over), WeightedMedian(*under)

    def ratio(counts: Float) -> Float:
        divisor = below(counts)
        return above(counts) / np.where(divisor > 0, divisor, np.nan)

    n_clusters = max((int(codes.max()) + 1 for _, codes in (over, under) if len(codes)), default=1)
    return percentile_interval(ratio, n_clusters, rng)
