"""How each aligner stands on the maps of one or more runs, and which one to use."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE, answerable, has_common_ground, rich
from experiments.judge.judged_maps import ERROR_COLUMNS, MAP_PAIR, error_over_oracle, maps_of
from experiments.judge.metrics import repetition_spread_m
from experiments.judge.tables import SHOWN
from experiments.study.statistics import better
from experiments.study.statistics.methods_compared import paired_values
from experiments.study.statistics.success_rates import success_rates
from mapfusion.align.result import Status

# Aligners are equal if the test does not tell them apart and what was measured lies no farther
# apart than this: what few runs cannot prove they do not disprove either. Shares: by one map, which
# chance decides, or of many by one in twenty: the robots go on and meet there again, and a merge
# that now and then comes later costs less than larger errors or more time everywhere.
_EQUAL_SHARE = 0.05
_ROUNDING = 1e-9  # in sums of repetitions' shares
# Errors: by the median map, which a lost one does not move. Good estimates are a few decimetres
# off: a tenth of that is less than the maps' own drift, and the refinement evens it out.
_EQUAL_LOG_RATIO = math.log(1.1)

# The names that a `Standing` has for columns of `SHOWN`, and for the rates' of `success_rates`.
_ERRORS = dict(
    zip(ERROR_COLUMNS, ("estimated_m", "estimated_rad", "refined_m", "refined_rad"), strict=True)
)
_RATES = {"refined_success": "rate", "refined_success_low": "low", "refined_success_high": "high"}


@dataclass(frozen=True)
class Standing:
    """One aligner's record.

    On `n_maps` pairs of maps with common ground it was right, refined, at the `rate`, with its 95 %
    Wilson interval (trials are runs, or the maps of one run). Errors are medians over answerable
    maps, infinite where more than half have no estimate; over the oracle's refined ones on rich
    maps. On all maps `n_accepted` estimates were accepted, `n_false` of them wrongly. `shown` are
    the further columns of `SHOWN`.
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

    `best` is None where no aligner was ever right; these data cannot tell the `equals` from it.
    `standings` are all aligners but the oracle, the best first. Of `n_maps` pairs of maps
    `n_common` have common ground. Runs of different worlds are the only things here that are
    independent of each other; runs of one scenario and seed share their world.
    """

    best: Standing | None
    equals: tuple[str, ...]
    standings: tuple[Standing, ...]
    n_maps: int
    n_common: int
    n_runs: int
    n_worlds: int
    n_scenarios: int
    oracle_m: float
    oracle_rad: float


def aligner_summary(
    errors: pd.DataFrame, timings: pd.DataFrame, aligners: Sequence[str]
) -> pd.DataFrame:
    """The shown columns of the table `errors`, reduced as `tables.Shown` says, for each aligner.

    With spread_m, the 10-90 % range of the repetitions, and time_ms, where there are timings.
    """
    errors = errors[errors["status"] != Status.ABSENT]
    own = {name: answerable(errors[errors["aligner"] == name]) for name in aligners}
    shown = _shown_columns(maps_of(errors)).reindex(pd.Index(aligners, name="aligner"))
    spread_m = [repetition_spread_m(rows) for rows in own.values()]
    return shown.assign(spread_m=spread_m, time_ms=_median_times_ms(timings)).reset_index()


def _shown_columns(maps: pd.DataFrame) -> pd.DataFrame:
    """By aligner, the columns of `SHOWN` from rows of `maps_of`; NaN where these have none."""
    names = {
        kind: [name for name, how in SHOWN.items() if how.kind == kind and name in maps]
        for kind in ("error", "given", "share")
    }
    answers = answerable(maps).groupby("aligner", sort=False)
    ground = maps[has_common_ground(maps)].groupby("aligner", sort=False)
    parts = [answers[names["error"]].median(), answers[names["given"]].mean()]
    return pd.concat([*parts, ground[names["share"]].mean()], axis=1).reindex(columns=list(SHOWN))


def _median_times_ms(timings: pd.DataFrame) -> pd.Series:
    """Median time of one alignment, by aligner."""
    if timings.empty:
        return pd.Series(dtype=np.float64)
    return 1e3 * timings.groupby("aligner")["elapsed_s"].median()


def recommend(maps: pd.DataFrame, timings: pd.DataFrame, aligners: list[str]) -> Recommendation:
    """Rank the aligners, given in display order, by rows of `maps_of` and of `aligner_timings`.

    First by the share of right results; among those equal to the first, by the error as estimated,
    pair of maps by pair of maps; among those still equal, by time, where there are timings.
    `better` tells what the test takes for a unit; of a single run the ranking is a hint.
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
        len(maps[["scenario", "seed"]].drop_duplicates()),
        maps["scenario"].nunique(),
        float(oracle["refined_translation_error_m"].median()),
        float(oracle["refined_rotation_error_rad"].median()),
    )


def _standings(maps: pd.DataFrame, timings: pd.DataFrame, aligners: list[str]) -> list[Standing]:
    is_ground = has_common_ground(maps)
    times = maps[["accepted", "false_accepted"]].mul(maps["n_repetitions"], axis=0)
    counted = times.set_axis(["n_accepted", "n_false"], axis=1).assign(n_maps=is_ground)
    counts = counted.groupby(maps["aligner"]).sum().round()
    shown = _shown_columns(maps)
    found = shown[list(_ERRORS)].rename(columns=_ERRORS).reindex(aligners)
    found = found.assign(
        over_oracle=error_over_oracle(rich(maps), "refined_translation_error_m"),
        time_ms=_median_times_ms(timings),
        **dict.fromkeys(_RATES.values(), math.nan),
    )
    if is_ground.any():
        rates = success_rates(maps[is_ground], "n_common", (0, math.inf)).set_index("aligner")
        found = found.assign(**{name: rates[column] for column, name in _RATES.items()})
    rows: Any = found.join(counts.reindex(aligners, fill_value=0).astype(int)).to_dict("index")
    further: Any = shown.drop(columns=list(_ERRORS)).to_dict("index")
    return [Standing(aligner=name, shown=further.get(name, {}), **rows[name]) for name in aligners]


def _ranked(
    standings: list[Standing], ground: pd.DataFrame
) -> tuple[list[Standing], tuple[str, ...]]:
    """All standings, the best first, and who is equal to the best."""
    by_rate = sorted(
        standings, key=lambda s: (-_or_last(s.rate, 0.0), _or_last(s.estimated_m), s.time_ms)
    )
    if not by_rate or ground.empty:
        return by_rate, ()
    contenders = _equal_to_first(by_rate, ground, "refined_success")
    contenders.sort(key=lambda s: _or_last(s.estimated_m))
    equal = _equal_to_first(contenders, ground, "translation_error_m")
    equal.sort(key=lambda s: _or_last(s.time_ms))
    rest = [s for s in contenders if s not in equal]
    others = [s for s in by_rate if s not in contenders]
    return [*equal, *rest, *others], tuple(s.aligner for s in equal[1:])


def _or_last(value: float, missing: float = math.inf) -> float:
    """A sorting key for what may not have been measured."""
    return missing if math.isnan(value) else value


def _equal_to_first(standings: list[Standing], maps: pd.DataFrame, column: str) -> list[Standing]:
    """The first, and those that neither the test nor the band tells from it in this column."""
    values, is_share = paired_values(maps, column), column == "refined_success"
    p_values, near = [], []
    for standing in standings[1:]:
        judged = values[[standings[0].aligner, standing.aligner]].dropna()  # by both
        n, (first, own) = len(judged), judged.to_numpy(np.float64).T
        changes = own - first if is_share else better.log_ratio(own, first)
        run_id = judged.index.get_level_values("run_id")
        n_runs = maps["run_id"].nunique()
        of_runs = better.change_of_each_run(changes, run_id, n_runs, is_share)
        p_values.append(better.mean_change(of_runs).p)
        apart = pd.Series(changes).clip(-better.LARGEST_LOG_RATIO, better.LARGEST_LOG_RATIO)
        if is_share:
            near.append(abs(apart.mean()) * n <= max(1, _EQUAL_SHARE * n) + _ROUNDING)
        else:
            near.append(abs(apart.median()) <= _EQUAL_LOG_RATIO)
    same = np.array(near, bool) & ~(better.holm(np.array(p_values)) <= better.SIGNIFICANCE)
    return [standings[0], *compress(standings[1:], same)]
