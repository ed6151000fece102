"""Comparison of two versions, or of two values of a setting, on the same runs.

Changes are called better or worse if they exceed the noise.

Only rows that both versions have are compared: the same scenario, seed and settings (except those
that are excluded by name), robot pair, iteration and aligner.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from experiments.evaluation import alignment_criteria
from experiments.evaluation.alignment_criteria import (
    ANSWERABLE_PAIRS,
    COMMON_LANDMARKS,
    COUNTS,
    MAP_KEYS,
    MAP_PAIR,
    ORACLE,
    RICH_PAIRS,
    RUN_KEYS,
    is_false_merge,
    is_used_by_team,
    methods_in,
    path_rms,
    right_refined,
    setting_columns,
)
from experiments.evaluation.map_errors import last_fused
from experiments.evaluation.tables import read_scenario
from experiments.studies import intervals
from experiments.studies.intervals import MAPS_OF_ONE_RUN, RUN
from experiments.studies.run_tables import RunPath, Runs, find_runs, match_names
from experiments.studies.statistics import ROBOT_PAIR
from mapfusion.errors import InputError, did_you_mean

EACH_METHOD = "each method"  # fusers too
_ROBOT = ("run_id", "robot")
_NEES, _REFINED = "nees_with_drift", "refined_translation_error_m"


class Quantity(NamedTuple):
    """Quantity in which two versions are compared.

    Attributes:
        table: table of runs.
        metric: name of the quantity.
        column: column of the table.
        scale: a change is a ratio b / a, a difference of shares, or a difference of distances from
            consistency |ln(NEES per degree of freedom)|.
        of: each method, the oracle, or empty for rows without an aligner.
        higher_is_better: True if larger values are better.
        where: condition on the rows; counts in it are the smaller ones of both versions.
        timed: True for times, which depend on the machine and its load.
    """

    table: str
    metric: str
    column: str
    scale: Literal["ratio", "share", "ln"] = "ratio"
    of: str = ""
    higher_is_better: bool = False
    where: str = ""
    timed: bool = False


def _maps_over_oracle(errors: pd.DataFrame) -> pd.DataFrame:
    """Return alignment summaries with each map's refined error over that of the oracle."""
    maps = alignment_criteria.summarise_alignments(errors)
    of_oracle = maps.assign(oracle=maps[_REFINED].where(maps["aligner"] == ORACLE))
    reference = of_oracle.groupby(MAP_PAIR)["oracle"].transform("first")
    return maps.assign(over_oracle=maps[_REFINED] / reference)


def _nees_per_dof(fusion: pd.DataFrame) -> pd.DataFrame:
    """Return the mean NEES per degree of freedom of each robot pair."""
    true = fusion[fusion["true_pair"]]
    per_dof = true.assign(nees=true[_NEES] / true["degrees_of_freedom"])
    return per_dof.groupby(["run_id", *ROBOT_PAIR], sort=False)["nees"].mean().reset_index()


def _team_alignments(pairs: pd.DataFrame) -> pd.DataFrame:
    """Add found (right and used), false (wrong and used) and off_m (error in the team's map)."""
    used, right = is_used_by_team(pairs), right_refined(pairs)
    false = is_false_merge(pairs) & used
    off_m = pairs["team_translation_error_m"]
    return pairs.assign(found=(right & used).astype(float), false=false.astype(float), off_m=off_m)


_SMOOTHER = ("path_rmse_m", "landmark_rmse_m", "nees_per_dof")
_FUSERS = ("landmark_rmse_m", "over_better_filter", "nees_per_dof", "coverage_95")
# Columns to read of each table, columns that older runs may lack, and the reduction of the rows.
READ: dict[str, tuple[Sequence[str] | None, Sequence[str], Callable[..., pd.DataFrame]]] = {
    "errors": (alignment_criteria.NEEDED, alignment_criteria.OPTIONAL, _maps_over_oracle),
    "robots": (["robot", "path_error_m", "odometry_error_m"], (), partial(path_rms, by=_ROBOT)),
    "map_fits": (["map", "rmse_m"], (), pd.DataFrame),
    "smoother": (["robot", *_SMOOTHER], (), pd.DataFrame),
    "fusers": (
        ["fuser", "iteration", *_FUSERS],
        (),
        # each fuser's last map, with the fuser as aligner
        lambda rows: (
            last_fused(rows).drop(columns="iteration").rename(columns={"fuser": "aligner"})
        ),
    ),
    "team": (["component", "source", "rmse"], (), pd.DataFrame),
    "team_pairs": (None, (), _team_alignments),
    "fusion": ([*ROBOT_PAIR, "true_pair", _NEES, "degrees_of_freedom"], (), _nees_per_dof),
    "aligner_timings": ([*MAP_KEYS, "aligner", "elapsed_s"], (), pd.DataFrame),
}
_GROUND = f"n_common >= {COMMON_LANDMARKS}"
_ENOUGH, _RICH = f"n_true >= {ANSWERABLE_PAIRS}", f"n_true >= {RICH_PAIRS}"
_OFFERED = f"aligner == '{ORACLE}' and {_ENOUGH}"
QUANTITIES = (
    Quantity("errors", "success estimated", "estimated_success", "share", EACH_METHOD, True),
    Quantity("errors", "success refined", "refined_success", "share", EACH_METHOD, True),
    Quantity("errors", "wrongly accepted", "false_accepted", "share", EACH_METHOD),
    Quantity("errors", "accepted", "accepted", "share", EACH_METHOD, True, _GROUND),
    Quantity("errors", "estimated error, m", "translation_error_m", of=EACH_METHOD, where=_ENOUGH),
    Quantity("errors", "refined / oracle", "over_oracle", of=EACH_METHOD, where=_RICH),
    Quantity("errors", "refined error, m", _REFINED, of=ORACLE, where=_ENOUGH),
    Quantity("errors", "true pairs", "n_true", higher_is_better=True, where=_OFFERED),
    Quantity("robots", "path RMSE, m", "path_m"),
    Quantity("robots", "odometry RMSE, m", "odometry_m"),
    Quantity("map_fits", "landmark RMSE, m", "rmse_m", where="map != 'fused'"),
    Quantity("map_fits", "fused RMSE, m", "rmse_m", where="map == 'fused'"),
    Quantity("smoother", "smoothed path RMSE, m", _SMOOTHER[0]),
    Quantity("smoother", "smoothed landmark RMSE, m", _SMOOTHER[1]),
    Quantity("smoother", "smoothed NEES / dof", _SMOOTHER[2], "ln"),
    Quantity("fusers", "fused landmarks, m", _FUSERS[0], of=EACH_METHOD),
    Quantity("fusers", "fused over filter", _FUSERS[1], of=EACH_METHOD),
    Quantity("fusers", "fuser's NEES / dof", _FUSERS[2], "ln", EACH_METHOD),
    Quantity("fusers", "fused in 95 %", _FUSERS[3], "share", EACH_METHOD, True),
    Quantity("team", "team ATE, m", "rmse", where="component == 1 and source == 'final'"),
    Quantity("team_pairs", "team's T_a_b, m", "off_m"),
    Quantity("team_pairs", "team edges found", "found", "share", "", True, _GROUND),
    Quantity("team_pairs", "team edges false", "false", "share"),
    Quantity("fusion", "fused NEES / dof", "nees", "ln"),
    Quantity("aligner_timings", "time, s", "elapsed_s", of=EACH_METHOD, timed=True),
)


# A change of less than one percent (or percentage point) does not decide which method to choose.
LEAST_CHANGE = 0.01
BETTER, WORSE, SAME = "better", "worse", "identical"
NOISE, UNKNOWN = "no difference beyond noise", "cannot be judged"
_SHOWN_NAMES = 3
_NOT_SHOWN = ["table", "column", "of", "where", "higher_is_better"]
_KEYS = (*MAP_PAIR, "aligner", "robot", "map", "component", "source")


class VersionComparison(NamedTuple):
    """Differences of two versions.

    Attributes:
        table: one row per metric; a and b are medians over all rows, or means of shares; change is
            a factor b / a, or a difference; n_better of n_units changed for the better.
        unit: unit of n_units, "run" or "maps of one run".
        n_runs: number of matched runs.
        notes: warnings for the reader, one line each.
    """

    table: pd.DataFrame
    unit: str
    n_runs: int
    notes: tuple[str, ...]

    @property
    def worse(self) -> bool:
        """True if a metric got worse beyond noise; times depend on the load and do not count."""
        return bool(((self.table["verdict"] == WORSE) & ~self.table["timed"]).any())


def compare(path_a: Path, path_b: Path, apart_from: Sequence[str] = ()) -> VersionComparison:
    """Compare the result or sweep folders of two versions.

    Args:
        path_a: folder of the first version.
        path_b: folder of the second version.
        apart_from: settings of sweeps in which matched runs may differ.

    Raises:
        InputError: both have no run or no table in common; no sweep varied a setting of
            `apart_from`; or runs of one version differ only in these settings.
    """
    return _compared((path_a, find_runs(path_a)), (path_b, find_runs(path_b)), apart_from)


def compare_values(path: Path, setting: str, first: str, second: str) -> VersionComparison:
    """Compare the runs of a sweep with two values of a setting.

    Args:
        path: folder of the sweep.
        setting: dotted key of the setting.
        first: first value, as in the sweep's tables.
        second: second value.

    Raises:
        InputError: the folder is not a sweep, or it did not vary the setting or has no finished
            run with one of the values.
    """
    runs = find_runs(path)
    if not runs.sweeps:
        raise InputError(f"{path}: is one run; the values of a setting are compared in a sweep")
    known = values_by_setting(runs)
    if setting not in known:
        there = ", ".join(known) or "none"
        close = did_you_mean(setting, known)
        raise InputError(f"{path}: the sweep did not vary {setting}; it varied: {there}{close}")
    for value in (first, second):
        if value not in known[setting]:
            there = ", ".join(known[setting])
            raise InputError(f"{path}: no finished run has {setting}={value}; there are: {there}")
    side_a, side_b = ((path, replace(runs, only=((setting, v),))) for v in (first, second))
    return _compared(side_a, side_b, [setting])


def values_by_setting(runs: Runs) -> dict[str, list[str]]:
    """Return the values of each setting that a sweep varied, numbers in increasing order."""
    described = runs.described
    settings = setting_columns(described)
    values = {name: sorted(described[name].unique(), key=natural_key) for name in settings}
    return {name: found for name, found in values.items() if len(found) > 1}


def natural_key(text: object) -> tuple[float, str]:
    """Return a sorting key that puts 50 before 200."""
    try:
        return float(str(text)), ""
    except ValueError:
        return math.inf, str(text)


def _compared(
    side_a: tuple[Path, Runs], side_b: tuple[Path, Runs], apart_from: Sequence[str]
) -> VersionComparison:
    """Compare two groups of runs, each with the path that messages name."""
    (path_a, a), (path_b, b) = side_a, side_b
    notes = _excluded_settings(a, b, apart_from)
    name_sets = []
    for path, runs in (side_a, side_b):
        names = match_names(runs.described, apart_from)
        several = names[names.duplicated()]
        if apart_from and len(several):
            raise InputError(
                f"{path}: {several.iloc[0]} is there more than once, with other values of "
                f"{' and '.join(apart_from)}; each side may have one"
            )
        name_sets.append(set(names))
    runs_a, runs_b = name_sets
    common = runs_a & runs_b
    if not common:
        raise InputError(
            f"{path_a} and {path_b}: no run in common (same scenario, seed and settings); "
            f"the first has {_some(runs_a)}, the second {_some(runs_b)}"
        )
    unit = RUN if len(common) > 1 else MAPS_OF_ONE_RUN
    rows: list[dict[str, Any]] = []
    for quantity, method, values in _all_values(a, b, apart_from):
        is_share = quantity.scale == "share"
        per_map, run_id = values["change"].to_numpy(), values["run_id"]
        changes = intervals.change_of_each_run(per_map, run_id, len(common), is_share)
        found = intervals.mean_change(changes)
        limits = np.exp(found[:3]) if quantity.scale == "ratio" else found[:3]
        of_a, of_b = values[["a", "b"]].agg("mean" if is_share else "median")
        row = {"metric": quantity.metric, "method": method} | quantity._asdict()
        row |= {"a": of_a, "b": of_b}
        row |= dict(zip(("change", "low", "high"), limits, strict=True))
        sign = 1 if quantity.higher_is_better else -1
        row |= {"n_units": len(changes), "n_rows": len(values), "p": found.p}
        row |= {"n_better": int((sign * changes > 0).sum())}
        rows.append(row | {"identical": not values["change"].any()})
    if not rows:
        raise InputError(f"{path_a} and {path_b}: their common runs have no rows in common")
    table = pd.DataFrame(rows)
    table["p_holm"] = intervals.holm(table["p"].to_numpy())
    table["verdict"] = [_verdict(row) for row in table.to_dict("records")]
    notes += _differing_settings(a, b)
    for names, side_name in ((runs_a - runs_b, "first"), (runs_b - runs_a, "second")):
        if names:
            runs = f"{len(names)} run{'s' * (len(names) > 1)} of the {side_name}"
            notes.append(f"left out: {runs} that the other has not ({_some(names)})")
    is_common = match_names(a.described, apart_from).isin(common)
    n_worlds = len(a.described.loc[is_common, ["scenario", "seed"]].drop_duplicates())
    if unit == MAPS_OF_ONE_RUN:
        notes.append(
            "weak: one run each. The noise is that between the robots and maps of this run, which "
            "depend on each other; another seed may differ. Compare six seeds or more"
        )
    elif n_worlds < intervals.FEW_RUNS:
        worlds = f"{n_worlds} world{'s' * (n_worlds > 1)} (scenario and seed)"
        notes.append(
            f"weak: {len(common)} runs in {worlds}. The test assumes normally distributed changes, "
            f"which so few cannot confirm; compare {intervals.FEW_RUNS} seeds or more"
        )
    if table["timed"].any():
        notes.append(
            "times: all runs of a version share its machine and load; resampling of runs cannot "
            "separate these from a change of the program. Times never count for --fail-if-worse"
        )
    return VersionComparison(table.drop(columns=_NOT_SHOWN), unit, len(common), tuple(notes))


def _excluded_settings(a: Runs, b: Runs, settings: Sequence[str]) -> list[str]:
    """Return notes on the settings that runs are not matched by."""
    notes = []
    varied = [runs.described[setting_columns(runs.described)] for runs in (a, b)]
    for setting in settings:
        values = [sorted(each[setting].unique()) if setting in each else [] for each in varied]
        if not any(values):
            known = ", ".join(sorted({str(name) for each in varied for name in each})) or "none"
            raise InputError(f"apart from {setting}: no sweep varied this setting; known: {known}")
        first, second = (" and ".join(each) or "as the scenario says" for each in values)
        notes.append(f"matched apart from {setting}: {first} in the first, {second} in the second")
    return notes


def _verdict(row: dict[Any, Any]) -> str:
    """Return the verdict on one row of the table, from its change and corrected p value."""
    if row["identical"]:
        return SAME
    if row["n_units"] < 2:
        return UNKNOWN
    change, least = row["change"], LEAST_CHANGE
    if row["scale"] == "ratio":
        change, least = np.log(change), np.log1p(least)
    if not row["p_holm"] <= intervals.SIGNIFICANCE or abs(change) < least:
        return NOISE
    return BETTER if (change > 0) == row["higher_is_better"] else WORSE


def _some(names: set[str]) -> str:
    """Return the first names, and the number of the others."""
    shown = ", ".join(islice(sorted(names), _SHOWN_NAMES))
    return shown + (f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else "")


def _differing_settings(a: Runs, b: Runs) -> list[str]:
    """Return notes on settings in which the scenarios of matched results differ."""

    def settings_of(result: RunPath) -> dict[str, str]:  # by dotted name, as JSON
        found = pd.json_normalize(read_scenario(result.path / "scenario.json")).to_dict("records")
        return {str(name): json.dumps(value) for name, value in found[0].items()}

    found: dict[str, str] = {}
    for x, y in ((x, y) for x in a.results for y in b.results if x.run == y.run):
        both = pd.DataFrame([settings_of(x), settings_of(y)]).fillna("absent")
        for key, (old, new) in both.sort_index(axis=1).items():
            if old != new:
                found[str(key)] = f"{key} is {old} in the first and {new} in the second"
    shown = [f"the scenarios differ: {text}" for text in islice(found.values(), _SHOWN_NAMES)]
    more = len(found) - len(shown)
    return [*shown, f"the scenarios differ in {more} more settings"] if more else shown


def _all_values(
    a: Runs, b: Runs, apart_from: Sequence[str]
) -> Iterator[tuple[Quantity, str, pd.DataFrame]]:
    """Yield quantities of common tables, the method, and columns run_id, a, b and change.

    Rows without a finite change are left out; success rates cover them.
    """
    for table in READ:
        if not (a.has(table) and b.has(table)):
            continue
        columns, optional, reduce = READ[table]
        frames = []
        for runs in (a, b):
            parts = []
            for batch in runs.batches(table, columns, optional):
                of_run = [*RUN_KEYS, *setting_columns(batch)]
                value_columns = batch.drop(columns=of_run)
                parts.append(reduce(value_columns.assign(run_id=match_names(batch, apart_from))))
            # A run of one robot has no rows, and its columns have no useful types.
            parts = [part for part in parts if len(part)] or parts[:1]
            frames.append(pd.concat(parts, ignore_index=True))
        # Join the rows of both by run and keys; counts are the smaller ones of both.
        keys = [name for name in _KEYS if name in frames[0]]
        joined = frames[0].merge(frames[1], on=keys, suffixes=("_a", "_b"))
        smaller_counts = {
            name: joined.filter(like=name).min(axis=1) for name in COUNTS if name in frames[0]
        }
        rows = joined.assign(**smaller_counts)
        methods = methods_in(rows, oracle=True) if "aligner" in rows else []
        for method in [*methods, ""]:
            method_rows = rows[rows["aligner"] == method] if method else rows
            method_kind = method if method in ("", ORACLE) else EACH_METHOD
            for quantity in QUANTITIES:
                if (quantity.table, quantity.of) != (table, method_kind):
                    continue
                chosen = method_rows.query(quantity.where) if quantity.where else method_rows
                x, y = (
                    chosen[f"{quantity.column}_{side}"].to_numpy(dtype=np.float64) for side in "ab"
                )
                if quantity.scale == "share":
                    change = y - x
                elif quantity.scale == "ratio":
                    change = intervals.log_ratio(y, x)
                else:  # change of the distance from consistency, in either direction
                    from_1_a, from_1_b = (
                        np.abs(intervals.log_ratio(v, np.ones(1))) for v in (x, y)
                    )
                    change = from_1_b - from_1_a
                is_finite = np.isfinite(x) & np.isfinite(change)
                if is_finite.any():
                    values = {"run_id": chosen["run_id"], "a": x, "b": y, "change": change}
                    yield quantity, method, pd.DataFrame(values)[is_finite]
