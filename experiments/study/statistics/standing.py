"""How each aligner stands on the maps of one or more runs, and which one to use."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE, answerable, has_common_ground, rich
from experiments.judge.judged_maps import MAP_PAIR, error_over_oracle
from experiments.study.statistics.aligner_summary import median_time_ms, shown_columns
from experiments.study.statistics.better import (
    SIGNIFICANCE,
    change_of_each_run,
    holm,
    log_ratio,
    mean_change,
)
from experiments.study.statistics.paired import paired_values
from experiments.study.statistics.success_rates import success_rates
from mapfusion.se2 import Float

# Aligners are equal if the test does not tell them apart and what was measured lies no farther
# apart than this: what few runs cannot prove they do not disprove either.
_EQUAL_SHARE = 0.05
_EQUAL_LOG_RATIO = math.log(1.1)


@dataclass(frozen=True)
class Standing:
    """One aligner's record.

    Attributes:
        aligner: its name.
        n_maps: pairs of maps with common ground.
        rate: share of them on which the refined estimate was right (mean over repetitions).
        low: lower end of the rate's 95 % Wilson interval; trials are runs, or the maps of one run.
        high: its upper end.
        estimated_m: median translation error as estimated, over answerable maps; infinite where
            more than half have no estimate.
        estimated_rad: median absolute rotation error as estimated.
        refined_m: median translation error refined.
        refined_rad: median absolute rotation error refined.
        over_oracle: median refined translation error over the oracle's, on rich maps.
        n_accepted: estimates that were accepted, on all pairs of maps.
        n_false: accepted ones that were wrong.
        time_ms: median time of one alignment; NaN where it was not measured.
        shown: further columns of `errors` that are shown (`tables.SHOWN`), reduced.
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
    shown: dict[str, float]


@dataclass(frozen=True)
class Recommendation:
    """Which aligner to use.

    Attributes:
        best: the aligner, or None where no aligner was ever right.
        equals: others that these data cannot tell from it, in their order of standing.
        standings: all aligners, the best first; the oracle is not among them.
        n_maps: pairs of maps, with common ground or without.
        n_common: those with common ground.
        n_runs: worlds and seeds, the only things here that are independent of each other.
        oracle_m: the oracle's median translation error on answerable maps.
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


def recommend(maps: pd.DataFrame, timings: pd.DataFrame, aligners: list[str]) -> Recommendation:
    """Rank the aligners.

    First by the share of right results; among those equal to the first, by the error as estimated,
    pair of maps by pair of maps; among those still equal, by time. `better` tells what the test
    takes for a unit; of a single run the ranking is a hint.

    Args:
        maps: rows of `maps_of`, of one or more runs.
        timings: the table `aligner_timings` likewise; may be empty.
        aligners: in display order.
    """
    ground = maps[has_common_ground(maps)]
    standings = _standings(maps, timings, [name for name in aligners if name != ORACLE])
    ranked, equals = _ranked(standings, ground)
    best = ranked[0] if ranked and ranked[0].rate > 0 else None
    oracle = answerable(maps[maps["aligner"] == ORACLE])
    return Recommendation(
        best,
        equals if best else (),
        tuple(ranked),
        len(maps.drop_duplicates(MAP_PAIR)),
        len(ground.drop_duplicates(MAP_PAIR)),
        maps["run_id"].nunique(),
        float(oracle["refined_translation_error_m"].median()),
        float(oracle["refined_rotation_error_rad"].median()),
    )


def _standings(maps: pd.DataFrame, timings: pd.DataFrame, aligners: list[str]) -> list[Standing]:
    ground = maps[has_common_ground(maps)]
    rates = success_rates(ground, "n_common", (0, math.inf)) if len(ground) else pd.DataFrame()
    rate_of = {row["aligner"]: row for row in rates.to_dict("records")}
    shown = shown_columns(maps)
    over_oracle = error_over_oracle(rich(maps), "refined_translation_error_m")
    standings = []
    for name in aligners:
        own = maps[maps["aligner"] == name]
        rate, row = rate_of.get(name, {}), shown.get(name, {})
        n_accepted, n_false = (
            round(float(np.nansum(own[column] * own["n_repetitions"])))
            for column in ("accepted", "false_accepted")
        )
        standings.append(
            Standing(
                aligner=name,
                n_maps=int(has_common_ground(own).sum()),
                rate=rate.get("refined_success", math.nan),
                low=rate.get("refined_success_low", math.nan),
                high=rate.get("refined_success_high", math.nan),
                estimated_m=row.pop("translation_error_m", math.nan),
                estimated_rad=row.pop("rotation_error_rad", math.nan),
                refined_m=row.pop("refined_translation_error_m", math.nan),
                refined_rad=row.pop("refined_rotation_error_rad", math.nan),
                over_oracle=float(over_oracle.get(name, math.nan)),
                n_accepted=n_accepted,
                n_false=n_false,
                time_ms=median_time_ms(timings, name),
                shown=row,
            )
        )
    return standings


def _ranked(
    standings: list[Standing], ground: pd.DataFrame
) -> tuple[list[Standing], tuple[str, ...]]:
    """All standings, the best first, and who is equal to the best."""
    by_rate = sorted(
        standings, key=lambda s: (-_or_last(s.rate, 0.0), _or_last(s.estimated_m), s.time_ms)
    )
    if not by_rate or ground.empty:
        return by_rate, ()
    success = paired_values(ground, "refined_success")
    contenders = _equal_to_first(by_rate, success, np.subtract, _EQUAL_SHARE)
    contenders.sort(key=lambda s: _or_last(s.estimated_m))
    error = paired_values(ground, "translation_error_m")
    equal = _equal_to_first(contenders, error, log_ratio, _EQUAL_LOG_RATIO)
    equal.sort(key=lambda s: _or_last(s.time_ms))
    rest = [s for s in contenders if s not in equal]
    others = [s for s in by_rate if s not in contenders]
    return [*equal, *rest, *others], tuple(s.aligner for s in equal[1:])


def _or_last(value: float, missing: float = math.inf) -> float:
    """A sorting key for what may not have been measured."""
    return missing if math.isnan(value) else value


def _equal_to_first(
    standings: list[Standing],
    values: pd.DataFrame,
    change_of: Callable[[Float, Float], Float],
    slack: float,
) -> list[Standing]:
    """The first, and those that the test does not tell from it."""
    first = values[standings[0].aligner].to_numpy()
    run_id = values.index.get_level_values("run_id")
    tests = []
    n_runs, mean = run_id.nunique(), change_of is np.subtract
    for standing in standings[1:]:
        changes = change_of(values[standing.aligner].to_numpy(), first)
        known = ~np.isnan(changes)
        changes = change_of_each_run(changes[known], run_id[known], n_runs, mean)
        tests.append(mean_change(changes))
    p_holm = holm(np.array([test.p for test in tests]))
    return [standings[0]] + [
        standing
        for standing, test, p in zip(standings[1:], tests, p_holm, strict=True)
        if not p <= SIGNIFICANCE and abs(test.change) <= slack
    ]
