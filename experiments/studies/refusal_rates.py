"""Rates of the refusal study: false and missed merges, by kind of world, and reliability.

False merges are counted per run and per pair of maps: maps of one run at several iterations depend
on each other. Pairs of maps of different seeds count as pairs of maps only.

Reliability compares the stated probabilities of answers that beat chance with the share of right
answers. The bootstrap resamples whole runs, or whole pairs of worlds. A logistic curve over the
logarithm of the false alarms, fitted to the other kinds of worlds, serves as reference.
"""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from experiments.evaluation import criteria
from experiments.evaluation.criteria import (
    MERGEABLE_PAIRS,
    has_common_ground,
    is_false_merge,
    right_refined,
)
from experiments.studies.intervals import Interval, percentile_interval, wilson
from experiments.studies.refusal_cases import APART, COMMON, FEW, POSTER_RADII_M
from mapfusion.geometry.numerics import Float


class Rate(NamedTuple):
    """Share of n cases with its Wilson interval; NaN without cases."""

    hits: int
    n: int

    @classmethod
    def of(cls, hits: pd.Series) -> "Rate":
        """Count the rows that are True."""
        return cls(int(hits.sum()), len(hits))

    @property
    def share(self) -> float:
        """Share of the cases."""
        return self.hits / self.n if self.n else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends of Wilson's 95 % interval."""
        low, high = wilson(self.hits, self.n)
        return (float(low), float(high)) if self.n else (np.nan, np.nan)


def ordinary(rows: pd.DataFrame) -> pd.DataFrame:
    """Return pairs of maps of worlds without repetition."""
    return rows[~rows["repeats"]]


def without_common_ground(rows: pd.DataFrame) -> pd.DataFrame:
    """Return unchanged pairs of maps without common ground: every merge is false."""
    return rows[(rows["ground"] == APART) | ((rows["ground"] == COMMON) & ~has_common_ground(rows))]


def mergeable(rows: pd.DataFrame) -> pd.DataFrame:
    """Return unchanged pairs of one world with enough true correspondences for a robust method."""
    return criteria.mergeable(rows[rows["ground"] == COMMON])


def summary(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rates in ordinary worlds at the threshold in use, one row per aligner."""
    rows = []
    for name, own in ordinary(refusals).groupby("aligner", sort=False):
        accepted, right, ground = own["accepted"], right_refined(own), has_common_ground(own)
        wrong = accepted & ~right
        common, few = (own["ground"] == kind for kind in (COMMON, FEW))
        able = own.index.isin(mergeable(own).index)
        hits = {
            "false": without_common_ground(own)["accepted"],
            "wrong": wrong[common & ground],
            "missed": ~accepted[able],
            "missed_though_right": ~accepted[able & right],
            "few_missed_though_right": ~accepted[few & right],
            "few_wrong": wrong[few],
        }
        for radius_m in POSTER_RADII_M:
            hits[f"poster_{radius_m:g}"] = accepted[own["poster_radius_m"] == radius_m]
        rows.append({"aligner": name} | {key: Rate.of(each) for key, each in hits.items()})
    return rows


def share_up_to(score: pd.Series, thresholds: Float) -> Float:
    """Return the share of scores up to each threshold, shape (T,); NaN is never accepted."""
    values = np.sort(score.dropna().to_numpy())
    return np.searchsorted(values, thresholds, side="right") / max(len(score), 1)


ACCEPTED, AMBIGUOUS, TOO_UNCERTAIN, REFUSED = "accepted", "ambiguous", "too_uncertain", "refused"
VERDICTS = (ACCEPTED, AMBIGUOUS, TOO_UNCERTAIN, REFUSED)
_MAPS = ["world_a", "robot_a", "world_b", "robot_b", "iteration"]
_RUN = ["kind", "world_a", "robot_a", "robot_b"]  # and aligner: one series of maps


def unchanged_pairs(refusals: pd.DataFrame) -> pd.DataFrame:
    """Return the unchanged pairs of maps, with columns `right`, `false` and `verdict`.

    The verdict is one of VERDICTS; REFUSED includes all other reasons for refusal.
    """
    rows = refusals[refusals["ground"].isin([APART, COMMON])]
    right = right_refined(rows) & has_common_ground(rows)
    verdict = rows["status"].where(rows["status"].isin(VERDICTS), REFUSED)
    return rows.assign(right=right, false=is_false_merge(rows), verdict=verdict)


def right_answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of `unchanged_pairs` that are right, with MERGEABLE_PAIRS or more true pairs."""
    return rows[rows["right"] & (rows["n_true"] >= MERGEABLE_PAIRS)]


def by_kind(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """Return one row for each kind of world and aligner, ordered by kind.

    Rates are of pairs of maps, `false_runs` of runs. `right_accepted` and so on are shares of right
    answers with MERGEABLE_PAIRS true pairs. `ambiguous` is a share of the answers that beat chance,
    `on_ground` the share of accepted answers, right or wrong, on maps with common ground. `first_*`
    are medians over runs of the iteration and true pairs of the first accepted right answer;
    `by_chance` uses only the test against chance. They are NaN if half of the runs have none.
    """
    rows = []
    for kind, all_methods in unchanged_pairs(refusals).groupby("kind"):
        for name, own in all_methods.groupby("aligner", sort=False):
            in_one_world = own[own["world_a"] == own["world_b"]]
            beating = own[own["beats_chance"]]
            rates = _false_merges(own) | {
                "on_ground": Rate.of(own[has_common_ground(own)]["accepted"]),
                "ambiguous": Rate.of(beating["verdict"] == AMBIGUOUS),
            }
            rates |= _verdicts_on_right_answers(own)
            first = _first(in_one_world, "accepted", "")
            first |= _first(in_one_world, "beats_chance", "_by_chance")
            rows.append({"kind": str(kind), "aligner": name} | rates | first)
    return rows


def of_any_method(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """Return one row for each kind: false merges by any aligner, right answers of all.

    For false merges, a pair of maps or a run counts once for all aligners.
    """
    return [
        {"kind": str(kind)} | _false_merges(own) | _verdicts_on_right_answers(own)
        for kind, own in unchanged_pairs(refusals).groupby("kind")
    ]


def _false_merges(own: pd.DataFrame) -> dict[str, Rate]:
    """Return the rates of false merges; a run or pair of maps counts once for all aligners."""
    in_one_world = own[own["world_a"] == own["world_b"]]
    apart = without_common_ground(own).groupby(_MAPS)
    hits = {
        "false_runs": in_one_world.groupby("world_a")["false"].any(),
        "false_pairs": apart["false"].any(),
        "false_by_chance": apart["beats_chance"].any(),
        "wrong_pairs": own[has_common_ground(own)].groupby(_MAPS)["false"].any(),
    }
    return {name: Rate.of(each) for name, each in hits.items()}


def _verdicts_on_right_answers(own: pd.DataFrame) -> dict[str, Rate]:
    """Return the share of each verdict among right answers."""
    verdicts = right_answers(own)["verdict"]
    return {f"right_{verdict}": Rate.of(verdicts == verdict) for verdict in VERDICTS}


def first_right_answers(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the `first_*` columns of `by_kind` for each aligner, and the number of runs.

    Medians are over all runs with common ground in worlds without repetition.
    """
    rows = unchanged_pairs(ordinary(refusals))
    in_one_world = rows[rows["world_a"] == rows["world_b"]]
    ground = has_common_ground(in_one_world).groupby([in_one_world[name] for name in _RUN])
    in_reach = in_one_world[ground.transform("any")]
    return [
        {"aligner": name, "n_runs": own.groupby(_RUN).ngroups}
        | _first(own, "accepted", "")
        | _first(own, "beats_chance", "_by_chance")
        for name, own in in_reach.groupby("aligner", sort=False)
    ]


def _first(rows: pd.DataFrame, believed: str, suffix: str) -> dict[str, float]:
    """Return median iteration and true pairs of each run's first accepted right answer."""
    hits = rows[rows["right"] & rows[believed]].sort_values("iteration", kind="stable")
    first = hits.groupby(_RUN)[["iteration", "n_true"]].first()
    n_runs = rows.groupby(_RUN).ngroups
    found = {}
    for name, column in (("first_iteration", "iteration"), ("first_true_pairs", "n_true")):
        values = first[column]
        # Runs without such an answer count as later than all others.
        late = np.concatenate([values.to_numpy(float), np.full(n_runs - len(values), np.inf)])
        median = float(np.median(late)) if len(late) else np.nan
        found[f"{name}{suffix}"] = median if np.isfinite(median) else np.nan
    return found


def worst(rows: list[dict[str, Any]], name: str) -> tuple[str, Rate]:
    """Return the aligner with the largest rate among rows of one kind, and the rate."""
    known = [row for row in rows if row[name].n]
    if not known:
        return "", Rate(0, 0)
    row = max(known, key=lambda row: row[name].share)
    return row["aligner"], row[name]


def pooled(rows: list[dict[str, Any]], name: str) -> Rate:
    """Return the rate over the answers of all aligners."""
    return Rate(sum(row[name].hits for row in rows), sum(row[name].n for row in rows))


N_BINS = 10  # of equal count
RESAMPLES = 500  # a dozen lie outside each end of a 95 % interval


class Reliability(NamedTuple):
    """Reliability of stated probabilities.

    Attributes:
        bins: one row for each bin of equal count: `n`, mean `stated`, share `right` with its ends.
        calibration_error: mean absolute difference of stated and right, over bins.
        brier: mean squared difference of the stated probability and the outcome (0 or 1).
        brier_of_support: Brier score of a probability from the support, for kinds of worlds that
            were not used to fit it; NaN for a single kind, or if the others allow no fit.
        n: number of answers.
        n_wrong: number of wrong answers.
    """

    bins: pd.DataFrame
    calibration_error: Interval
    brier: Interval
    brier_of_support: float
    n: int
    n_wrong: int


def answers_with_probability(refusals: pd.DataFrame) -> pd.DataFrame:
    """Return the answers that beat chance and have a probability, with `right` and `run`."""
    rows = unchanged_pairs(refusals)
    rows = rows[rows["beats_chance"] & rows["probability"].notna()]
    return rows.assign(run=rows["world_a"] + " " + rows["world_b"])


def reliability(answers: pd.DataFrame, rng: np.random.Generator) -> Reliability:
    """Compare the probabilities of `answers_with_probability` (at least one) with the truth."""
    codes, runs = pd.factorize(answers["run"])
    stated = answers["probability"].to_numpy(float)
    right = answers["right"].to_numpy(float)
    # Random order of equal probabilities: the table is sorted by kind.
    place = _bins_of(np.lexsort([rng.permutation(len(stated)), stated]))
    sums = {name: np.zeros((len(runs), N_BINS)) for name in ("n", "stated", "right")}
    for name, values in (("n", np.ones(len(stated))), ("stated", stated), ("right", right)):
        np.add.at(sums[name], (codes, place), values)

    def error(counts: Float) -> Float:
        n, stated, held = (np.einsum("bc,ck->bk", counts, sums[name]) for name in sums)
        return np.sum(np.abs(stated - held), axis=1) / np.sum(n, axis=1)

    squared = np.bincount(codes, (stated - right) ** 2, len(runs))
    n_of_run = np.bincount(codes, minlength=len(runs))

    def brier(counts: Float) -> Float:
        return (counts @ squared) / (counts @ n_of_run)

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
    return Reliability(
        pd.DataFrame(rows),
        percentile_interval(error, len(runs), rng, RESAMPLES),
        percentile_interval(brier, len(runs), rng, RESAMPLES),
        _brier_of_support(answers),
        len(answers),
        int(np.count_nonzero(right == 0)),
    )


def calibration_error(stated: Float, right: Float) -> float:
    """Return the mean absolute difference of stated (n,) and right (n,), over equal bins."""
    place = _bins_of(np.argsort(stated, kind="stable"))
    apart = np.bincount(place, stated - right, N_BINS)
    return float(np.sum(np.abs(apart))) / len(stated)


def _bins_of(order: np.ndarray) -> np.ndarray:
    """Return the bin of each item, shape (n,), for N_BINS of equal count in an order (n,)."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order)) * N_BINS // len(order)
    return place


def _brier_of_support(answers: pd.DataFrame) -> float:
    """Return the Brier score of a logistic curve over the support, fitted to the other kinds."""
    support = -answers["log10_false_alarms"].to_numpy(float)
    x = np.log10(np.maximum(support, 1e-3))  # diminishing certainty of large support
    right, squares = answers["right"].to_numpy(bool), 0.0
    for kind in answers["kind"].unique():
        own = (answers["kind"] == kind).to_numpy()
        if right[~own].all() or not right[~own].any():
            return np.nan
        x_fit, sign = x[~own], np.where(right[~own], 1.0, -1.0)

        def cost(line: Float, x_fit: Float = x_fit, sign: Float = sign) -> float:
            # The weak prior keeps the curve finite if x separates right from wrong.
            weak_prior = 1e-3 * float(line @ line)
            return weak_prior - float(np.sum(log_expit(sign * (line[0] * x_fit + line[1]))))

        slope, offset = map(float, minimize(cost, np.zeros(2)).x)
        squares += float(np.sum((expit(slope * x[own] + offset) - right[own]) ** 2))
    return squares / len(answers)
