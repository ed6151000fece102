"""Rates of the refusal study: false and missed merges, by kind of world.

False merges are counted per run and per pair of maps: maps of one run at several iterations depend
on each other. Pairs of maps of different seeds count as pairs of maps only.
"""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.evaluation import criteria
from experiments.evaluation.criteria import (
    MERGEABLE_PAIRS,
    has_common_ground,
    is_false_merge,
    right_refined,
)
from experiments.studies.intervals import wilson
from mapfusion.geometry.numerics import Float

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
