"""Two versions on the same runs: what got better or worse, and whether that is more than noise.

Only what both have counts: the same scenario, seed and settings (but for those left out by name),
robot pair, iteration and aligner.
"""

import json
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.judge import judged_maps
from experiments.judge.criteria import (
    ORACLE,
)
from experiments.judge.judged_maps import MAP_PAIR, setting_columns
from experiments.judge.result_files import read_scenario
from experiments.study.compare.quantities import EACH_METHOD, QUANTITIES, READ, Quantity
from experiments.study.statistics import better
from experiments.study.statistics.intervals import MAPS_OF_ONE_RUN, RUN
from experiments.study.statistics.run_tables import RunPath, Runs, find_runs, match_names
from mapfusion.errors import InputError

# A change of less than one percent (or percentage point) matters to nobody who picks a method.
LEAST_CHANGE = 0.01
BETTER, WORSE, SAME = "better", "worse", "identical"
NOISE, UNKNOWN = "no difference beyond noise", "cannot be judged"
_SHOWN_NAMES = 3
_NOT_SHOWN = ["table", "column", "of", "where", "higher_is_better"]
_KEYS = (*MAP_PAIR, "aligner", "robot", "map", "component", "source")


class VersionComparison(NamedTuple):
    """What two versions differ in.

    Attributes:
        table: one row a metric; a and b are medians over all rows, means of shares; change is a
            factor b / a, or a difference.
        unit: what n_units counts, "run" or "maps of one run".
        n_runs: matched.
        notes: what a reader must know, one line each.
    """

    table: pd.DataFrame
    unit: str
    n_runs: int
    notes: tuple[str, ...]

    @property
    def worse(self) -> bool:
        """Whether anything got worse beyond noise. Times do not count: see `_notes_on`."""
        return bool(((self.table["verdict"] == WORSE) & ~self.table["timed"]).any())


def compare(path_a: Path, path_b: Path, apart_from: Sequence[str] = ()) -> VersionComparison:
    """Compare the result or sweep folders of two versions.

    Args:
        path_a: of the first.
        path_b: of the second.
        apart_from: settings that sweeps varied, in which matched runs may differ.

    Raises:
        InputError: the two have no run in common, or no table; or such a setting is none that a
            sweep varied, or tells two runs of one side apart.
    """
    a, b = find_runs(path_a), find_runs(path_b)
    notes = _apart_from(a, b, apart_from)
    runs_a, runs_b = (_names(*side, apart_from) for side in ((path_a, a), (path_b, b)))
    common = runs_a & runs_b
    if not common:
        raise InputError(
            f"{path_a} and {path_b}: no run in common (same scenario, seed and settings); "
            f"the first has {_some(runs_a)}, the second {_some(runs_b)}"
        )
    unit = RUN if len(common) > 1 else MAPS_OF_ONE_RUN
    rows = [_judged(*each, len(common)) for each in _all_values(a, b, apart_from)]
    if not rows:
        raise InputError(f"{path_a} and {path_b}: their common runs have no rows in common")
    table = pd.DataFrame(rows)
    table["p_holm"] = better.holm(table["p"].to_numpy())
    table["verdict"] = [_verdict(row) for row in table.to_dict("records")]
    notes += _differing_settings(a, b)
    for names, which in ((runs_a - runs_b, "first"), (runs_b - runs_a, "second")):
        if names:
            runs = f"{len(names)} run{'s' * (len(names) > 1)} of the {which}"
            notes.append(f"left out: {runs} that the other has not ({_some(names)})")
    is_common = match_names(a.described, apart_from).isin(common)
    worlds = a.described.loc[is_common, ["scenario", "seed"]].drop_duplicates()
    notes += _notes_on(table, unit, len(common), len(worlds))
    return VersionComparison(table.drop(columns=_NOT_SHOWN), unit, len(common), tuple(notes))


def _names(path: Path, runs: Runs, apart_from: Sequence[str]) -> set[str]:
    """What the runs of one side are matched by."""
    names = match_names(runs.described, apart_from)
    several = names[names.duplicated()]
    if apart_from and len(several):
        settings = " and ".join(apart_from)
        raise InputError(
            f"{path}: {several.iloc[0]} is there more than once, with other values of {settings}; "
            "each side may have one"
        )
    return set(names)


def _apart_from(a: Runs, b: Runs, settings: Sequence[str]) -> list[str]:
    """What each side has of the settings that runs are not matched by."""
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


def _judged(quantity: Quantity, method: str, values: pd.DataFrame, n_runs: int) -> dict[str, Any]:
    """One row of the table, verdict and correction apart."""
    is_share = quantity.scale == "share"
    of_maps, run_id = values["change"].to_numpy(), values["run_id"]
    changes = better.change_of_each_run(of_maps, run_id, n_runs, is_share)
    found = better.mean_change(changes)
    told = np.exp(found[:3]) if quantity.scale == "ratio" else found[:3]
    a, b = values[["a", "b"]].agg("mean" if is_share else "median")
    row = {"metric": quantity.metric, "method": method} | quantity._asdict() | {"a": a, "b": b}
    row |= dict(zip(("change", "low", "high"), told, strict=True))
    row |= {"n_units": len(changes), "n_rows": len(values), "p": found.p}
    return row | {"identical": not values["change"].any()}


def _verdict(row: dict[Any, Any]) -> str:
    if row["identical"]:
        return SAME
    if row["n_units"] < 2:
        return UNKNOWN
    change, least = row["change"], LEAST_CHANGE
    if row["scale"] == "ratio":
        change, least = np.log(change), np.log1p(least)
    if not row["p_holm"] <= better.SIGNIFICANCE or abs(change) < least:
        return NOISE
    return BETTER if (change > 0) == row["higher_is_better"] else WORSE


def _some(names: set[str]) -> str:
    shown = ", ".join(islice(sorted(names), _SHOWN_NAMES))
    return shown + (f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else "")


def _notes_on(table: pd.DataFrame, unit: str, n_runs: int, n_worlds: int) -> list[str]:
    notes = []
    if unit == MAPS_OF_ONE_RUN:
        notes.append(
            "weak: one run each. The noise is that between the robots and maps of this run, which "
            "depend on each other; another seed may say otherwise. Compare six seeds or more"
        )
    elif n_worlds < better.FEW_RUNS:
        worlds = f"{n_worlds} world{'s' * (n_worlds > 1)} (scenario and seed)"
        notes.append(
            f"weak: {n_runs} runs in {worlds}. The test takes the changes for normally "
            f"distributed, which so few cannot show; compare {better.FEW_RUNS} seeds or more"
        )
    if table["timed"].any():
        notes.append(
            "times: all runs of a version share its machine and load, which no resampling of runs "
            "can tell from a change of the program; they never count for --fail-if-worse"
        )
    return notes


def _differing_settings(a: Runs, b: Runs) -> list[str]:
    """Settings in which the scenarios of matched results differ."""
    found: dict[str, str] = {}
    for x, y in ((x, y) for x in a.results for y in b.results if x.run == y.run):
        both = pd.DataFrame([_flat(x), _flat(y)]).fillna("absent")
        for key, (old, new) in both.sort_index(axis=1).items():
            if old != new:
                found[str(key)] = f"{key} is {old} in the first and {new} in the second"
    shown = [f"the scenarios differ: {text}" for text in islice(found.values(), _SHOWN_NAMES)]
    more = len(found) - len(shown)
    return [*shown, f"the scenarios differ in {more} more settings"] if more else shown


def _flat(result: RunPath) -> dict[str, str]:
    """Settings by dotted name, as JSON."""
    scenario = read_scenario(result.path / "scenario.json")
    settings = pd.json_normalize(scenario).to_dict("records")[0]
    return {str(name): json.dumps(value) for name, value in settings.items()}


def _all_values(
    a: Runs, b: Runs, apart_from: Sequence[str]
) -> Iterator[tuple[Quantity, str, pd.DataFrame]]:
    """All quantities that both have tables for, the method, and columns run_id, a, b, change."""
    for table in READ:
        if not (a.has(table) and b.has(table)):
            continue
        rows = _joined(a, b, table, apart_from)
        for method in [
            *(judged_maps.methods_in(rows, oracle=True) if "aligner" in rows else []),
            "",
        ]:
            own = rows[rows["aligner"] == method] if method else rows
            of = method if method in ("", ORACLE) else EACH_METHOD
            for quantity in QUANTITIES:
                if (quantity.table, quantity.of) == (table, of):
                    values = _changes(quantity, own)
                    if len(values):
                        yield quantity, method, values


def _joined(a: Runs, b: Runs, table: str, apart_from: Sequence[str]) -> pd.DataFrame:
    """Rows of both by run and keys, values with the suffixes _a and _b; the lesser counts."""
    columns, optional, reduce = READ[table]
    frames = []
    for runs in (a, b):
        parts = []
        for rows in runs.batches(table, columns, optional):
            named = rows.drop(columns=[*judged_maps.RUN_KEYS, *judged_maps.setting_columns(rows)])
            parts.append(reduce(named.assign(run_id=match_names(rows, apart_from))))
        # a run of one robot has no rows, and must not decide the columns' types
        parts = [part for part in parts if len(part)] or parts[:1]
        frames.append(pd.concat(parts, ignore_index=True))
    keys = [name for name in _KEYS if name in frames[0]]
    joined = frames[0].merge(frames[1], on=keys, suffixes=("_a", "_b"))
    lesser = {
        name: joined.filter(like=name).min(axis=1)
        for name in judged_maps.COUNTS
        if name in frames[0]
    }
    return joined.assign(**lesser)


def _changes(quantity: Quantity, rows: pd.DataFrame) -> pd.DataFrame:
    """Where both versions have a value and the change is finite; success tells the rest."""
    rows = rows.query(quantity.where) if quantity.where else rows
    a, b = (rows[f"{quantity.column}_{side}"].to_numpy(dtype=np.float64) for side in "ab")
    if quantity.scale == "ln":  # too small a covariance is as wrong as one too large
        change = np.abs(better.log_ratio(b, np.ones(1))) - np.abs(better.log_ratio(a, np.ones(1)))
    else:
        change = b - a if quantity.scale == "share" else better.log_ratio(b, a)
    frame = pd.DataFrame({"run_id": rows["run_id"], "a": a, "b": b, "change": change})
    return frame[np.isfinite(a) & np.isfinite(change)]
