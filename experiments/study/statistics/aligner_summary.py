"""One row an aligner: what screens and reports show of it."""

import math
from collections.abc import Sequence

import pandas as pd

from experiments.judge.criteria import answerable, has_common_ground
from experiments.judge.judged_maps import maps_of
from experiments.judge.metrics import repetition_spread_m
from experiments.judge.tables import SHOWN
from mapfusion.align.result import Status


def aligner_summary(
    errors: pd.DataFrame, timings: pd.DataFrame, aligners: Sequence[str]
) -> pd.DataFrame:
    """The shown columns of `errors`, reduced as `tables.Shown` says, for each aligner.

    Args:
        errors: the table of one or more runs; absent aligners neither failed nor not.
        timings: the table `aligner_timings` likewise; may be empty.
        aligners: in display order.

    Returns:
        aligner; the columns of `SHOWN`; spread_m, the 10-90 % range of the repetitions; time_ms.
    """
    errors = errors[errors["status"] != Status.ABSENT]
    shown = shown_columns(maps_of(errors))
    rows = []
    for aligner in aligners:
        own = answerable(errors[errors["aligner"] == aligner])
        row = {"aligner": aligner} | shown.get(aligner, dict.fromkeys(SHOWN, math.nan))
        row |= {"spread_m": repetition_spread_m(own), "time_ms": median_time_ms(timings, aligner)}
        rows.append(row)
    return pd.DataFrame(rows)


def shown_columns(maps: pd.DataFrame) -> dict[str, dict[str, float]]:
    """By aligner, the columns of `SHOWN` from rows of `maps_of`; those that are there."""
    off = [name for name, how in SHOWN.items() if how.kind == "error" and name in maps]
    shares = [name for name, how in SHOWN.items() if how.kind == "share" and name in maps]
    errors = answerable(maps).groupby("aligner", sort=False)[off].median()
    means = maps[has_common_ground(maps)].groupby("aligner", sort=False)[shares].mean()
    found = pd.concat([errors, means], axis=1).reindex(columns=list(SHOWN))
    return {str(name): dict(row) for name, row in found.T.to_dict().items()}


def median_time_ms(timings: pd.DataFrame, aligner: str) -> float:
    """Median time of one alignment; NaN where it was not measured."""
    if timings.empty:
        return math.nan
    return 1e3 * float(timings.loc[timings["aligner"] == aligner, "elapsed_s"].median())
