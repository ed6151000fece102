"""How each aligner stands on the maps of one or more runs, and which one to use."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from experiments.judge.metrics import ORACLE
from experiments.study.statistics.judged_maps import ANSWERABLE_PAIRS, MAP_KEYS
from experiments.study.statistics.success_rates import rates_of_maps

MAP_PAIR = ["run_id", *MAP_KEYS]  # two maps, given to all aligners alike
SIGNIFICANCE = 0.05  # of the sign tests that tell aligners apart


@dataclass(frozen=True)
class Standing:
    """One aligner's record.

    Attributes:
        aligner: its name.
        n_maps: pairs of maps with common ground (ANSWERABLE_PAIRS true correspondences or more).
        rate: share of them on which the refined estimate was right (mean over repetitions).
        low: lower end of the rate's 95 % Wilson interval; trials are runs, or the maps of one run.
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
        best: the aligner, or None where no aligner was ever right.
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


def judge(maps: pd.DataFrame, timings: pd.DataFrame, aligners: list[str]) -> Verdict:
    """Rank the aligners.

    First by the share of right results; among those a sign test cannot tell from the first, by the
    error as estimated, pair of maps by pair of maps; among those still equal, by time.

    Args:
        maps: rows of `maps_of`, of one or more runs.
        timings: the table `aligner_timings` likewise; may be empty.
        aligners: in display order.
    """
    used = maps[maps["n_true"] >= ANSWERABLE_PAIRS]
    oracle = used[used["aligner"] == ORACLE]
    rates = _rates(used)
    standings = [
        _standing(name, maps, used, oracle, rates, timings) for name in aligners if name != ORACLE
    ]
    pairs = maps.drop_duplicates(MAP_PAIR)
    ranked, equals = _ranked(standings, used)
    best = ranked[0] if ranked and ranked[0].rate > 0 else None
    return Verdict(
        best,
        equals if best else (),
        tuple(ranked),
        len(pairs),
        int((pairs["n_true"] >= ANSWERABLE_PAIRS).sum()),
        maps["run_id"].nunique(),
        _median(oracle["refined_translation_error_m"]),
        _median(oracle["refined_rotation_error_rad"]),
    )


def _rates(used: pd.DataFrame) -> dict[str, dict[Any, Any]]:
    if used.empty:
        return {}
    rates = rates_of_maps(used, "n_true", (ANSWERABLE_PAIRS, math.inf))
    return {row["aligner"]: row for row in rates.to_dict("records")}


def _standing(
    name: str,
    maps: pd.DataFrame,
    used: pd.DataFrame,
    oracle: pd.DataFrame,
    rates: dict[str, dict[Any, Any]],
    timings: pd.DataFrame,
) -> Standing:
    own, every = used[used["aligner"] == name], maps[maps["aligner"] == name]
    rate = rates.get(name, {})
    refined_m, oracle_m = (_median(rows["refined_translation_error_m"]) for rows in (own, oracle))
    time_s = timings[timings["aligner"] == name]["elapsed_s"] if len(timings) else pd.Series([])
    n_accepted, n_false = (
        round(float(np.nansum(every[column] * every["n_repetitions"])))
        for column in ("accepted", "false_accepted")
    )
    return Standing(
        aligner=name,
        n_maps=len(own),
        rate=rate.get("refined_success", math.nan),
        low=rate.get("refined_success_low", math.nan),
        high=rate.get("refined_success_high", math.nan),
        estimated_m=_median(own["translation_error_m"]),
        estimated_rad=_median(own["rotation_error_rad"]),
        refined_m=refined_m,
        refined_rad=_median(own["refined_rotation_error_rad"]),
        over_oracle=refined_m / oracle_m if oracle_m > 0 else math.nan,
        n_accepted=n_accepted,
        n_false=n_false,
        time_ms=1e3 * float(time_s.median()) if len(time_s) else math.nan,
    )


def _median(values: pd.Series) -> float:
    return float(values.median()) if len(values) else math.nan


def _ranked(
    standings: list[Standing], used: pd.DataFrame
) -> tuple[list[Standing], tuple[str, ...]]:
    """All standings, the best first, and who is equal to the best."""
    by_rate = sorted(
        standings, key=lambda s: (-_or_last(s.rate, 0.0), _or_last(s.estimated_m), s.time_ms)
    )
    if not by_rate or used.empty:
        return by_rate, ()
    failures, error = (
        used.assign(failures=1 - used["refined_success"]).pivot_table(
            index=MAP_PAIR, columns="aligner", values=column, dropna=False
        )
        for column in ("failures", "translation_error_m")
    )
    first = by_rate[0].aligner
    contenders = [s for s in by_rate if not _differ(failures[first], failures[s.aligner])]
    contenders.sort(key=lambda s: _or_last(s.estimated_m))
    first = contenders[0].aligner
    equal = [s for s in contenders if not _differ(error[first], error[s.aligner])]
    equal.sort(key=lambda s: _or_last(s.time_ms))
    rest = [s for s in contenders if s not in equal]
    others = [s for s in by_rate if s not in contenders]
    return [*equal, *rest, *others], tuple(s.aligner for s in equal[1:])


def _or_last(value: float, missing: float = math.inf) -> float:
    """A sorting key for what may not have been measured."""
    return missing if math.isnan(value) else value


def _differ(first: pd.Series, second: pd.Series) -> bool:
    """Two-sided sign test on paired figures: is one smaller more often than chance would have it?

    The maps of one run are no independent draws, so this tells aligners apart too readily; that the
    runs are few, the report says.
    """
    smaller, larger = int(np.sum(first < second)), int(np.sum(first > second))
    if smaller + larger == 0:
        return False
    return bool(binomtest(smaller, smaller + larger).pvalue < SIGNIFICANCE)
