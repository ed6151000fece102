"""Path errors of many runs: evo's seven statistics, each as the median over robots and runs."""

import numpy as np
import pandas as pd

from experiments.judge.path_errors import STATISTICS
from experiments.study.statistics.bootstrap import WeightedMedian, percentile_interval

_KEYS = ["source", "quantity", "delta", "delta_unit"]


def path_summary(path_statistics: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """One row per source (final, online, odometry) and quantity (ATE, RPE).

    Returns:
        source, quantity, delta, delta_unit, n_runs, n_paths, the seven statistics (medians over
        the paths), and the interval of the median rmse, whole runs resampled.
    """
    rows = []
    for keys, own in path_statistics.groupby(_KEYS, sort=False, dropna=False):
        codes, runs = pd.factorize(own["run_id"])
        rmse = WeightedMedian(own["rmse"].to_numpy(), codes)
        _, low, high = percentile_interval(rmse, len(runs), rng)
        row = dict(zip(_KEYS, keys, strict=True)) | {"n_runs": len(runs), "n_paths": len(own)}
        row |= {name: own[name].median() for name in STATISTICS}
        rows.append(row | {"rmse_low": low, "rmse_high": high})
    return pd.DataFrame(rows)
