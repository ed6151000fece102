"""Two versions on the same runs: what got better or worse, and whether that is more than noise.

A run is the unit: what its maps, pairs and repetitions share they share with chance. Each metric
becomes one change a run; their mean is tested by Student's t over the runs, all tests together are
corrected by Holm's rule, and BCa's bootstrap over the runs gives the interval.
"""

import json
import warnings
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.stats

from experiments.scenario.randomness import generator
from experiments.study.compare.version_values import MATCH, Metric, Values, all_values
from experiments.study.statistics.bootstrap import MAPS_OF_ONE_RUN, RUN, mean_interval
from experiments.study.statistics.judged_maps import Criteria
from experiments.study.statistics.paired import holm
from experiments.study.statistics.run_tables import Runs, find_runs
from mapfusion.errors import InputError
from mapfusion.se2 import Float

SIGNIFICANCE = 0.05
# A change of less than one percent (or percentage point) matters to nobody who picks a method.
LEAST_CHANGE = 0.01
# A t test of fewer runs rests on the normal distribution alone: with five, signs all alike would
# not reach 5 % (2 / 2^5 = 6 %), with six they do.
FEW_RUNS = 6
BETTER, WORSE, SAME, NOISE, UNKNOWN = (
    "better",
    "worse",
    "identical",
    "no difference beyond noise",
    "cannot be judged",
)
_SHOWN_NAMES = 3


@dataclass(frozen=True)
class Comparison:
    """What two versions differ in.

    Attributes:
        table: one row a metric: metric, method, a and b (medians over all rows), scale, change (a
            factor b / a, or a difference), low, high, n_units, n_rows, p, p_holm, timed, verdict.
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


def compare(path_a: Path, path_b: Path) -> Comparison:
    """Compare version a with version b.

    Args:
        path_a: result or sweep folder of the first version.
        path_b: of the second.

    Raises:
        InputError: the two have no run in common, or no table.
    """
    a, b = find_runs(path_a), find_runs(path_b)
    runs_a, runs_b = a.names, b.names
    common = runs_a & runs_b
    if not common:
        raise InputError(
            f"{path_a} and {path_b}: no run in common (same scenario, seed and settings); "
            f"the first has {_some(runs_a)}, the second {_some(runs_b)}"
        )
    unit = RUN if len(common) > 1 else MAPS_OF_ONE_RUN
    criteria = min((Criteria.of(runs) for runs in (a, b)), key=lambda c: c.translation_m)
    rows = [_judged(values, unit) for values in all_values(a, b, criteria) if len(values.rows)]
    if not rows:
        raise InputError(f"{path_a} and {path_b}: their common runs have no rows in common")
    table = pd.DataFrame(rows)
    table["p_holm"] = holm(table["p"].to_numpy())
    table["verdict"] = [_verdict(row) for row in table.to_dict("records")]
    notes = [
        *_differing_settings(a, b),
        *_left_out(runs_a - runs_b, "first"),
        *_left_out(runs_b - runs_a, "second"),
        *_notes_on(table, unit, len(common)),
    ]
    return Comparison(table.drop(columns="higher_is_better"), unit, len(common), tuple(notes))


def _judged(values: Values, unit: str) -> dict[str, Any]:
    """One row of the table, verdict and correction apart."""
    metric, rows = values
    changes = _per_unit(metric, rows, unit)
    rng = generator(0, "compare", metric.name, metric.aligner)
    value, low, high = mean_interval(changes, rng)
    if metric.scale == "ratio":
        value, low, high = np.exp([value, low, high])
    return {
        "metric": metric.name,
        "method": metric.aligner,
        "a": rows["a"].median() if metric.scale != "share" else rows["a"].mean(),
        "b": rows["b"].median() if metric.scale != "share" else rows["b"].mean(),
        "scale": metric.scale,
        "change": value,
        "low": low,
        "high": high,
        "n_units": len(changes),
        "n_rows": len(rows),
        "p": _p_value(changes),
        "identical": not rows["change"].any(),
        "timed": metric.timed,
        "higher_is_better": metric.higher_is_better,
    }


def _per_unit(metric: Metric, rows: pd.DataFrame, unit: str) -> Float:
    """One change a run: the mean of shares, the median of log ratios (some maps are just lost)."""
    if unit == MAPS_OF_ONE_RUN:
        return rows["change"].to_numpy(dtype=np.float64)
    groups = rows.groupby(MATCH)["change"]
    return (groups.mean() if metric.scale == "share" else groups.median()).to_numpy(np.float64)


def _p_value(changes: Float) -> float:
    """Two-sided p of Student's t test that the mean change is 0; NaN where nothing changed."""
    if len(changes) < 2 or not changes.any():
        return np.nan
    if np.ptp(changes) == 0:  # all alike: t is infinite; what is left is that all signs agree
        return float(2.0 ** (1 - len(changes)))
    with warnings.catch_warnings():  # changes alike but for rounding
        warnings.simplefilter("ignore", RuntimeWarning)
        tested: Any = scipy.stats.ttest_1samp(changes, 0.0)
    return float(tested.pvalue)


def _verdict(row: dict[Any, Any]) -> str:
    if row["identical"]:
        return SAME
    if row["n_units"] < 2:
        return UNKNOWN
    ratio = row["scale"] == "ratio"
    change = np.log(row["change"]) if ratio else row["change"]
    least = np.log1p(LEAST_CHANGE) if ratio else LEAST_CHANGE
    if np.isnan(row["p_holm"]) or row["p_holm"] > SIGNIFICANCE or abs(change) < least:
        return NOISE
    return BETTER if (change > 0) == row["higher_is_better"] else WORSE


def _left_out(names: set[str], which: str) -> list[str]:
    if not names:
        return []
    runs = "1 run" if len(names) == 1 else f"{len(names)} runs"
    return [f"left out: {runs} of the {which} that the other has not ({_some(names)})"]


def _some(names: set[str]) -> str:
    shown = ", ".join(islice(sorted(names), _SHOWN_NAMES))
    return shown + (f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else "")


def _notes_on(table: pd.DataFrame, unit: str, n_runs: int) -> list[str]:
    notes = []
    if unit == MAPS_OF_ONE_RUN:
        notes.append(
            "weak: one run each. The noise is that between the robots and maps of this run, which "
            "depend on each other; another seed may say otherwise. Compare six seeds or more"
        )
    elif n_runs < FEW_RUNS:
        notes.append(
            f"weak: {n_runs} runs. The test takes the changes for normally distributed, which so "
            f"few cannot show; compare {FEW_RUNS} seeds or more"
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
    others = {(result.scenario, result.seed): result for result in b.results}
    for result in a.results:
        other = others.get((result.scenario, result.seed))
        if other is not None:
            first, second = (_flat(r.folder / "scenario.json") for r in (result, other))
            for key in sorted(first.keys() | second.keys()):
                old, new = first.get(key, "absent"), second.get(key, "absent")
                if old != new:
                    found[key] = f"{key} is {old} in the first and {new} in the second"
    shown = [f"the scenarios differ: {text}" for text in islice(found.values(), _SHOWN_NAMES)]
    more = len(found) - len(shown)
    return [*shown, f"the scenarios differ in {more} more settings"] if more else shown


def _flat(path: Path) -> dict[str, str]:
    """Settings by dotted name."""
    flat: dict[str, str] = {}

    def add(prefix: str, value: object) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                add(f"{prefix}.{key}" if prefix else str(key), inner)
        else:
            flat[prefix] = json.dumps(value)

    add("", json.loads(path.read_text(encoding="utf-8")))
    return flat
