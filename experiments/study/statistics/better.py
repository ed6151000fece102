"""The one test of whether one thing is better than another: two versions, or two methods.

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
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.study.statistics.intervals import CONFIDENCE
from mapfusion.se2 import Float

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
