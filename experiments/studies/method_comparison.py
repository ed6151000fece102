"""Comparison of aligners: success rates, paired comparison, and a recommendation.

Rows of one run depend on each other: maps grow from earlier maps, pairs share robots, and
repetitions share maps. So the trials of Wilson's interval are runs (`effective_trials`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, compress, pairwise
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_criteria import (
    ERROR_COLUMNS,
    MAP_PAIR,
    ORACLE,
    answerable,
    at_last_iteration,
    error_over_oracle,
    has_common_ground,
    methods_in,
    repetition_spread_m,
    rich,
    summarise_alignments,
)
from experiments.evaluation.tables import SHOWN
from experiments.studies import intervals
from experiments.studies.intervals import (
    RUN,
    Interval,
    WeightedMedian,
    change_of_each_run,
    clusters_of,
    effective_trials,
    holm,
    log_ratio,
    mean_change,
    wilson,
)
from mapfusion.align.alignment import Status
from mapfusion.geometry.numerics import Float

LAST = "last"
# Counts roughly double or triple from bin to bin; bins of shares are narrow where methods begin to
# fail. With fewer than 3 true pairs even the oracle has no useful answer.
_COUNT_EDGES = (0, 3, 10, 30, 100, 300, 1000, np.inf)
EDGES: dict[str, tuple[float, ...]] = {
    "n_common": _COUNT_EDGES,
    "n_true": _COUNT_EDGES,
    "overlap_share": (0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1),
    "outlier_share": (0, 0.2, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1),
    LAST: (0, np.inf),
}
BY = ("iteration", *EDGES)
_ITERATION_BINS = 8
_WITHOUT_TEST = ("estimated_success", "refined_success")
_WITH_TEST = (*_WITHOUT_TEST, "accepted", "false_accepted", "refused_apart")


def success_rates(
    maps: pd.DataFrame, by: str, edges: Sequence[float] | None = None
) -> pd.DataFrame:
    """Return binned success rates of each method over alignment summaries.

    Args:
        maps: alignment summaries; for overlap_share, rows that `with_overlap_share` returned.
        by: iteration, n_common (landmarks that truly correspond), overlap_share (n_common over
            the smaller map's landmarks), n_true (true pairs among the correspondences),
            outlier_share (1 - n_true / n_correspondences) or last (only the last iteration of each
            robot pair).
        edges: increasing edges of the bins; a bin includes its lower edge, the last bin both.

    Returns:
        One row per bin and method: from, to, aligner, n_runs, n_maps, n_apart (maps without common
        ground), unit, and shares with their 95 % interval (_low, _high): estimated_success,
        refined_success and accepted among maps with common ground; false_accepted among all maps;
        refused_apart among maps without common ground. Only the first two without a verdict.

    Raises:
        ValueError: `by` is unknown, or edges do not increase.
    """
    if by not in BY:
        raise ValueError(f"by: is {by}, expected one of {', '.join(BY)}")
    if by != LAST and by not in maps:
        raise ValueError(f"by: these rows have no {by}")
    used = at_last_iteration(maps) if by == LAST else maps
    clusters = clusters_of(used)
    # for LAST a single bin holds all rows
    values = used["n_common" if by == LAST else by].to_numpy(dtype=np.float64)
    if edges is None and by == "iteration":
        iterations = np.unique(values)
        groups = np.array_split(iterations, min(_ITERATION_BINS, len(iterations)))
        edges = [*(group[0] for group in groups), values.max() + 1]
    chosen = np.asarray(EDGES[by] if edges is None else edges, dtype=np.float64)
    if len(chosen) < 2 or np.any(np.diff(chosen) <= 0):
        raise ValueError("edges: must be two or more in increasing order")
    place = np.searchsorted(chosen, values, side="right") - 1
    place[values == chosen[-1]] = len(chosen) - 2
    rows = []
    for number, limits in enumerate(pairwise(chosen)):
        for aligner in methods_in(maps, oracle=True):
            inside = (place == number) & (used["aligner"] == aligner).to_numpy()
            if inside.any():
                row = dict(zip(("from", "to"), limits, strict=True)) | {"aligner": aligner}
                # shares of this bin and method, with their intervals
                own, codes = used[inside], clusters.codes[inside]
                ground = has_common_ground(own).to_numpy()
                row |= {"n_runs": own["run_id"].nunique(), "n_maps": len(own)}
                row |= {"n_apart": int(np.count_nonzero(~ground))}
                for name in _WITH_TEST if own["accepted"].notna().any() else _WITHOUT_TEST:
                    known = own[name].notna().to_numpy() & (ground if name == "accepted" else True)
                    share = low = high = np.nan
                    if known.any():
                        n = effective_trials(np.unique(codes[known], return_counts=True)[1])
                        share = float(own[name][known].mean())
                        low, high = map(float, wilson(share * n, n))
                    row |= {name: share, f"{name}_low": low, f"{name}_high": high}
                rows.append(row | {"unit": clusters.unit})
    rates = pd.DataFrame(rows)
    return rates.drop(columns=["from", "to"]) if by == LAST else rates


STAGES = {"estimated": "translation_error_m", "refined": "refined_translation_error_m"}


def oracle_ratios(maps: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Return each method's median translation error over the oracle's, estimated and refined.

    Only rich maps of the alignment summaries count. Medians are over runs, robot pairs and
    iterations. For intervals whole runs are resampled, the same for method and oracle.

    Returns:
        One row per method: aligner, n_runs, n_maps, unit, and for estimated and refined the share
        of answers with an estimate (_share; without one the error is infinite), the median error
        in metres (_m), the ratio (_ratio) and its interval (_ratio_low, _ratio_high).
    """
    maps = rich(maps)
    clusters = clusters_of(maps)

    def median(aligner: str, column: str) -> WeightedMedian:
        own = (maps["aligner"] == aligner).to_numpy()
        return WeightedMedian(maps[column].to_numpy()[own], clusters.codes[own])

    below = median(ORACLE, STAGES["refined"])
    rows = []
    for aligner in methods_in(maps, oracle=True):
        own = maps[maps["aligner"] == aligner]
        row: dict[str, Any] = {"aligner": aligner, "n_runs": own["run_id"].nunique()}
        row |= {"n_maps": len(own), "unit": clusters.unit}
        for stage, column in STAGES.items():
            above = median(aligner, column)

            def ratio(counts: Float, above: WeightedMedian = above) -> Float:
                divisor = below(counts)
                return above(counts) / np.where(divisor > 0, divisor, np.nan)

            interval = intervals.percentile_interval(ratio, clusters.n, rng)
            row |= {f"{stage}_share": own[f"{stage}_share"].mean()}
            row |= {f"{stage}_m": own[column].median()} | interval.columns(f"{stage}_ratio")
        rows.append(row)
    return pd.DataFrame(rows)


def compare_methods(maps: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Compare the estimated translation errors of every pair of methods on the same rich maps.

    The error of a method without an estimate is infinite; if both have none it is a draw.

    Returns:
        One row per pair of methods: first, second, n_runs, n_maps, unit; ratio, the median over
        maps of the first method's error over the second's, with its interval (whole runs are
        resampled); first_wins, the share of maps on which the first has the smaller error (draws
        count half), with its interval; p, of the runs' median log ratios (NaN for a single run);
        and p_holm, corrected for the number of pairs.
    """
    frame = paired_values(rich(maps), "translation_error_m").reset_index()
    clusters = clusters_of(frame)
    rows = []
    for first, second in combinations(methods_in(rich(maps)), 2):
        known = frame[[first, second]].notna().all(axis=1).to_numpy()
        both, paired = frame[known], clusters._replace(codes=clusters.codes[known])
        change = log_ratio(both[first].to_numpy(), both[second].to_numpy())
        ratio = intervals.median_interval(change, paired, rng)
        won = (change < 0) + 0.5 * (change == 0)
        wins = intervals.weighted_mean_interval(won, np.ones(len(won)), paired, rng)
        row: dict[str, Any] = {"first": first, "second": second}
        row |= {"n_runs": both["run_id"].nunique(), "n_maps": len(both), "unit": clusters.unit}
        row |= Interval(*np.exp(ratio)).columns("ratio") | wins.columns("first_wins")
        of_runs = change_of_each_run(change, both["run_id"], clusters.n)
        rows.append(row | {"p": mean_change(of_runs).p if clusters.unit == RUN else np.nan})
    compared = pd.DataFrame(rows)
    return compared.assign(p_holm=holm(compared["p"].to_numpy())) if rows else compared


def paired_values(maps: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column of the alignment summary by pair of maps (rows) and method (columns)."""
    return maps.pivot_table(index=MAP_PAIR, columns="aligner", values=column, dropna=False)


# Aligners are equal if the test finds no difference and their measured values differ by at most
# this: few runs prove neither a difference nor equality. Shares: one map, which is chance, or one
# in twenty of many maps. Robots go on and meet again, and a merge that is sometimes late costs less
# than larger errors or more time everywhere.
_EQUAL_SHARE = 0.05
_ROUNDING = 1e-9  # in sums of repetitions' shares
# Errors: by the median map, which is robust against failures. Errors of good estimates are a few
# decimetres: a tenth of that is less than the maps' own drift, and the refinement removes it.
_EQUAL_LOG_RATIO = math.log(1.1)

# Names in `Standing` of columns of `SHOWN` and of `success_rates`.
_ERRORS = dict(
    zip(ERROR_COLUMNS, ("estimated_m", "estimated_rad", "refined_m", "refined_rad"), strict=True)
)
_RATES = {"refined_success": "rate", "refined_success_low": "low", "refined_success_high": "high"}


@dataclass(frozen=True)
class Standing:
    """Results of one aligner.

    Attributes:
        aligner: its name.
        n_maps: number of pairs of maps with common ground.
        n_alignments: number of alignments of these pairs, with all repetitions.
        rate: share of these alignments whose refined result is right, the mean over the pairs of
            maps; `low` and `high` are the ends of its 95 % Wilson interval (trials are runs, or
            the pairs of maps of one run).
        estimated_m: median error over answerable maps; it and the next three are infinite where
            more than half of the maps have no estimate.
        over_oracle: refined errors over those of the oracle, on rich maps.
        n_accepted: number of accepted estimates on all maps; `n_false` of them are wrong.
        time_ms: median time of one alignment.
        shown: further columns of `SHOWN`.
    """

    aligner: str
    n_maps: int
    n_alignments: int
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

    @property
    def alignments(self) -> str:
        """Number of alignments that `rate` counts, in words."""
        maps = f"{self.n_maps} pairs of maps with common ground"
        if self.n_alignments == self.n_maps:
            return maps
        return f"{self.n_alignments} alignments of {maps}"


# An aligner with a lower rate, at the upper end of its interval, fails more often than it succeeds.
_RELIABLE_RATE = 0.5


@dataclass(frozen=True)
class Recommendation:
    """Recommended aligner.

    Attributes:
        best: the recommended aligner; None if no aligner was ever right.
        equals: aligners that these data cannot tell from it.
        standings: all aligners except the oracle, the best first.
        n_maps: number of pairs of maps, `n_common` of them with common ground.
        n_runs: number of runs.
        n_worlds: number of scenarios and seeds; only runs of different worlds are independent.
        n_scenarios: number of scenarios.
        oracle_m: median refined error of the oracle; `oracle_rad` its rotation.
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

    @property
    def reliable(self) -> bool:
        """True if the best aligner succeeds often enough to be used."""
        return self.best is not None and self.best.high >= _RELIABLE_RATE


def aligner_summary(
    errors: pd.DataFrame, timings: pd.DataFrame, aligners: Sequence[str]
) -> pd.DataFrame:
    """Return one row per aligner: columns of the table `errors`, reduced as `tables.Shown` says.

    Further columns are spread_m, the 10-90 % range of the repetitions, and time_ms.
    """
    errors = errors[errors["status"] != Status.ABSENT]
    own = {name: answerable(errors[errors["aligner"] == name]) for name in aligners}
    shown = _shown_columns(summarise_alignments(errors)).reindex(pd.Index(aligners, name="aligner"))
    spread_m = [repetition_spread_m(rows) for rows in own.values()]
    return shown.assign(spread_m=spread_m, time_ms=_median_times_ms(timings)).reset_index()


def _shown_columns(maps: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of `SHOWN` by aligner from alignment summaries; NaN if unknown."""
    names = {
        kind: [name for name, how in SHOWN.items() if how.kind == kind and name in maps]
        for kind in ("error", "given", "share")
    }
    answers = answerable(maps).groupby("aligner", sort=False)
    ground = maps[has_common_ground(maps)].groupby("aligner", sort=False)
    parts = [answers[names["error"]].median(), answers[names["given"]].mean()]
    return pd.concat([*parts, ground[names["share"]].mean()], axis=1).reindex(columns=list(SHOWN))


def _median_times_ms(timings: pd.DataFrame) -> pd.Series:
    """Return the median time of one alignment by aligner."""
    if timings.empty:
        return pd.Series(dtype=np.float64)
    return 1e3 * timings.groupby("aligner")["elapsed_s"].median()


def recommend(maps: pd.DataFrame, timings: pd.DataFrame, aligners: list[str]) -> Recommendation:
    """Rank aligners by alignment summaries and of `aligner_timings`.

    The first criterion is the share of right results. Aligners equal to the first are ranked by the
    estimated error on the same pairs of maps, and those that are still equal by time. The unit of
    the tests is the run (see `intervals`); the ranking of a single run is a hint only.

    Args:
        maps: alignment summaries.
        timings: rows of `aligner_timings`, which may be empty.
        aligners: names in display order.
    """
    ground = maps[has_common_ground(maps)]
    standings = _standings(maps, timings, [name for name in aligners if name != ORACLE])
    # Rank by success, then those equal to the first by error, then those still equal by time.
    ranked = sorted(
        standings, key=lambda s: (-_or_last(s.rate, 0.0), _or_last(s.estimated_m), s.time_ms)
    )
    equals: tuple[str, ...] = ()
    if ranked and len(ground):
        contenders = _equal_to_first(ranked, ground, "refined_success")
        contenders.sort(key=lambda s: _or_last(s.estimated_m))
        equal = _equal_to_first(contenders, ground, "translation_error_m")
        equal.sort(key=lambda s: _or_last(s.time_ms))
        rest = [s for s in contenders if s not in equal]
        others = [s for s in ranked if s not in contenders]
        ranked, equals = [*equal, *rest, *others], tuple(s.aligner for s in equal[1:])
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
    """Return the results of each aligner, in the order of `aligners`."""
    is_ground = has_common_ground(maps)
    times = maps[["accepted", "false_accepted"]].mul(maps["n_repetitions"], axis=0)
    counted = times.set_axis(["n_accepted", "n_false"], axis=1).assign(
        n_maps=is_ground, n_alignments=maps["n_repetitions"].where(is_ground, 0)
    )
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


def _or_last(value: float, missing: float = math.inf) -> float:
    """Return a sorting key that is `missing` for NaN."""
    return missing if math.isnan(value) else value


def _equal_to_first(standings: list[Standing], maps: pd.DataFrame, column: str) -> list[Standing]:
    """Return the first aligner and those equal to the first in a column, by test and tolerance."""
    values, is_share = paired_values(maps, column), column == "refined_success"
    p_values, near = [], []
    for standing in standings[1:]:
        paired = values[[standings[0].aligner, standing.aligner]].dropna()  # by both
        n, (first, own) = len(paired), paired.to_numpy(np.float64).T
        changes = own - first if is_share else intervals.log_ratio(own, first)
        run_id = paired.index.get_level_values("run_id")
        n_runs = maps["run_id"].nunique()
        of_runs = intervals.change_of_each_run(changes, run_id, n_runs, is_share)
        p_values.append(intervals.mean_change(of_runs).p)
        apart = pd.Series(changes).clip(-intervals.LARGEST_LOG_RATIO, intervals.LARGEST_LOG_RATIO)
        if is_share:
            near.append(abs(apart.mean()) * n <= max(1, _EQUAL_SHARE * n) + _ROUNDING)
        else:
            near.append(abs(apart.median()) <= _EQUAL_LOG_RATIO)
    same = np.array(near, bool) & ~(intervals.holm(np.array(p_values)) <= intervals.SIGNIFICANCE)
    return [standings[0], *compress(standings[1:], same)]
