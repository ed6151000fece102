"""All tables of statistics over some runs, by name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import that_ever_meet
from experiments.judge.judged_maps import MAP_KEYS, NEEDED, OPTIONAL, maps_of, setting_columns
from experiments.scenario.randomness import generator
from experiments.study.statistics.error_bands import error_bands, medians_of_run, time_bands
from experiments.study.statistics.nees_over_runs import FUSION_COLUMNS, nees_of_maps, nees_of_pairs
from experiments.study.statistics.oracle_ratio import oracle_ratios
from experiments.study.statistics.overlap import with_overlap_share
from experiments.study.statistics.paired import compare_methods
from experiments.study.statistics.path_summary import path_summary
from experiments.study.statistics.run_tables import Runs
from experiments.study.statistics.success_rates import LAST, success_rates
from mapfusion.align.result import Status

ALL_SCENARIOS = "(all)"
_TIMING_COLUMNS = (*MAP_KEYS, "aligner", "n_correspondences", "n_common", "elapsed_s")
_FURTHER_TABLES = ("aligner_timings", "path_statistics", "landmark_nees", "fusion")
_FILE_NAMES = {
    "n_common": "success_by_overlap",
    "overlap_share": "success_by_overlap_share",
    "n_true": "success_by_true_pairs",
    "outlier_share": "success_by_outliers",
    "iteration": "success_by_iteration",
    LAST: "success_at_the_end",
}


@dataclass(frozen=True)
class Summary:
    """Statistics over some runs.

    Attributes:
        n_runs: how many runs.
        tables: by file name, each with scenario and settings in front; "(all)" is all scenarios.
        run_medians: each run's medians over its repetitions, for figures 4 and 5.
        timings: the rows of figure 6.
        missing: tables that no run had.
        failed: runs that failed, with their reason.
    """

    n_runs: int
    tables: dict[str, pd.DataFrame]
    run_medians: pd.DataFrame
    timings: pd.DataFrame
    missing: tuple[str, ...]
    failed: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def n_configurations(self) -> int:
        """How many settings the sweeps tried (1 without sweeps)."""
        settings = setting_columns(self.run_medians)
        return len(self.run_medians[settings].drop_duplicates()) if settings else 1


def configurations(frame: pd.DataFrame) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Rows by scenario and settings; with several scenarios, also all of them together.

    Yields:
        The label columns, and the rows. Where all scenarios are together, they are named so.
    """
    names = ["scenario", *setting_columns(frame)]
    several = len(frame["scenario"].unique()) > 1
    for each in [frame, *([frame.assign(scenario=ALL_SCENARIOS)] if several else [])]:
        for keys, rows in each.groupby(names, sort=False, dropna=False):
            yield dict(zip(names, keys, strict=True)), rows


def summarise(runs: Runs) -> Summary:
    """Everything there is to say about these runs; a table that none of them has is left out."""
    reduced = reduced_errors(runs)
    maps, medians = reduced.maps, reduced.medians
    made = {
        name: _each(maps, lambda rows, _, by=by: success_rates(rows, by))
        for by, name in _FILE_NAMES.items()
    }
    made["error_over_oracle"] = _each(maps, _drawn(oracle_ratios, "oracle"))
    made["methods_compared"] = _each(maps, _drawn(compare_methods, "paired"))
    made["errors_by_iteration"] = _each(medians, _error_bands)
    timings, parts = pd.DataFrame(), []
    if runs.has("aligner_timings"):
        timings = runs.read("aligner_timings", _TIMING_COLUMNS)
        made["time_by_overlap"] = _each(timings, lambda rows, _: time_bands(rows))
    if runs.has("path_statistics"):
        made["paths"] = _each(runs.read("path_statistics"), _drawn(path_summary, "paths"))
    if runs.has("landmark_nees"):
        parts.append(_each(runs.read("landmark_nees"), _drawn(nees_of_maps, "nees")))
    if runs.has("fusion"):
        fusion = runs.read("fusion", FUSION_COLUMNS)
        parts.append(_each(fusion, _drawn(nees_of_pairs, "fusion")))
    if parts:
        made["nees"] = pd.concat(parts, ignore_index=True)
    made = {name: table for name, table in made.items() if len(table)}
    missing = tuple(name for name in _FURTHER_TABLES if not runs.has(name))
    return Summary(len(runs.names), made, medians, timings, missing, runs.failed)


@dataclass(frozen=True)
class ReducedErrors:
    """The errors of some runs, read and reduced run by run.

    Attributes:
        maps: rows of `maps_of`, with the overlap.
        medians: rows of `medians_of_run`.
        absent: aligners whose package is not installed, which is no failure.
    """

    maps: pd.DataFrame
    medians: pd.DataFrame
    absent: list[str]


def reduced_errors(runs: Runs) -> ReducedErrors:
    """All that statistics, figures and reports say of errors starts from these rows."""
    maps, medians = [], []
    every: dict[str, None] = {}
    for whole in runs.each("errors", NEEDED, ("status", *OPTIONAL)):
        every |= dict.fromkeys(whole["aligner"])
        errors = whole[whole["status"] != Status.ABSENT]
        if len(errors):
            maps.append(maps_of(errors))
            medians.append(medians_of_run(errors))
    if not maps:  # robots that were alone
        nothing = pd.DataFrame(columns=["run_id", "scenario", "aligner"])
        return ReducedErrors(nothing, nothing, list(every))
    joined = with_overlap_share(pd.concat(maps, ignore_index=True), runs)
    there = set(joined["aligner"])
    absent = [name for name in every if name not in there]
    return ReducedErrors(joined, pd.concat(medians, ignore_index=True), absent)


def _error_bands(rows: pd.DataFrame, label: tuple[str, ...]) -> pd.DataFrame:
    return error_bands(that_ever_meet(rows) if label[0] == ALL_SCENARIOS else rows)


def _drawn(
    made_of: Callable[[pd.DataFrame, np.random.Generator], pd.DataFrame], name: str
) -> Callable[[pd.DataFrame, tuple[str, ...]], pd.DataFrame]:
    """A statistic with a generator of its own for each configuration."""
    return lambda rows, label: made_of(rows, generator(0, name, *label))


def _each(
    frame: pd.DataFrame, made_of: Callable[[pd.DataFrame, tuple[str, ...]], pd.DataFrame]
) -> pd.DataFrame:
    """A table of each configuration, one below the other, its labels in front."""
    parts = []
    for labels, rows in configurations(frame):
        part = made_of(rows, tuple(str(value) for value in labels.values()))
        for place, (name, value) in enumerate(labels.items()):
            part.insert(place, name, value)
        parts.append(part)
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
