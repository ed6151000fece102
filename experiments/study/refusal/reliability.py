"""Does the probability that verdicts state hold? Reliability, Brier score, calibration error.

Of answers that beat chance, each with the probability stated for it and whether it is right. Runs
(or pairs of worlds that were crossed) are resampled whole. Beside it stands what support alone
says: a logistic curve over the logarithm of the false alarms, fitted to the other kinds of worlds.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from experiments.study.refusal.kind_rates import as_they_came
from experiments.study.statistics.intervals import Interval, percentile_interval
from mapfusion.se2 import Float

N_BINS = 10  # of equal count
RESAMPLES = 500  # an end at 2.5 % rests on a dozen


class Reliability(NamedTuple):
    """How stated probabilities compare with what is right.

    Attributes:
        bins: a row for each bin of equal count: `n`, mean `stated`, share `right` with its ends.
        calibration_error: mean over the bins of what stated and right differ by.
        brier: mean square of what is stated against what is (0 or 1).
        brier_of_support: the same of support alone, for kinds that it was not fitted to; NaN where
            there is one kind only, or where the others leave nothing to fit.
        n: answers.
        n_wrong: of these, wrong ones.
    """

    bins: pd.DataFrame
    calibration_error: Interval
    brier: Interval
    brier_of_support: float
    n: int
    n_wrong: int


def judged_answers(refusals: pd.DataFrame) -> pd.DataFrame:
    """The answers that beat chance and have a probability, with `right` and `run`."""
    rows = as_they_came(refusals)
    rows = rows[rows["beats_chance"] & rows["probability"].notna()]
    return rows.assign(run=rows["world_a"] + " " + rows["world_b"])


def reliability(answers: pd.DataFrame, rng: np.random.Generator) -> Reliability:
    """Hold `judged_answers` (at least one) against what is right."""
    codes, runs = pd.factorize(answers["run"])
    stated = answers["probability"].to_numpy(float)
    right = answers["right"].to_numpy(float)
    # of equal probabilities by lot: they lie in the table kind by kind
    place = _bins_of(np.lexsort([rng.permutation(len(stated)), stated]))
    sums = {
        name: _sums(values, codes, place, len(runs))
        for name, values in (("n", np.ones(len(stated))), ("stated", stated), ("right", right))
    }

    def error(counts: Float) -> Float:
        n, said, held = (np.einsum("bc,ck->bk", counts, sums[name]) for name in sums)
        return np.sum(np.abs(said - held), axis=1) / np.sum(n, axis=1)

    squared = np.bincount(codes, (stated - right) ** 2, len(runs))
    n_of_run = np.bincount(codes, minlength=len(runs))

    def brier(counts: Float) -> Float:
        return (counts @ squared) / (counts @ n_of_run)

    return Reliability(
        _bins(sums, rng),
        percentile_interval(error, len(runs), rng, RESAMPLES),
        percentile_interval(brier, len(runs), rng, RESAMPLES),
        _brier_of_support(answers),
        len(answers),
        int(np.count_nonzero(right == 0)),
    )


def calibration_error(stated: Float, right: Float) -> float:
    """Mean distance of what is stated (n,) and what holds (n,), over bins of equal count."""
    place = _bins_of(np.argsort(stated, kind="stable"))
    apart = np.bincount(place, stated - right, N_BINS)
    return float(np.sum(np.abs(apart))) / len(stated)


def _bins_of(order: np.ndarray) -> np.ndarray:
    """The bin (n,) of each, of N_BINS of equal count in this order (n,)."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order)) * N_BINS // len(order)
    return place


def _sums(values: Float, codes: np.ndarray, place: np.ndarray, n_runs: int) -> Float:
    """Sums (runs, N_BINS)."""
    sums = np.zeros((n_runs, N_BINS))
    np.add.at(sums, (codes, place), values)
    return sums


def _bins(sums: dict[str, Float], rng: np.random.Generator) -> pd.DataFrame:
    rows = []
    for k in range(N_BINS):
        n, held = sums["n"][:, k], sums["right"][:, k]
        if not n.sum():
            continue

        def share(counts: Float, n: Float = n, held: Float = held) -> Float:
            total = counts @ n
            return counts @ held / np.where(total > 0, total, np.nan)

        found = percentile_interval(share, len(n), rng, RESAMPLES)
        row = {"n": int(n.sum()), "stated": float(sums["stated"][:, k].sum() / n.sum())}
        rows.append(row | found.columns("right"))
    return pd.DataFrame(rows)


def _brier_of_support(answers: pd.DataFrame) -> float:
    """Brier score of support alone, each kind's fitted to the others."""
    support = -answers["log10_false_alarms"].to_numpy(float)
    x = np.log10(np.maximum(support, 1e-3))  # a hundred orders more are not a hundred times surer
    right, squares = answers["right"].to_numpy(bool), 0.0
    for kind in answers["kind"].unique():
        own = (answers["kind"] == kind).to_numpy()
        if right[~own].all() or not right[~own].any():
            return np.nan
        slope, offset = _logistic(x[~own], right[~own])
        squares += float(np.sum((expit(slope * x[own] + offset) - right[own]) ** 2))
    return squares / len(answers)


def _logistic(x: Float, right: np.ndarray) -> tuple[float, float]:
    """Slope and offset of the most likely logistic curve; held to finite ones where x separates."""
    sign = np.where(right, 1.0, -1.0)

    def cost(line: Float) -> float:
        weak_prior = 1e-3 * float(line @ line)
        return weak_prior - float(np.sum(log_expit(sign * (line[0] * x + line[1]))))

    slope, offset = minimize(cost, np.zeros(2)).x
    return float(slope), float(offset)
