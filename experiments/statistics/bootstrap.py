"""Bootstrap intervals that resample whole runs, since the rows of one run depend on each other."""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy.stats

from experiments.statistics.intervals import CONFIDENCE
from mapfusion.se2 import Float

# An interval's end at 2.5 % then rests on 50 draws (Efron & Tibshirani 1993, ch. 14.3).
RESAMPLES = 2000
RUN, MAPS_OF_ONE_RUN = "run", "maps of one run"
_MAP_KEYS = ["robot_a", "robot_b", "iteration"]

Statistic = Callable[[Float], float]


class Clusters(NamedTuple):
    """Which rows are resampled together.

    Attributes:
        codes: (N,) number of each row's cluster.
        n: how many there are.
        unit: "run", or, where there is one run only, "maps of one run": what an interval says then
            is nothing about other seeds.
    """

    codes: np.ndarray
    n: int
    unit: str


class Interval(NamedTuple):
    """A number and how sure it is; the ends are NaN where they cannot be known."""

    value: float
    low: float
    high: float


def clusters_of(frame: pd.DataFrame) -> Clusters:
    """Rows by run; of a single run, by robot pair and iteration where the table has these."""
    codes, runs = pd.factorize(frame["run_id"])
    if len(runs) != 1 or not set(_MAP_KEYS) <= set(frame.columns):
        return Clusters(codes, len(runs), RUN)
    codes = frame.groupby(_MAP_KEYS, sort=False).ngroup().to_numpy()
    return Clusters(codes, int(codes.max()) + 1, MAPS_OF_ONE_RUN)


class WeightedMedian:
    """The median of rows whose clusters are counted so many times each.

    Infinite values are welcome: a method without an answer is as far off as can be.
    """

    def __init__(self, values: Float, codes: np.ndarray) -> None:
        known = ~np.isnan(values)
        order = np.argsort(values[known], kind="stable")
        self._values = values[known][order]
        self._codes = codes[known][order]

    def __call__(self, counts: Float) -> float:
        """The median for counts (n_clusters,); NaN if no row counts."""
        cumulative = np.cumsum(counts[self._codes])
        if not len(cumulative) or cumulative[-1] == 0:
            return np.nan
        half = cumulative[-1] / 2
        lower = self._values[np.searchsorted(cumulative, half, side="left")]
        upper = self._values[np.searchsorted(cumulative, half, side="right")]
        if np.isfinite(lower) and np.isfinite(upper):
            return float(lower + (upper - lower) / 2)
        return float(lower)


def percentile_interval(
    statistic: Statistic,
    n_clusters: int,
    rng: np.random.Generator,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
) -> Interval:
    """Percentile interval of a statistic of cluster counts.

    For medians and their ratios: BCa's correction takes its acceleration from the jackknife, which
    is not consistent for medians (Efron & Tibshirani 1993, ch. 10.6).

    Args:
        statistic: of counts (n_clusters,): how often each cluster is in the sample.
        n_clusters: with one there is nothing to resample, and the ends are NaN.
        rng: decides the resamples.
        confidence: level of the interval.
        resamples: how many.
    """
    value = statistic(np.ones(n_clusters))
    if n_clusters < 2 or np.isnan(value):
        return Interval(value, np.nan, np.nan)
    counts = rng.multinomial(n_clusters, np.full(n_clusters, 1 / n_clusters), size=resamples)
    drawn = np.array([statistic(row) for row in counts])
    drawn = drawn[~np.isnan(drawn)]  # resamples in which no row had a value
    tail = (1 - confidence) / 2
    # a quantile that is one of the draws: no arithmetic with infinite ones
    low, high = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Interval(value, float(low), float(high))


def mean_interval(
    values: Float,
    rng: np.random.Generator,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
) -> Interval:
    """BCa interval of the mean of independent values (n,), one a run (Efron 1987).

    Fewer than two leave the ends NaN; equal ones make both ends the value.
    """
    if len(values) < 2:
        return Interval(float(np.mean(values)) if len(values) else np.nan, np.nan, np.nan)
    if np.ptp(values) == 0:
        return Interval(float(values[0]), float(values[0]), float(values[0]))
    with warnings.catch_warnings():  # equal jackknife values; the percentile then does
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)
        result = scipy.stats.bootstrap(
            (values,),
            np.mean,
            n_resamples=resamples,
            confidence_level=confidence,
            method="BCa",
            vectorized=True,
            rng=rng,
        )
    low, high = result.confidence_interval
    if not np.isfinite([low, high]).all():
        tail = (1 - confidence) / 2
        low, high = np.quantile(result.bootstrap_distribution, [tail, 1 - tail])
    return Interval(float(np.mean(values)), float(low), float(high))
