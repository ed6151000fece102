"""Medians and 10-90 % bands of errors: the numbers of figures 4 to 6."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import criteria
from experiments.evaluation.criteria import (
    ANSWERABLE_PAIRS,
    ERROR_COLUMNS,
    MAP_KEYS,
    RUN_KEYS,
    absolute_errors,
    setting_columns,
)

BAND = (0.1, 0.9)
_SIGNED = tuple(name for name in ERROR_COLUMNS if name.endswith("_rad"))
ROBOT_PAIR = ("robot_a", "robot_b")
TIME_GROUPS = 8


def error_bands(
    rows: pd.DataFrame, by: Sequence[str] = ROBOT_PAIR, absolute: bool = False
) -> pd.DataFrame:
    """Return median and 10-90 % band of errors by iteration.

    Bands are over repetitions for rows of `errors` and over runs for rows of `medians_of_run`. A
    row without an estimate counts as an infinite error. A signed rotation cannot be infinite: its
    band is NaN unless more than half of the rows have an estimate, and uses these rows only.

    Args:
        rows: rows of `errors` or `medians_of_run`.
        by: columns that separate groups, by default the robot pair.
        absolute: True to drop the sign of rotations.

    Returns:
        The columns of `by`, aligner, iteration, n_runs if rows have a run_id, and for each error
        NAME_low, NAME (the median) and NAME_high.
    """
    signed = () if absolute else _SIGNED
    rows = _infinite_where_missing(rows, signed)
    groups = rows.groupby([*by, "aligner", "iteration"], sort=False)
    parts = [groups["run_id"].nunique().rename("n_runs")] if "run_id" in rows else []
    for column in ERROR_COLUMNS:
        low, high = (groups[column].quantile(q) for q in BAND)
        found = [low.rename(f"{column}_low"), groups[column].median()]
        found += [high.rename(f"{column}_high")]
        if column in signed:
            parts += [each.where(_mostly_known(groups, column)) for each in found]
        else:  # pandas returns NaN for a quantile between two infinities
            parts += [each.fillna(np.inf) for each in found]
    return pd.concat(parts, axis=1).reset_index()


def medians_of_run(errors: pd.DataFrame) -> pd.DataFrame:
    """Reduce a run's repetitions to medians as `error_bands` does, with signed rotations.

    Bands of several runs are then over runs, and each run counts once.
    """
    keys = [name for name in RUN_KEYS if name in errors] + setting_columns(errors)
    errors = _infinite_where_missing(errors, _SIGNED)
    groups = errors.groupby([*keys, *MAP_KEYS, "aligner"], sort=False, dropna=False)
    medians = groups[list(ERROR_COLUMNS)].median()
    known = {name: medians[name].where(_mostly_known(groups, name)) for name in _SIGNED}
    parts = [medians.assign(**known), groups[list(criteria.COUNTS)].first()]
    return pd.concat(parts, axis=1).reset_index()


def _infinite_where_missing(rows: pd.DataFrame, signed: Sequence[str]) -> pd.DataFrame:
    """Return rows with infinite errors where there is no estimate, except in signed columns."""
    unsigned = [name for name in ERROR_COLUMNS if name not in signed]
    return rows.assign(**absolute_errors(rows, unsigned))


def _mostly_known(groups: Any, column: str) -> pd.Series:
    """Return True for each group in which more than half of the rows have a value."""
    return groups[column].count() > groups.size() / 2


def scarce_spans(rows: pd.DataFrame) -> list[tuple[float, float]]:
    """Return intervals of iterations in which most maps have too few true pairs for an answer.

    Rows are those of `errors` or `medians_of_run` of any method, as all methods get the same maps.
    Each interval extends half way to the next iteration.
    """
    maps = rows.drop_duplicates([name for name in ("run_id", *MAP_KEYS) if name in rows])
    scarce = (maps["n_true"] < ANSWERABLE_PAIRS).groupby(maps["iteration"]).mean() > 0.5
    at = scarce.index.to_numpy(dtype=np.float64)
    half = np.diff(at) / 2 if len(at) > 1 else np.array([0.5])
    start = at - np.concatenate([half[:1], half])[: len(at)]
    stop = at + np.concatenate([half, half[-1:]])[: len(at)]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], scarce.to_numpy().astype(int), [0]])))
    return [(float(start[first]), float(stop[end - 1])) for first, end in edges.reshape(-1, 2)]


def time_bands(
    timings: pd.DataFrame, column: str = "n_common", groups: int = TIME_GROUPS
) -> pd.DataFrame:
    """Return the time of one alignment by overlap, in groups of about equal size.

    Args:
        timings: rows of `aligner_timings`.
        column: n_common or n_correspondences; rows of equal value are in one group.
        groups: number of groups.

    Returns:
        aligner; COLUMN_low, COLUMN (the median) and COLUMN_high of the group; n_runs if rows have a
        run_id, n_maps; elapsed_low_s (10 %), elapsed_s (median) and elapsed_high_s (90 %).
    """
    timed = timings.dropna(subset="elapsed_s")
    rank = timed.groupby("aligner")[column].rank(pct=True)
    grouped = timed.assign(group=np.ceil(rank * groups)).groupby(["aligner", "group"])
    count, elapsed = grouped[column], grouped["elapsed_s"]
    found = {f"{column}_low": count.min(), column: count.median(), f"{column}_high": count.max()}
    found |= {"n_runs": grouped["run_id"].nunique()} if "run_id" in timed else {}
    found |= {"n_maps": grouped.size(), "elapsed_low_s": elapsed.quantile(BAND[0])}
    found |= {"elapsed_s": elapsed.median(), "elapsed_high_s": elapsed.quantile(BAND[1])}
    bands = pd.DataFrame(found).reset_index().drop(columns="group")
    return bands.set_index("aligner").loc[criteria.methods_in(timed, oracle=True)].reset_index()
