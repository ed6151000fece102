"""All tables of statistics over some runs, by name."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.judge.criteria import that_ever_meet
from experiments.judge.judged_maps import MAP_KEYS, NEEDED, OPTIONAL, maps_of, setting_columns
from experiments.scenario.randomness import generator
from experiments.study.statistics import paths_and_nees, team_statistics
from experiments.study.statistics.error_bands import (
    ROBOT_PAIR,
    error_bands,
    medians_of_run,
    time_bands,
)
from experiments.study.statistics.methods_compared import compare_methods, oracle_ratios
from experiments.study.statistics.run_tables import Runs
from experiments.study.statistics.success_rates import LAST, success_rates
from mapfusion.align.result import Status

ALL_SCENARIOS = "(all)"
_FILE_NAMES = {
    "n_common": "success_by_overlap",
    "overlap_share": "success_by_overlap_share",
    "n_true": "success_by_true_pairs",
    "outlier_share": "success_by_outliers",
    "iteration": "success_by_iteration",
    LAST: "success_at_the_end",
}
_TIMING_COLUMNS = (*MAP_KEYS, "aligner", "n_correspondences", "n_common", "elapsed_s")
# Of tables that not every run has: what is read, under what name which statistics go, their seed.
_FURTHER: dict[str, tuple[Any, str, Callable[..., pd.DataFrame], str]] = {
    "aligner_timings": (_TIMING_COLUMNS, "time_by_overlap", time_bands, ""),
    "path_statistics": (None, "paths", paths_and_nees.path_summary, "paths"),
    "team": (None, "team", team_statistics.team_paths, "team"),
    "team_pairs": (None, "team_pairs", team_statistics.team_alignments, "team_pairs"),
    "landmark_nees": (None, "nees", paths_and_nees.nees_of_maps, "nees"),
    "smoother": (
        paths_and_nees.SMOOTHER_COLUMNS,
        "smoother",
        paths_and_nees.smoother_summary,
        "smoother",
    ),
    "fusers": (paths_and_nees.FUSER_COLUMNS, "fusers", paths_and_nees.fuser_summary, "fusers"),
    "fusion": (paths_and_nees.FUSION_COLUMNS, "nees", paths_and_nees.nees_of_pairs, "fusion"),
}


class Summary(NamedTuple):
    """Statistics over some runs.

    Attributes:
        tables: by file name, each with scenario and settings in front; "(all)" is all scenarios.
        run_medians: each run's medians over its repetitions, for figures 4 and 5.
        timings: the rows of figure 6.
        missing: tables that no run had.
        failed: runs that failed, with their reason.
    """

    n_runs: int
    n_worlds: int
    tables: dict[str, pd.DataFrame]
    run_medians: pd.DataFrame
    timings: pd.DataFrame
    missing: tuple[str, ...]
    failed: pd.DataFrame

    @property
    def n_configurations(self) -> int:
        """How many settings the sweeps tried (1 without sweeps)."""
        settings = setting_columns(self.run_medians)
        return len(self.run_medians[settings].drop_duplicates()) if settings else 1


def configurations(frame: pd.DataFrame) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Labels and rows by scenario and settings; also of all scenarios, if several."""
    names = ["scenario", *setting_columns(frame)]
    pooled = frame.assign(scenario=ALL_SCENARIOS)
    for each in [frame, pooled] if len(frame["scenario"].unique()) > 1 else [frame]:
        for keys, rows in each.groupby(names, sort=False, dropna=False):
            yield dict(zip(names, keys, strict=True)), rows


def summarise(runs: Runs) -> Summary:
    """Everything there is to say about these runs; a table that none of them has is left out."""
    reduced = reduced_errors(runs)
    maps, medians = reduced.maps, reduced.medians
    made = {name: _each(maps, partial(success_rates, by=by)) for by, name in _FILE_NAMES.items()}
    made["error_over_oracle"] = _each(maps, oracle_ratios, "oracle")
    made["methods_compared"] = _each(maps, compare_methods, "paired")
    made["errors_by_iteration"] = _each(medians, _error_bands)
    timings = pd.DataFrame()
    missing = tuple(table for table in _FURTHER if not runs.has(table))
    for table, (columns, name, made_of, seed) in _FURTHER.items():
        if table not in missing:
            rows = runs.read(table, columns)
            parts = [made.get(name), _each(rows, made_of, seed)]
            made[name] = pd.concat(parts, ignore_index=True)
            timings = rows if table == "aligner_timings" else timings
    made = {name: table for name, table in made.items() if len(table)}
    worlds = runs.described[["scenario", "seed"]].drop_duplicates()
    return Summary(len(runs.described), len(worlds), made, medians, timings, missing, runs.failed)


class ReducedErrors(NamedTuple):
    """The errors of some runs, read and reduced batch by batch to `maps_of` and `medians_of_run`.

    The absent aligners are those whose package is not installed, which is no failure.
    """

    maps: pd.DataFrame
    medians: pd.DataFrame
    absent: list[str]


def reduced_errors(runs: Runs) -> ReducedErrors:
    """All that statistics, figures and reports say of errors starts from these rows."""
    maps, medians, every = [], [], []
    for whole in runs.batches("errors", NEEDED, ("status", *OPTIONAL)):
        every += whole["aligner"].unique().tolist()
        errors = whole[whole["status"] != Status.ABSENT]
        if len(errors):
            maps.append(maps_of(errors))
            medians.append(medians_of_run(errors))
    if not maps:  # robots that were alone
        nothing = pd.DataFrame(columns=["run_id", "scenario", "aligner"])
        return ReducedErrors(nothing, nothing, list(dict.fromkeys(every)))
    joined = with_overlap_share(pd.concat(maps, ignore_index=True), runs)
    absent = [name for name in dict.fromkeys(every) if name not in set(joined["aligner"])]
    return ReducedErrors(joined, pd.concat(medians, ignore_index=True), absent)


def with_overlap_share(maps: pd.DataFrame, runs: Runs) -> pd.DataFrame:
    """Rows of `maps_of` with overlap_share: n_common over the landmarks of the smaller map.

    NaN where the runs have no table `robots`. A robot whose log ended earlier keeps its last map.
    """
    if not runs.has("robots"):
        return maps.assign(overlap_share=np.nan)
    iterations, parts = np.unique(maps["iteration"]), []
    for rows in runs.batches("robots", ["robot", "iteration", "n_landmarks"]):
        sizes = rows.pivot_table("n_landmarks", "iteration", ["run_id", "robot"]).ffill()
        at = sizes.reindex(pd.Index(iterations, name="iteration"), method="ffill")
        parts.append(at.melt(ignore_index=False).set_index(["run_id", "robot"], append=True))
    sizes = pd.concat(parts)["value"]
    places = (maps[["iteration", "run_id", robot]] for robot in ROBOT_PAIR)
    a, b = (sizes.reindex(pd.MultiIndex.from_frame(own)).to_numpy() for own in places)
    smaller = pd.Series(np.fmin(a, b), maps.index)
    # a common landmark at least is in both; maps without any have nothing in common
    share = (maps["n_common"] / smaller.where(smaller > 0)).where(smaller != 0, 0.0)
    return maps.assign(overlap_share=share)


def _error_bands(rows: pd.DataFrame) -> pd.DataFrame:
    is_pooled = (rows["scenario"] == ALL_SCENARIOS).all()
    return error_bands(that_ever_meet(rows) if is_pooled else rows)


def _each(
    frame: pd.DataFrame, made_of: Callable[..., pd.DataFrame], seed: str = ""
) -> pd.DataFrame:
    """A table of each configuration, one below the other, its labels in front.

    A statistic that draws, and so has a seed, gets a generator of its own for each.
    """
    parts = []
    for labels, rows in configurations(frame):
        drawn = [generator(0, seed, *map(str, labels.values()))] if seed else []
        part = made_of(rows, *drawn)
        for place, (name, value) in enumerate(labels.items()):
            part.insert(place, name, value)
        parts.append(part)
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
