"""Rates of the refusal study: false and missed merges, by kind of world, and reliability.

The unit of false merges is the run beside the pair of maps: maps of one run at several iterations
depend on each other. Pairs of maps of different seeds count among the latter.

Of answers that beat chance, each with the probability stated for it and whether it is right. Runs
(or pairs of worlds that were crossed) are resampled whole. Beside it stands what support alone
says: a logistic curve over the logarithm of the false alarms, fitted to the other kinds of worlds.
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
from experiments.studies.refusal.cases import APART, COMMON, FEW, POSTER_RADII_M
from mapfusion.geometry.numerics import Float


class Rate(NamedTuple):
    """A share of n with its Wilson interval; NaN of none."""

    hits: int
    n: int

    @classmethod
    def of(cls, hits: pd.Series) -> "Rate":
        """The share of rows that hold True."""
        return cls(int(hits.sum()), len(hits))

    @property
    def share(self) -> float:
        """Of n."""
        return self.hits / self.n if self.n else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval."""
        low, high = wilson(self.hits, self.n)
        return (float(low), float(high)) if self.n else (np.nan, np.nan)


def ordinary(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of maps of worlds that do not repeat themselves."""
    return rows[~rows["repeats"]]


def without_common_ground(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of maps as they came in which every merge is false."""
    return rows[(rows["ground"] == APART) | ((rows["ground"] == COMMON) & ~has_common_ground(rows))]


def mergeable(rows: pd.DataFrame) -> pd.DataFrame:
    """Pairs of one world as they came, with enough true correspondences for any robust method."""
    return criteria.mergeable(rows[rows["ground"] == COMMON])


def summary(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """One row an aligner, in their order: the rates in ordinary worlds at the operating point."""
    groups = ordinary(refusals).groupby("aligner", sort=False)
    return [{"aligner": name} | _rates(own) for name, own in groups]


def _rates(own: pd.DataFrame) -> dict[str, Rate]:
    accepted, right, ground = own["accepted"], right_refined(own), has_common_ground(own)
    wrong = accepted & ~right
    common, few = (own["ground"] == ground for ground in (COMMON, FEW))
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
    return {name: Rate.of(rows) for name, rows in hits.items()}


def swept(score: pd.Series, thresholds: Float) -> Float:
    """Share of scores up to each threshold (T,); a NaN is never accepted."""
    values = np.sort(score.dropna().to_numpy())
    return np.searchsorted(values, thresholds, side="right") / max(len(score), 1)


KEPT, AMBIGUOUS, TOO_UNCERTAIN, REFUSED = "accepted", "ambiguous", "too_uncertain", "refused"
VERDICTS = (KEPT, AMBIGUOUS, TOO_UNCERTAIN, REFUSED)
_MAPS = ["world_a", "robot_a", "world_b", "robot_b", "iteration"]
_RUN = ["kind", "world_a", "robot_a", "robot_b"]  # and method: one series of maps


def as_they_came(refusals: pd.DataFrame) -> pd.DataFrame:
    """Rows of pairs of maps that nobody has changed, with `right`, `false` and `verdict`.

    The verdict is one of VERDICTS: REFUSED for all that has another reason not to be used.
    """
    rows = refusals[refusals["ground"].isin([APART, COMMON])]
    right = right_refined(rows) & has_common_ground(rows)
    verdict = rows["status"].where(rows["status"].isin(VERDICTS), REFUSED)
    return rows.assign(right=right, false=is_false_merge(rows), verdict=verdict)


def right_answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Of `as_they_came`: right, with so many true pairs that to lose it is a miss."""
    return rows[rows["right"] & (rows["n_true"] >= MERGEABLE_PAIRS)]


def by_kind(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """A row for each kind and method, in the order of kinds' names and of the methods.

    Rates are of pairs of maps, `false_runs` of runs. `right_accepted` and so on are shares of right
    answers with MERGEABLE_PAIRS true pairs; `ambiguous` is that of all answers that beat chance,
    `on_ground` the share accepted, right or wrong, of maps with common ground. `first_*` are
    medians over runs of when a right answer is first accepted, `by_chance` under the test against
    chance alone: NaN where at least half of the runs never come to that.
    """
    rows = as_they_came(refusals)
    of_kind = {str(kind): own for kind, own in rows.groupby("kind")}
    return [
        {"kind": kind, "aligner": name} | _rates_of_kind(own)
        for kind, all_methods in of_kind.items()
        for name, own in all_methods.groupby("aligner", sort=False)
    ]


def of_any_method(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """A row for each kind: false merges by any of the methods, right answers of all of them.

    A pair of maps or a run counts as one however many methods answered for it.
    """
    rows = []
    for kind, own in as_they_came(refusals).groupby("kind"):
        in_one_world, right = own[own["world_a"] == own["world_b"]], right_answers(own)
        found = {
            "false_runs": in_one_world.groupby("world_a")["false"].any(),
            "false_pairs": _by_any(without_common_ground(own), "false"),
            "false_by_chance": _by_any(without_common_ground(own), "beats_chance"),
            "wrong_pairs": _by_any(own[has_common_ground(own)], "false"),
        }
        found |= {f"right_{verdict}": right["verdict"] == verdict for verdict in VERDICTS}
        rows.append({"kind": str(kind)} | {name: Rate.of(hits) for name, hits in found.items()})
    return rows


def first_of_ordinary(refusals: pd.DataFrame) -> list[dict[str, Any]]:
    """A row for each method: when a run's first right answer is accepted, and by chance alone.

    Medians over all runs of worlds that do not repeat themselves and come to common ground, as in
    `by_kind`; `n_runs` of them.
    """
    rows = as_they_came(ordinary(refusals))
    in_one_world = rows[rows["world_a"] == rows["world_b"]]
    ground = has_common_ground(in_one_world).groupby([in_one_world[name] for name in _RUN])
    in_reach = in_one_world[ground.transform("any")]
    return [
        {"aligner": name, "n_runs": own.groupby(_RUN).ngroups}
        | _first(own, "accepted", "")
        | _first(own, "beats_chance", "_by_chance")
        for name, own in in_reach.groupby("aligner", sort=False)
    ]


def _by_any(rows: pd.DataFrame, column: str) -> pd.Series:
    """Whether it holds of any method's answer for each two maps."""
    return rows.groupby(_MAPS)[column].any()


def _rates_of_kind(own: pd.DataFrame) -> dict[str, Any]:
    in_one_world = own[own["world_a"] == own["world_b"]]
    nothing, ground = without_common_ground(own), own[has_common_ground(own)]
    right, beating = right_answers(own), own[own["beats_chance"]]
    rates = {
        "false_runs": Rate.of(in_one_world.groupby("world_a")["false"].any()),
        "false_pairs": Rate.of(nothing["false"]),
        "false_by_chance": Rate.of(nothing["beats_chance"]),
        "wrong_pairs": Rate.of(ground["false"]),
        "on_ground": Rate.of(ground["accepted"]),
        "ambiguous": Rate.of(beating["verdict"] == AMBIGUOUS),
    }
    rates |= {f"right_{verdict}": Rate.of(right["verdict"] == verdict) for verdict in VERDICTS}
    return (
        rates
        | _first(in_one_world, "accepted", "")
        | _first(in_one_world, "beats_chance", "_by_chance")
    )


def _first(rows: pd.DataFrame, believed: str, suffix: str) -> dict[str, float]:
    """Median iteration and true pairs of each run's first right answer that is believed."""
    hits = rows[rows["right"] & rows[believed]].sort_values("iteration", kind="stable")
    first = hits.groupby(_RUN)[["iteration", "n_true"]].first()
    n_runs = rows.groupby(_RUN).ngroups
    found = {"first_iteration": first["iteration"], "first_true_pairs": first["n_true"]}
    return {f"{name}{suffix}": _median(values, n_runs) for name, values in found.items()}


def _median(values: pd.Series, n_runs: int) -> float:
    """Of runs, those without a value later than all others."""
    late = np.concatenate([values.to_numpy(float), np.full(n_runs - len(values), np.inf)])
    middle = float(np.median(late)) if len(late) else np.nan
    return middle if np.isfinite(middle) else np.nan


def worst(rows: list[dict[str, Any]], name: str) -> tuple[str, Rate]:
    """The method with the largest share among rows of one kind, with it; the first of equals."""
    known = [row for row in rows if row[name].n]
    if not known:
        return "", Rate(0, 0)
    row = max(known, key=lambda row: row[name].share)
    return row["aligner"], row[name]


def pooled(rows: list[dict[str, Any]], name: str) -> Rate:
    """The rate over all methods' answers of those rows."""
    return Rate(sum(row[name].hits for row in rows), sum(row[name].n for row in rows))


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
