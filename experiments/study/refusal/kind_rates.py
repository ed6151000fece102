"""What verdicts make of each kind of world: false merges, right answers lost, how early.

The unit of false merges is the run beside the pair of maps: maps of one run at several iterations
depend on each other. Pairs of maps of different seeds count among the latter.
"""

from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import (
    MERGEABLE_PAIRS,
    has_common_ground,
    is_false_merge,
    right_refined,
)
from experiments.study.refusal.cases import APART, COMMON
from experiments.study.refusal.refusal_rates import Rate, ordinary, without_common_ground

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
        {"kind": kind, "aligner": name} | _rates(own)
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


def _rates(own: pd.DataFrame) -> dict[str, Any]:
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
