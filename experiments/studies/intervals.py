"""Confidence intervals (Wilson, bootstrap), and the test whether one of two is better.

Rows of one run depend on each other, and an interval over rows would be several times too narrow:
the bootstrap resamples whole runs, and Wilson's interval is given as many trials as they are worth.

The unit is the run: what its maps, robot pairs and repetitions share they share with chance, and
they would pass for more evidence than they are. Each run gives one change, and Student's t tests
that their mean is 0; its interval is the one that the test inverts, so both say the same. All tests
that are made together are corrected by Holm's rule.

Why t: sign and signed-rank tests take no form for granted, but with n runs their p is at least
2 / 2^n, which after the correction for the dozens of tests of a comparison asks for twelve runs and
more. The t test asks that the mean of the runs' changes be about normal; changes are differences of
shares or medians of log ratios over many maps, which are nearly so themselves. Two runs are the
least; with fewer than FEW_RUNS that cannot be seen from the data and a verdict is weak. Of a single
run the maps stand in for runs: what they tell is a hint about this run, nothing about other seeds.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import ndtri

from experiments.evaluation.alignment_summary import MAP_KEYS
from mapfusion.geometry.numerics import Float

CONFIDENCE = 0.95
# An interval's end at 2.5 % then rests on 50 draws (Efron & Tibshirani 1993, ch. 14.3).
RESAMPLES = 2000
RUN, MAPS_OF_ONE_RUN = "run", "maps of one run"

Statistic = Callable[[Float], Float]
_MAX_CELLS = 1_000_000  # resamples times rows that are worked on at once: some 8 MB an array


class Clusters(NamedTuple):
    """Which rows are resampled together: codes (N,) of rows' clusters, and how many there are.

    The unit is a run, or, where there is one only, its maps: what an interval says then is nothing
    about other seeds.
    """

    codes: np.ndarray
    n: int
    unit: str


class Interval(NamedTuple):
    """A number and how sure it is; the ends are NaN where they cannot be known."""

    value: float
    low: float
    high: float

    def columns(self, name: str) -> dict[str, float]:
        """As columns NAME, NAME_low and NAME_high of a table."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


def clusters_of(frame: pd.DataFrame) -> Clusters:
    """Rows by run; of a single run, by robot pair and iteration where the table has these."""
    codes, runs = pd.factorize(frame["run_id"])
    if len(runs) != 1 or not set(MAP_KEYS) <= set(frame.columns):
        return Clusters(codes, len(runs), RUN)
    codes = frame.groupby(list(MAP_KEYS), sort=False).ngroup().to_numpy()
    return Clusters(codes, int(codes.max()) + 1, MAPS_OF_ONE_RUN)


class WeightedMedian:
    """The median of rows whose clusters are counted so many times each.

    Infinite values are welcome: a method without an answer is as far off as can be.
    """

    def __init__(self, values: Float, codes: np.ndarray) -> None:
        order = np.argsort(values, kind="stable")
        order = order[~np.isnan(values[order])]
        self._values, self._codes = values[order], codes[order]

    def __call__(self, counts: Float) -> Float:
        """The medians (B,) for counts (B, n_clusters); NaN where no row counts."""
        if not len(self._values):
            return np.full(len(counts), np.nan)
        n_parts = max(1, min(len(counts), len(counts) * len(self._values) // _MAX_CELLS))
        return np.concatenate([self._of(part) for part in np.array_split(counts, n_parts)])

    def _of(self, counts: Float) -> Float:
        cumulative = np.cumsum(counts[:, self._codes], axis=1)
        half = cumulative[:, -1:] / 2
        last = len(self._values) - 1
        lower = self._values[np.minimum(np.sum(cumulative < half, axis=1), last)]
        upper = self._values[np.minimum(np.sum(cumulative <= half, axis=1), last)]
        finite = np.isfinite(lower) & np.isfinite(upper)
        middle = lower + np.subtract(upper, lower, out=np.zeros(len(lower)), where=finite) / 2
        return np.where(half[:, 0] > 0, middle, np.nan)


def percentile_interval(
    statistic: Statistic, n_clusters: int, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Interval:
    """Percentile interval of numbers (B,) of counts (B, n_clusters), how often each is in a sample.

    For medians and their ratios: BCa's correction takes its acceleration from the jackknife, which
    is not consistent for medians (Efron & Tibshirani 1993, ch. 10.6). With one cluster there is
    nothing to resample, and the ends are NaN.
    """
    value = float(statistic(np.ones((1, max(n_clusters, 1))))[0])
    if n_clusters < 2 or np.isnan(value):
        return Interval(value, np.nan, np.nan)
    counts = rng.multinomial(n_clusters, np.full(n_clusters, 1 / n_clusters), size=resamples)
    drawn = statistic(counts.astype(np.float64))
    drawn = drawn[~np.isnan(drawn)]  # resamples in which no row had a value
    tail = (1 - CONFIDENCE) / 2
    # a quantile that is one of the draws: no arithmetic with infinite ones
    low, high = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Interval(value, float(low), float(high))


def median_interval(values: Float, clusters: Clusters, rng: np.random.Generator) -> Interval:
    """Median of rows (N,), whole clusters resampled."""
    return percentile_interval(WeightedMedian(values, clusters.codes), clusters.n, rng)


def weighted_mean_interval(
    values: Float, weights: Float, clusters: Clusters, rng: np.random.Generator
) -> Interval:
    """Weighted mean of rows (N,), whole clusters resampled."""
    sums = np.bincount(clusters.codes, values * weights, minlength=clusters.n)
    totals = np.bincount(clusters.codes, weights, minlength=clusters.n)

    def mean(counts: Float) -> Float:
        total = counts @ totals
        return counts @ sums / np.where(total > 0, total, np.nan)

    return percentile_interval(mean, clusters.n, rng)


def wilson(successes: ArrayLike, trials: ArrayLike) -> tuple[Float, Float]:
    """Lower and upper 95 % ends of the score interval of a binomial proportion (Wilson 1927).

    Unlike the textbook interval it keeps its level for few trials and for rates near 0 and 1.
    Counts need not be whole; where there are no trials, nothing is known: [0, 1].

    Raises:
        ValueError: negative counts, or more successes than trials.
    """
    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    if np.any(k < 0) or np.any(k > n + 1e-9 * (1 + n)):  # sums of fractions round
        raise ValueError("successes: must lie between 0 and trials")
    z2 = ndtri((1 + CONFIDENCE) / 2) ** 2
    known = n > 0
    rate = np.minimum(np.divide(k, n, out=np.full(n.shape, 0.5), where=known), 1.0)
    centre = (n * rate + z2 / 2) / (n + z2)
    half = np.sqrt(z2 * (n * rate * (1 - rate) + z2 / 4)) / (n + z2)
    # at rates of 0 and 1 centre and half cancel to within rounding
    low = np.where(known & (rate > 0), np.maximum(centre - half, 0.0), 0.0)
    high = np.where(known & (rate < 1), np.minimum(centre + half, 1.0), 1.0)
    return low, high


def effective_trials(rows_per_cluster: ArrayLike) -> float:
    """How many independent trials rows in clusters are worth at the least (Kish 1965).

    Whatever the dependence inside a cluster, a rate p over rows has a variance of at most
    p (1 - p) sum m_i^2 / (sum m_i)^2, reached when all rows of a cluster share one fate. So an
    interval with n = (sum m_i)^2 / sum m_i^2 trials never claims too much.
    """
    rows = np.asarray(rows_per_cluster, dtype=np.float64)
    total = rows.sum()
    return float(total**2 / np.sum(rows**2)) if total > 0 else 0.0


SIGNIFICANCE = 0.05
# With five, signs all alike would not reach 5 % (2 / 2^5 = 6 %), with six they do.
FEW_RUNS = 6
# An error without an estimate is infinitely far off. In a mean it counts as a factor of a thousand,
# a hall's length over an inch: no larger one says more.
LARGEST_LOG_RATIO = float(np.log(1e3))


class BetterTest(NamedTuple):
    """A mean change, its 95 % interval, and the two-sided p of there being none."""

    change: float
    low: float
    high: float
    p: float


def log_ratio(over: Float, under: Float) -> Float:
    """log(over / under); 0 where they are equal, also where both are 0 or infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: Float = np.log(over) - np.log(under)
    return np.where(over == under, 0.0, change)


def change_of_each_run(changes: Float, run_id: Any, n_runs: int, mean: bool = False) -> Float:
    """One change a run of changes (N,): the median over its maps (some are just lost), or the mean.

    Medians are for log ratios, which may be infinite, means for differences of shares. Where only a
    single run is compared, its maps stand in for runs.
    """
    if n_runs == 1:
        return changes
    groups = pd.Series(changes).groupby(np.asarray(run_id), sort=False)
    return np.asarray(groups.mean() if mean else groups.median(), dtype=np.float64)


def mean_change(changes: Float) -> BetterTest:
    """Student's t test that independent changes (n,), one a run, have a mean of 0.

    With fewer than two the interval and p are NaN; where nothing changed at all p is.
    """
    changes = np.clip(changes, -LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)
    if not len(changes):
        return BetterTest(np.nan, np.nan, np.nan, np.nan)
    mean = float(np.mean(changes))
    if len(changes) < 2:
        return BetterTest(mean, np.nan, np.nan, np.nan)
    if np.ptp(changes) == 0:  # t is infinite; what is left is that all signs agree
        p = float(2.0 ** (1 - len(changes))) if changes.any() else np.nan
        return BetterTest(mean, mean, mean, p)
    with warnings.catch_warnings():  # changes alike but for rounding
        warnings.simplefilter("ignore", RuntimeWarning)
        from scipy.stats import ttest_1samp  # the dearest import there is: where it is asked for

        tested: Any = ttest_1samp(changes, 0.0)
    low, high = tested.confidence_interval(CONFIDENCE)
    return BetterTest(mean, float(low), float(high), float(tested.pvalue))


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
