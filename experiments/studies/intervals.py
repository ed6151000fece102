"""Confidence intervals (Wilson, bootstrap), and a test of the difference of two methods.

Rows of one run depend on each other, so an interval over rows is several times too narrow. The
bootstrap resamples whole runs, and Wilson's interval uses the effective number of trials.

The unit is the run: maps, robot pairs and repetitions of one run depend on each other. Each run
gives one change. Student's t test checks that the mean change is 0, and its interval inverts the
same test. All tests that are made together are corrected by Holm's method.

Sign and signed-rank tests assume no distribution. But with n runs their p is at least 2 / 2^n, and
after the correction for dozens of tests they need twelve runs or more. The t test assumes that the
mean of the runs' changes is about normal. Changes are differences of shares or medians of log
ratios over many maps, which are nearly normal. The test needs two runs; with fewer than FEW_RUNS
the assumption cannot be checked and the result is weak. For a single run, maps take the place of
runs: the result says nothing about other seeds.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from experiments.evaluation.alignment_criteria import MAP_KEYS
from mapfusion.geometry.numerics import Float

CONFIDENCE = 0.95
# 50 draws lie outside each end of a 95 % interval (Efron & Tibshirani 1993, ch. 14.3).
RESAMPLES = 2000
RUN, MAPS_OF_ONE_RUN = "run", "maps of one run"

Statistic = Callable[[Float], Float]
_MAX_CELLS = 1_000_000  # resamples times rows in one array: 8 MB


class Clusters(NamedTuple):
    """Clusters of rows that are resampled together.

    Attributes:
        codes: (N,) index of each row's cluster.
        n: number of clusters.
        unit: kind of cluster, a run; for a single run its maps, and then an interval says nothing
            about other seeds.
    """

    codes: np.ndarray
    n: int
    unit: str


class Interval(NamedTuple):
    """Value with a confidence interval; the ends are NaN if they are unknown."""

    value: float
    low: float
    high: float

    def columns(self, name: str) -> dict[str, float]:
        """Return the columns NAME, NAME_low and NAME_high of a table."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


def clusters_of(frame: pd.DataFrame) -> Clusters:
    """Cluster rows by run; rows of a single run by robot pair and iteration, if there are any."""
    codes, runs = pd.factorize(frame["run_id"])
    if len(runs) != 1 or not set(MAP_KEYS) <= set(frame.columns):
        return Clusters(codes, len(runs), RUN)
    codes = frame.groupby(list(MAP_KEYS), sort=False).ngroup().to_numpy()
    return Clusters(codes, int(codes.max()) + 1, MAPS_OF_ONE_RUN)


class WeightedMedian:
    """Median of rows whose clusters are counted several times each.

    Values may be infinite: a method without an answer has an infinite error.
    """

    def __init__(self, values: Float, codes: np.ndarray) -> None:
        order = np.argsort(values, kind="stable")
        order = order[~np.isnan(values[order])]
        self._values, self._codes = values[order], codes[order]

    def __call__(self, counts: Float) -> Float:
        """Return medians (B,) for counts (B, n_clusters); NaN where no row is counted."""
        if not len(self._values):
            return np.full(len(counts), np.nan)
        n_parts = max(1, min(len(counts), len(counts) * len(self._values) // _MAX_CELLS))
        medians, last = [], len(self._values) - 1
        for part in np.array_split(counts, n_parts):
            cumulative = np.cumsum(part[:, self._codes], axis=1)
            half = cumulative[:, -1:] / 2
            lower = self._values[np.minimum(np.sum(cumulative < half, axis=1), last)]
            upper = self._values[np.minimum(np.sum(cumulative <= half, axis=1), last)]
            finite = np.isfinite(lower) & np.isfinite(upper)
            difference = np.subtract(upper, lower, out=np.zeros(len(lower)), where=finite)
            medians.append(np.where(half[:, 0] > 0, lower + difference / 2, np.nan))
        return np.concatenate(medians)


def percentile_interval(
    statistic: Statistic, n_clusters: int, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Interval:
    """Return the bootstrap percentile interval of a statistic.

    The method suits medians and their ratios. The BCa interval does not: its acceleration comes
    from the jackknife, which is not consistent for medians (Efron & Tibshirani 1993, ch. 10.6).

    Args:
        statistic: maps counts (B, n_clusters) of clusters in B samples to values (B,).
        n_clusters: number of clusters; the ends are NaN for a single one.
        rng: generator of the resamples.
        resamples: number of resamples.
    """
    value = float(statistic(np.ones((1, max(n_clusters, 1))))[0])
    if n_clusters < 2 or np.isnan(value):
        return Interval(value, np.nan, np.nan)
    counts = rng.multinomial(n_clusters, np.full(n_clusters, 1 / n_clusters), size=resamples)
    drawn = statistic(counts.astype(np.float64))
    drawn = drawn[~np.isnan(drawn)]  # resamples in which no row had a value
    tail = (1 - CONFIDENCE) / 2
    # a quantile that is one of the draws avoids arithmetic with infinite values
    low, high = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Interval(value, float(low), float(high))


def median_interval(values: Float, clusters: Clusters, rng: np.random.Generator) -> Interval:
    """Return the median of rows (N,) with its interval; whole clusters are resampled."""
    return percentile_interval(WeightedMedian(values, clusters.codes), clusters.n, rng)


def weighted_mean_interval(
    values: Float, weights: Float, clusters: Clusters, rng: np.random.Generator
) -> Interval:
    """Return the weighted mean of rows (N,) with its interval; whole clusters are resampled."""
    sums = np.bincount(clusters.codes, values * weights, minlength=clusters.n)
    totals = np.bincount(clusters.codes, weights, minlength=clusters.n)

    def mean(counts: Float) -> Float:
        total = counts @ totals
        return counts @ sums / np.where(total > 0, total, np.nan)

    return percentile_interval(mean, clusters.n, rng)


def wilson(successes: ArrayLike, trials: ArrayLike) -> tuple[Float, Float]:
    """Return both ends of the 95 % score interval of a binomial proportion (Wilson 1927).

    Unlike the Wald interval it keeps its level for few trials and for rates near 0 and 1. Counts
    need not be integers. Without trials the interval is [0, 1].

    Raises:
        ValueError: negative counts, or more successes than trials.
    """
    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    if np.any(k < 0) or np.any(k > n + 1e-9 * (1 + n)):  # sums of fractions round
        raise ValueError("successes: must lie between 0 and trials")
    z2 = scipy.special.ndtri((1 + CONFIDENCE) / 2) ** 2
    known = n > 0
    rate = np.minimum(np.divide(k, n, out=np.full(n.shape, 0.5), where=known), 1.0)
    centre = (n * rate + z2 / 2) / (n + z2)
    half = np.sqrt(z2 * (n * rate * (1 - rate) + z2 / 4)) / (n + z2)
    # at rates of 0 and 1 centre and half cancel up to rounding
    low = np.where(known & (rate > 0), np.maximum(centre - half, 0.0), 0.0)
    high = np.where(known & (rate < 1), np.minimum(centre + half, 1.0), 1.0)
    return low, high


def effective_trials(rows_per_cluster: ArrayLike) -> float:
    """Return the least effective number of independent trials of rows in clusters (Kish 1965).

    For any dependence inside clusters of m_i rows, the variance of a rate p over rows is at most
    p (1 - p) sum m_i^2 / (sum m_i)^2. It is reached if all rows of a cluster are equal. So an
    interval with n = (sum m_i)^2 / sum m_i^2 trials is never too narrow.
    """
    rows = np.asarray(rows_per_cluster, dtype=np.float64)
    total = rows.sum()
    return float(total**2 / np.sum(rows**2)) if total > 0 else 0.0


SIGNIFICANCE = 0.05
# Equal signs of five runs do not reach 5 % (2 / 2^5 = 6 %); those of six runs do.
FEW_RUNS = 6
# An error without an estimate is infinite. In a mean it counts as a factor of a thousand, which is
# the length of a hall over an inch.
LARGEST_LOG_RATIO = float(np.log(1e3))


class BetterTest(NamedTuple):
    """Mean change, its 95 % interval, and the two-sided p value of no change."""

    change: float
    low: float
    high: float
    p: float


def log_ratio(over: Float, under: Float) -> Float:
    """Return log(over / under); 0 where both are equal, including both 0 or both infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: Float = np.log(over) - np.log(under)
    return np.where(over == under, 0.0, change)


def change_of_each_run(changes: Float, run_id: Any, n_runs: int, mean: bool = False) -> Float:
    """Reduce changes of maps (N,) to one change per run: the median or the mean over its maps.

    Medians are for log ratios, which may be infinite; means are for differences of shares. Changes
    of a single run are returned as they are.
    """
    if n_runs == 1:
        return changes
    groups = pd.Series(changes).groupby(np.asarray(run_id), sort=False)
    return np.asarray(groups.mean() if mean else groups.median(), dtype=np.float64)


def mean_change(changes: Float) -> BetterTest:
    """Test that independent changes (n,), one per run, have a mean of 0 (Student's t test).

    With fewer than two changes the interval and p are NaN. If all changes are 0, p is NaN.
    """
    changes = np.clip(changes, -LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
    if not len(changes):
        return BetterTest(np.nan, np.nan, np.nan, np.nan)
    mean = float(np.mean(changes))
    if len(changes) < 2:
        return BetterTest(mean, np.nan, np.nan, np.nan)
    if np.ptp(changes) == 0:  # t is infinite: use the sign test
        p = float(2.0 ** (1 - len(changes))) if changes.any() else np.nan
        return BetterTest(mean, mean, mean, p)
    # Student's t by its distribution function: the import of scipy.stats takes longer than a screen
    freedom = len(changes) - 1
    sigma = float(np.std(changes, ddof=1)) / math.sqrt(len(changes))
    sigma = max(sigma, float(np.finfo(np.float64).tiny))
    p = 2.0 * float(scipy.special.stdtr(freedom, -abs(mean) / sigma))
    half = sigma * float(scipy.special.stdtrit(freedom, (1 + CONFIDENCE) / 2))
    return BetterTest(mean, mean - half, mean + half, p)


def signed_rank(changes: Float) -> float:
    """Return p of Wilcoxon's signed-rank test that independent changes have a median of 0.

    Changes may be infinite. Fewer than two changes, and changes that are all 0, give NaN.
    """
    from scipy.stats import wilcoxon  # a slow import

    if len(changes) < 2 or not np.any(changes):
        return np.nan
    clipped = np.clip(changes, -LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
    found: Any = wilcoxon(clipped, zero_method="zsplit")
    return float(found.pvalue)


def holm(p_values: Float) -> Float:
    """Return adjusted p values (Holm 1979), which control the family-wise error rate.

    NaN values are not tests: they stay NaN and are not counted.
    """
    adjusted = np.full(len(p_values), np.nan)
    tests = np.flatnonzero(~np.isnan(p_values))
    order = tests[np.argsort(p_values[tests], kind="stable")]
    factors = len(order) - np.arange(len(order))
    adjusted[order] = np.minimum(np.maximum.accumulate(p_values[order] * factors), 1.0)
    return adjusted
