"""Medians and 10-90 % bands of errors: the numbers of figures 4 to 6."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import alignment_summary
from experiments.evaluation.alignment_summary import (
    ERROR_COLUMNS,
    MAP_KEYS,
    RUN_KEYS,
    setting_columns,
)
from experiments.evaluation.criteria import ANSWERABLE_PAIRS, how_far_off

BAND = (0.1, 0.9)
_SIGNED = tuple(name for name in ERROR_COLUMNS if name.endswith("_rad"))
ROBOT_PAIR = ("robot_a", "robot_b")
TIME_GROUPS = 8


def error_bands(
    rows: pd.DataFrame, by: Sequence[str] = ROBOT_PAIR, absolute: bool = False
) -> pd.DataFrame:
    """Errors against the iteration: median and 10-90 % of the rows.

    A row without an estimate is infinitely far off. A signed rotation has no such value: it is NaN
    where not more than half of the rows have an estimate, and else of those that have one.

    Over the repetitions for rows of `errors`, over the runs for rows of `medians_of_run`; apart for
    each robot pair, or whatever `by` names; `absolute` drops the sign of rotations first.

    Returns:
        The columns of `by`, aligner, iteration, n_runs where runs are named, and for each error
        NAME_low, NAME (the median) and NAME_high.
    """
    rows, signed = _far_where_missing(rows, () if absolute else _SIGNED)
    groups = rows.groupby([*by, "aligner", "iteration"], sort=False)
    parts = [groups["run_id"].nunique().rename("n_runs")] if "run_id" in rows else []
    for column in ERROR_COLUMNS:
        low, high = (groups[column].quantile(q) for q in BAND)
        found = [low.rename(f"{column}_low"), groups[column].median()]
        found += [high.rename(f"{column}_high")]
        if column in signed:
            parts += [each.where(_mostly_known(groups, column)) for each in found]
        else:  # between two infinities pandas finds no quantile
            parts += [each.fillna(np.inf) for each in found]
    return pd.concat(parts, axis=1).reset_index()


def medians_of_run(errors: pd.DataFrame) -> pd.DataFrame:
    """A run's repetitions reduced to their median, as `error_bands` does it, rotations signed.

    The band of several runs is then over the runs, each of which counts once.
    """
    keys = [name for name in RUN_KEYS if name in errors] + setting_columns(errors)
    errors, signed = _far_where_missing(errors, _SIGNED)
    groups = errors.groupby([*keys, *MAP_KEYS, "aligner"], sort=False, dropna=False)
    medians = groups[list(ERROR_COLUMNS)].median()
    known = {name: medians[name].where(_mostly_known(groups, name)) for name in signed}
    parts = [medians.assign(**known), groups[list(alignment_summary.COUNTS)].first()]
    return pd.concat(parts, axis=1).reset_index()


def _far_where_missing(
    rows: pd.DataFrame, signed: Sequence[str]
) -> tuple[pd.DataFrame, Sequence[str]]:
    """The rows, infinitely far off where they have no estimate, but for the signed columns."""
    unsigned = [name for name in ERROR_COLUMNS if name not in signed]
    return rows.assign(**how_far_off(rows, unsigned)), signed


def _mostly_known(groups: Any, column: str) -> pd.Series:
    """Bool by group: whether more than half of its rows have a value."""
    return groups[column].count() > groups.size() / 2


def scarce_spans(rows: pd.DataFrame) -> list[tuple[float, float]]:
    """Stretches of iterations at which most maps have too few true pairs for an answer.

    All methods see the same maps, so any rows of `errors` or `medians_of_run` will do. Each stretch
    reaches half way to the next iteration.
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
    """Time of one alignment against the overlap, in groups of about equal size.

    Of rows of `aligner_timings`, by n_common or n_correspondences; equal ones stay together.

    Returns:
        aligner; COLUMN_low, COLUMN (the median) and COLUMN_high of the group; n_runs where runs
        are named, n_maps; of the maps' times 10 % elapsed_low_s, median elapsed_s and 90 %
        elapsed_high_s.
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
    return (
        bands.set_index("aligner")
        .loc[alignment_summary.methods_in(timed, oracle=True)]
        .reset_index()
    )
