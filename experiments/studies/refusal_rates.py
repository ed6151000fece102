"""Rates of false and missed merges, and the finite-sample guarantee of verdicts.

Rates of the refusal study are by kind of world. False merges are counted per run and per pair of
maps: maps of one run at several iterations depend on each other. Pairs of maps of different seeds
count as pairs of maps only.

The guarantee bounds the share of runs with a false merge, with a confidence. Its unit is a run,
i.e. a scenario with a seed. A run is false if any accepted alignment of any method, of the filter's
maps or of the smoothed maps, is a false merge. Of n independent runs k are false, and the upper
bound of their share is the one of Clopper and Pearson (1934).

A higher `align.evidence.least_ratio` accepts less. Runs with a low one tell which alignments each
higher one would accept (column `log10_ratio_passed`). The lowest ratio with a guarantee is found by
fixed-sequence testing (Angelopoulos et al. 2021, "Learn then test", section 4): candidates are
tested in a fixed order, the highest first, until one fails. The probability of certifying a
candidate whose share of false runs is above alpha is then at most delta, without a correction for
the number of candidates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import betaincinv

from experiments.evaluation import alignment_criteria
from experiments.evaluation.alignment_criteria import (
    MERGEABLE_PAIRS,
    ORACLE,
    RUN_KEYS,
    has_common_ground,
    is_false_merge,
    right_refined,
)
from experiments.evaluation.tables import UNKNOWN, read_scenario
from experiments.pipeline.tables import BOOL, FLOAT, INT, TEXT, fields
from experiments.studies.intervals import Interval, clusters_of, weighted_mean_interval, wilson
from experiments.studies.run_tables import Runs
from mapfusion.errors import InputError
from mapfusion.files import schema
from mapfusion.geometry.numerics import Float
from mapfusion.verification.regions import EvidenceParameters

# Kinds of cases; `refusal_trial` describes them.
APART, COMMON = "apart", "common"
FEW, REPEATED = "few", "repeated"
POSTER_RADII_M = (0.5, 1.0, 2.0)  # of a poster, a mural, and half a wall


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
    return alignment_criteria.mergeable(rows[rows["ground"] == COMMON])


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


_SETTING = "align.evidence.least_ratio"
_PASSED = "log10_ratio_passed"
_TABLES = ("errors", "smoothed_errors")
_ERRORS = ("refined_translation_error_m", "refined_rotation_error_rad")
_COLUMNS = ("aligner", "accepted", *_ERRORS, "n_true", "n_common")
# Candidates, log10: fixed before the runs are seen. At the highest, no answer by chance is left
# according to the model of the regions; a step is a factor of 1.26, finer than runs can tell apart.
CANDIDATES = tuple(step / 10 for step in range(60, -1, -1))
TOTAL = "all scenarios"
# Right answers of all methods on mergeable pairs of maps, and the share that is accepted with its
# 95 % interval; whole runs are resampled.
_RIGHT = {"n_right": INT, **dict.fromkeys(("accepted", "accepted_low", "accepted_high"), FLOAT)}

# One row for each scenario, and one for all.
SHARES = schema(
    "verdicts.shares",
    1,
    fields(
        scenario=TEXT,
        n_runs=INT,
        n_false_runs=INT,
        false_runs_upper=FLOAT,  # one-sided bound of the share of false runs
        **_RIGHT,
    ),
)
# One row for each candidate, the highest first.
THRESHOLDS = schema(
    "verdicts.thresholds",
    1,
    fields(
        least_ratio=FLOAT,
        n_runs=INT,
        n_false_runs=INT,
        false_runs_upper=FLOAT,
        certified=BOOL,
        **_RIGHT,
    ),
)


def upper_bound(k: int, n: int, delta: float) -> float:
    """Return the one-sided Clopper-Pearson upper bound of a share, for k of n, at 1 - delta.

    It is the share p at which k or fewer of n have the probability delta, a quantile of the beta
    distribution with parameters k + 1 and n - k.
    """
    return 1.0 if k >= n else float(betaincinv(k + 1, n - k, 1 - delta))


def clean_runs_needed(alpha: float, delta: float) -> int:
    """Return the least n at which no false run of n has an upper bound of at most alpha."""
    return math.ceil(math.log(delta) / math.log1p(-alpha))


def lowest_certified(n_false: Sequence[int], n: int, alpha: float, delta: float) -> int | None:
    """Return the place of the last candidate that fixed-sequence testing certifies; None if none.

    Args:
        n_false: number of false runs with each candidate, in the order of the tests.
        n: number of runs.
        alpha: largest share of false runs.
        delta: largest probability of certifying a candidate with a larger share.
    """
    last = None
    for place, k in enumerate(n_false):
        if upper_bound(k, n, delta) > alpha:
            break
        last = place
    return last


class Answers(NamedTuple):
    """Accepted false answers, and right answers, of runs.

    Attributes:
        runs: RUN_KEYS and `passes`: log10 of the largest `least_ratio` that a false answer of the
            run passes; -inf without one.
        right: RUN_KEYS and `passes` of each right answer; -inf of those that are not accepted.
        n_with_any_ratio: number of accepted answers that count with every ratio: maps without
            viewing evidence, and tables of versions without the column.
    """

    runs: pd.DataFrame
    right: pd.DataFrame
    n_with_any_ratio: int

    @property
    def shared_seeds(self) -> list[int]:
        """Seeds of several scenarios, whose worlds may have parts in common."""
        seeds = self.runs["seed"]
        return sorted(set(seeds[seeds.duplicated()]))


def read_answers(runs: Runs) -> Answers:
    """Read the answers of all methods apart from the oracle.

    Raises:
        InputError: the truth of a run is unknown, or a scenario and seed occur in several runs.
    """
    false, right, n_with_any_ratio = [], [], 0
    for table in filter(runs.has, _TABLES):
        for rows in runs.batches(table, _COLUMNS, (_PASSED,)):
            rows = rows[rows["aligner"] != ORACLE]
            if len(unknown := rows[rows["n_common"] == UNKNOWN]):
                run_id = unknown["run_id"].iloc[0]
                raise InputError(f"run {run_id}: no truth is known, so false merges are not either")
            accepted = rows["accepted"] == 1
            n_with_any_ratio += int((accepted & rows[_PASSED].isna()).sum())
            passes = rows[_PASSED].fillna(math.inf).where(accepted, -math.inf)
            answers = rows[list(RUN_KEYS)].assign(passes=passes)
            is_right = rows.index.isin(alignment_criteria.mergeable(rows).index) & right_refined(
                rows
            )
            right.append(answers[is_right])
            of_false = answers.assign(passes=passes.where(is_false_merge(rows), -math.inf))
            false.append(_largest_of_runs(of_false))
    if not false:
        raise InputError("no table errors in these results (expected those of `run` or `sweep`)")
    found = _largest_of_runs(pd.concat(false)).sort_values(["scenario", "seed"], ignore_index=True)
    again = found[found.duplicated(["scenario", "seed"])]
    if len(again):
        name, seed = again[["scenario", "seed"]].iloc[0]
        what = "occurs in several runs, which are not independent; give those of one setting"
        raise InputError(f"scenario {name}, seed {seed}: {what}")
    return Answers(found, pd.concat(right, ignore_index=True), n_with_any_ratio)


def _largest_of_runs(answers: pd.DataFrame) -> pd.DataFrame:
    return answers.groupby(list(RUN_KEYS), sort=False)["passes"].max().reset_index()


def least_ratio_of(runs: Runs) -> float:
    """Return the largest `least_ratio` of the runs.

    Sweeps that do not set it are taken to have the default.
    """
    default = EvidenceParameters().least_ratio
    described = runs.described
    of_results = [result.run["run_id"] for result in runs.results]
    of_sweeps = described[~described["run_id"].isin(of_results)]
    # runs of a sweep with the setting and of one without it are read together
    varied = of_sweeps.get(_SETTING, pd.Series(default, of_sweeps.index, float))
    stated = varied.astype(float).fillna(default).tolist()
    for result in runs.results:
        settings = read_scenario(result.path / "scenario.json")
        stated.append(settings["align"].get("evidence", {}).get("least_ratio", default))
    return max(stated)


@dataclass(frozen=True)
class Guarantee:
    """Shares of false runs, and the thresholds that are certified.

    Attributes:
        alpha: largest share of runs with a false merge.
        delta: one minus the confidence.
        shares: rows of SHARES.
        thresholds: rows of THRESHOLDS.
        least_ratio: that of the runs; lower thresholds cannot be judged.
        answers: what the rows were computed from.
        n_failed: number of runs that failed and are not counted.
    """

    alpha: float
    delta: float
    shares: pd.DataFrame
    thresholds: pd.DataFrame
    least_ratio: float
    answers: Answers
    n_failed: int

    @property
    def certified(self) -> pd.Series | None:
        """Row of the lowest certified threshold; None if there is none."""
        rows = self.thresholds[self.thresholds["certified"]]
        return rows.iloc[-1] if len(rows) else None


def guarantee(runs: Runs, alpha: float, delta: float) -> Guarantee:
    """Compute the upper bounds of the shares of false runs, and the certified thresholds."""
    answers, least_ratio = read_answers(runs), least_ratio_of(runs)
    of_runs, right = answers.runs, answers.right
    groups = [
        (str(name), own, right[right["scenario"] == name])
        for name, own in of_runs.groupby("scenario")
    ]
    shares = []
    for name, own, own_right in [*groups, (TOTAL, of_runs, right)]:
        n, k = len(own), int(np.count_nonzero(own["passes"] > -math.inf))
        row = {"scenario": name, "n_runs": n, "n_false_runs": k}
        row |= {"false_runs_upper": upper_bound(k, n, delta)}
        shares.append(row | accepted_share(own_right, own_right["passes"] > -math.inf))
    # thresholds below the one in use would accept answers that these runs refused
    judged = [t for t in CANDIDATES if t >= math.log10(least_ratio) - 1e-9]
    n = len(of_runs)
    n_false = [int(np.count_nonzero(of_runs["passes"] >= t)) for t in judged]
    last = lowest_certified(n_false, n, alpha, delta)
    thresholds = [
        {
            "least_ratio": 10.0**t,
            "n_runs": n,
            "n_false_runs": k,
            "false_runs_upper": upper_bound(k, n, delta),
            "certified": last is not None and place <= last,
            **accepted_share(right, right["passes"] >= t),
        }
        for place, (t, k) in enumerate(zip(judged, n_false, strict=True))
    ]
    of_thresholds = pd.DataFrame(thresholds, columns=pd.Index(THRESHOLDS.names))
    n_failed = len(runs.failed)
    parts = (pd.DataFrame(shares), of_thresholds, least_ratio, answers, n_failed)
    return Guarantee(alpha, delta, *parts)


def accepted_share(right: pd.DataFrame, accepted: pd.Series) -> dict[str, Any]:
    """Return the columns of right answers: their number, the share accepted and its interval."""
    share = Interval(np.nan, np.nan, np.nan)
    if len(right):
        rng, weights = np.random.default_rng(0), np.ones(len(right))
        share = weighted_mean_interval(accepted.to_numpy(float), weights, clusters_of(right), rng)
    return {"n_right": len(right)} | share.columns("accepted")
