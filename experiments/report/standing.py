"""How each aligner stands in the errors of one or more runs, and which one to use."""

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from experiments.metrics import ORACLE
from experiments.report.success import correct
from experiments.statistics.intervals import wilson

MAP_PAIR = ["run_id", "robot_a", "robot_b", "iteration"]  # two maps, given to all aligners alike
MIN_TRUE_PAIRS = 3  # fewer cannot carry an alignment: there is nothing an aligner could be right on
SIGNIFICANCE = 0.05  # of the sign tests that tell aligners apart


@dataclass(frozen=True)
class Standing:
    """One aligner's record.

    Attributes:
        aligner: its name.
        n_maps: pairs of maps with common ground (MIN_TRUE_PAIRS true correspondences or more).
        rate: share of them on which the refined estimate was correct (mean over repetitions).
        low: lower end of the rate's 95 % Wilson interval, pairs of maps counted once each.
        high: its upper end.
        estimated_m: median translation error as estimated, over those pairs; infinite where more
            than half have no estimate.
        estimated_rad: median absolute rotation error as estimated.
        refined_m: median translation error refined.
        refined_rad: median absolute rotation error refined.
        over_oracle: refined_m over the oracle's, on the same pairs.
        n_accepted: estimates that were accepted, on all pairs of maps.
        n_false: accepted ones that were wrong.
        time_ms: median time of one alignment; NaN where it was not measured.
    """

    aligner: str
    n_maps: int
    rate: float
    low: float
    high: float
    estimated_m: float
    estimated_rad: float
    refined_m: float
    refined_rad: float
    over_oracle: float
    n_accepted: int
    n_false: int
    time_ms: float


@dataclass(frozen=True)
class Verdict:
    """Which aligner to use.

    Attributes:
        best: the aligner, or None where no aligner was ever correct.
        equals: others that these data cannot tell from it, in their order of standing.
        standings: all aligners, the best first; the oracle is not among them.
        n_maps: pairs of maps, with common ground or without.
        n_common: those with common ground.
        n_runs: worlds and seeds, the only things here that are independent of each other.
        oracle_m: the oracle's median translation error on the pairs with common ground.
        oracle_rad: its median absolute rotation error.
    """

    best: Standing | None
    equals: tuple[str, ...]
    standings: tuple[Standing, ...]
    n_maps: int
    n_common: int
    n_runs: int
    oracle_m: float
    oracle_rad: float


def judge(errors: pd.DataFrame, timings: pd.DataFrame, order: list[str]) -> Verdict:
    """Rank the aligners.

    First by the share of correct results; among those a sign test cannot tell from the first, by
    the error as estimated, pair of maps by pair of maps; among those still equal, by time.

    Args:
        errors: the table `errors` with a column run_id, of one or more runs.
        timings: the table `aligner_timings` likewise; may be empty.
        order: the aligners' display order.
    """
    aligners = [name for name in order if name != ORACLE]
    judged = errors.assign(correct=correct(errors), accepted=accepted(errors))
    used = judged[judged["n_true"] >= MIN_TRUE_PAIRS]
    oracle = used[used["aligner"] == ORACLE]
    standings = {name: _standing(name, judged, used, oracle, timings) for name in aligners}
    maps = errors.drop_duplicates(MAP_PAIR)
    ranked, equals = _ranked(standings, used)
    best = ranked[0] if ranked and ranked[0].rate > 0 else None
    return Verdict(
        best,
        equals if best else (),
        tuple(ranked),
        len(maps),
        int((maps["n_true"] >= MIN_TRUE_PAIRS).sum()),
        errors["run_id"].nunique(),
        _median(oracle["refined_translation_error_m"]),
        _median(oracle["refined_rotation_error_rad"].abs()),
    )


def accepted(errors: pd.DataFrame) -> pd.Series:
    """Whether each refined estimate would be merged with."""
    if "accepted" in errors:
        return errors["accepted"].astype(bool)
    return errors["refined_status"] == "accepted"


def _standing(
    name: str,
    judged: pd.DataFrame,
    used: pd.DataFrame,
    oracle: pd.DataFrame,
    timings: pd.DataFrame,
) -> Standing:
    own = used[used["aligner"] == name]
    every = judged[judged["aligner"] == name]
    share = own.groupby(MAP_PAIR)["correct"].mean()
    low, high = wilson(share.sum(), len(share))
    refined_m, oracle_m = (_median(rows["refined_translation_error_m"]) for rows in (own, oracle))
    time_s = timings[timings["aligner"] == name]["elapsed_s"] if len(timings) else pd.Series([])
    return Standing(
        aligner=name,
        n_maps=len(share),
        rate=float(share.mean()) if len(share) else math.nan,
        low=float(low),
        high=float(high),
        estimated_m=_median(own["translation_error_m"]),
        estimated_rad=_median(own["rotation_error_rad"].abs()),
        refined_m=refined_m,
        refined_rad=_median(own["refined_rotation_error_rad"].abs()),
        over_oracle=refined_m / oracle_m if oracle_m > 0 else math.nan,
        n_accepted=int(every["accepted"].sum()),
        n_false=int((every["accepted"] & ~every["correct"]).sum()),
        time_ms=1e3 * float(time_s.median()) if len(time_s) else math.nan,
    )


def _median(values: pd.Series) -> float:
    """The median; no estimate at all counts as worse than any."""
    return float(values.fillna(np.inf).median()) if len(values) else math.nan


def _ranked(
    standings: dict[str, Standing], used: pd.DataFrame
) -> tuple[list[Standing], tuple[str, ...]]:
    """All standings, the best first, and who is equal to the best."""
    by_map = used.groupby(["aligner", *MAP_PAIR])
    rate = by_map["correct"].mean().unstack("aligner")
    # no estimate at all is worse than any error
    error = by_map["translation_error_m"].median().fillna(np.inf).unstack("aligner")

    def order(one: Standing) -> tuple[float, float, float]:
        return (-_last(one.rate, 0.0), _last(one.estimated_m), _last(one.time_ms))

    by_rate = sorted(standings.values(), key=order)
    if not by_rate or not len(rate):
        return by_rate, ()
    first = by_rate[0].aligner
    contenders = [s for s in by_rate if not _differ(-rate[first], -rate[s.aligner])]
    contenders.sort(key=lambda one: _last(one.estimated_m))
    first = contenders[0].aligner
    equal = [s for s in contenders if not _differ(error[first], error[s.aligner])]
    equal.sort(key=lambda one: _last(one.time_ms))
    rest = [s for s in contenders if s not in equal]
    others = [s for s in by_rate if s not in contenders]
    return [*equal, *rest, *others], tuple(s.aligner for s in equal[1:])


def _last(value: float, missing: float = math.inf) -> float:
    """A sorting key for what may not have been measured."""
    return missing if math.isnan(value) else value


def _differ(first: pd.Series, second: pd.Series) -> bool:
    """Two-sided sign test on paired figures: is one smaller more often than chance would have it?

    The pairs of one run are no independent draws, so this tells aligners apart too readily; a
    report of one run says so.
    """
    smaller, larger = int((first < second).sum()), int((first > second).sum())
    if smaller + larger == 0:
        return False
    return binomtest(smaller, smaller + larger).pvalue < SIGNIFICANCE
