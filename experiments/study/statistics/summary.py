"""All tables of statistics over some runs, by name."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from experiments.scenario.randomness import generator
from experiments.study.statistics.error_bands import error_bands, medians_of_run, time_bands
from experiments.study.statistics.judged_maps import (
    MAP_KEYS,
    NEEDED,
    OPTIONAL,
    Criteria,
    maps_of,
    that_ever_meet,
)
from experiments.study.statistics.nees_over_runs import FUSION_COLUMNS, nees_of_maps, nees_of_pairs
from experiments.study.statistics.oracle_ratio import oracle_ratios
from experiments.study.statistics.overlap import with_overlap_share
from experiments.study.statistics.paired import compare_methods
from experiments.study.statistics.path_summary import path_summary
from experiments.study.statistics.run_tables import RUN_KEYS, Runs, setting_columns
from experiments.study.statistics.success_rates import LAST, rates_of_maps

ALL_SCENARIOS = "(all)"
_TIMING_COLUMNS = (*MAP_KEYS, "aligner", "n_correspondences", "n_common", "elapsed_s")
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
        criteria: what counted as right.
        n_runs: how many runs.
        tables: by file name, each with scenario and settings in front; "(all)" is all scenarios.
        run_medians: each run's medians over its repetitions, for figures 4 and 5.
        timings: the rows of figure 6.
        missing: tables that no run had.
        failed: runs that failed, with their reason.
    """

    criteria: Criteria
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
        The label columns, and the rows.
    """
    settings = setting_columns(frame)
    for keys, rows in frame.groupby(["scenario", *settings], sort=False, dropna=False):
        yield dict(zip(["scenario", *settings], keys, strict=True)), rows
    if frame["scenario"].nunique() < 2:
        return
    if not settings:
        yield {"scenario": ALL_SCENARIOS}, frame
        return
    for keys, rows in frame.groupby(settings, sort=False, dropna=False):
        yield {"scenario": ALL_SCENARIOS} | dict(zip(settings, keys, strict=True)), rows


def summarise(runs: Runs, criteria: Criteria) -> Summary:
    """Everything there is to say about these runs; a table that none of them has is left out."""
    maps, medians = _reduced_errors(runs, criteria)
    made = _alignment_tables(maps)
    made["errors_by_iteration"] = _each(medians, _error_bands)
    timings, missing = pd.DataFrame(), []
    if runs.has("aligner_timings"):
        timings = runs.read("aligner_timings", _TIMING_COLUMNS)
        made["time_by_overlap"] = _each(timings, lambda rows, label: time_bands(rows))
    else:
        missing.append("aligner_timings")
    for name, tables in (("paths", ("path_statistics",)), ("nees", ("landmark_nees", "fusion"))):
        parts = [_OF_TABLE[table](runs) for table in tables if runs.has(table)]
        missing += [table for table in tables if not runs.has(table)]
        if parts:
            made[name] = pd.concat(parts, ignore_index=True)
    made = {name: table for name, table in made.items() if len(table)}
    return Summary(criteria, len(runs.names), made, medians, timings, tuple(missing), runs.failed)


def _alignment_tables(maps: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """What rows of `maps_of` have to say."""
    made = {
        name: _each(maps, lambda rows, label, by=by: rates_of_maps(rows, by))
        for by, name in _FILE_NAMES.items()
    }
    made["error_over_oracle"] = _each(
        maps, lambda rows, label: oracle_ratios(rows, generator(0, "oracle", *label))
    )
    made["methods_compared"] = _each(
        maps, lambda rows, label: compare_methods(rows, generator(0, "paired", *label))
    )
    return made


def _reduced_errors(runs: Runs, criteria: Criteria) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows of `maps_of`, and each run's medians, read run by run."""
    maps, medians = [], []
    for errors in runs.each("errors", NEEDED, OPTIONAL):
        if errors.empty:
            continue
        maps.append(maps_of(errors, criteria))
        reduced = medians_of_run(errors).reset_index()
        medians.append(reduced.merge(_labels(errors), on="run_id"))
    if not maps:  # robots that were alone
        return pd.DataFrame(columns=["scenario"]), pd.DataFrame(columns=["scenario", "run_id"])
    joined = with_overlap_share(pd.concat(maps, ignore_index=True), runs)
    return joined, pd.concat(medians, ignore_index=True)


def _error_bands(rows: pd.DataFrame, label: tuple[str, ...]) -> pd.DataFrame:
    return error_bands(that_ever_meet(rows) if label[0] == ALL_SCENARIOS else rows)


def _labels(frame: pd.DataFrame) -> pd.DataFrame:
    """Each run's columns."""
    return frame[[*RUN_KEYS, *setting_columns(frame)]].drop_duplicates()


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


def _paths(runs: Runs) -> pd.DataFrame:
    rows = runs.read("path_statistics")
    return _each(rows, lambda own, label: path_summary(own, generator(0, "paths", *label)))


def _nees_of_maps(runs: Runs) -> pd.DataFrame:
    rows = runs.read("landmark_nees")
    return _each(rows, lambda own, label: nees_of_maps(own, generator(0, "nees", *label)))


def _nees_of_pairs(runs: Runs) -> pd.DataFrame:
    rows = runs.read("fusion", FUSION_COLUMNS)
    return _each(rows, lambda own, label: nees_of_pairs(own, generator(0, "fusion", *label)))


_OF_TABLE: dict[str, Callable[[Runs], pd.DataFrame]] = {
    "path_statistics": _paths,
    "landmark_nees": _nees_of_maps,
    "fusion": _nees_of_pairs,
}
