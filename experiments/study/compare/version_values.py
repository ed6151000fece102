"""What two versions of the same runs measured, value beside value, for `mapfusion compare`.

Only what both have counts: the same scenario, seed and settings, robot pair, iteration and aligner.
"""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from experiments.judge.metrics import MIN_TRUE_PAIRS, ORACLE
from experiments.study.statistics.judged_maps import (
    ANSWERABLE_PAIRS,
    MAP_KEYS,
    Criteria,
    methods_in,
    read_maps,
)
from experiments.study.statistics.run_tables import RUN_KEYS, Runs, match_names, setting_columns

MATCH = "match"
# How a change is told: as a ratio b / a, as a difference of shares, or as a difference of distances
# from consistency |ln(NEES per degree of freedom)|.
Scale = Literal["ratio", "share", "ln"]


class Metric(NamedTuple):
    """A quantity that two versions are compared in.

    Attributes:
        name: of the quantity, with its unit.
        aligner: whose, or empty.
        scale: how its change is told.
        higher_is_better: else lower is.
        timed: depends on the machine and its load, which runs share.
    """

    name: str
    aligner: str
    scale: Scale
    higher_is_better: bool = False
    timed: bool = False


class Values(NamedTuple):
    """One metric in both versions: columns match (the run), a, b, change."""

    metric: Metric
    rows: pd.DataFrame


def all_values(a: Runs, b: Runs, criteria: Criteria) -> Iterator[Values]:
    """All metrics that both versions have tables for."""
    if a.has("errors") and b.has("errors"):
        yield from _alignment_values(_matched_maps(a, b, criteria))
    for table, build in (("robots", _paths), ("map_fits", _fits), ("fusion", _nees)):
        if a.has(table) and b.has(table):
            yield from build(a, b)
    if a.has("aligner_timings") and b.has("aligner_timings"):
        yield from _times(a, b)


def _matched_maps(a: Runs, b: Runs, criteria: Criteria) -> pd.DataFrame:
    first, second = (read_maps(runs, criteria) for runs in (a, b))
    return _joined(first, second, [*MAP_KEYS, "aligner"])


def _joined(a: pd.DataFrame, b: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Rows of both by run and keys, values with the suffixes _a and _b."""
    frames = []
    for frame in (a, b):
        dropped = [*RUN_KEYS, *setting_columns(frame)]
        frames.append(frame.assign(match=match_names(frame)).drop(columns=dropped))
    return frames[0].merge(frames[1], on=[MATCH, *keys], suffixes=("_a", "_b"))


def _alignment_values(maps: pd.DataFrame) -> Iterator[Values]:
    keys = [MATCH, *MAP_KEYS]
    oracle = maps[maps["aligner"] == ORACLE].set_index(keys)
    scarce = maps[["n_true_a", "n_true_b"]].min(axis=1)
    for aligner in methods_in(maps, oracle=True):
        own = maps[maps["aligner"] == aligner]
        if aligner == ORACLE:
            enough = own[scarce[own.index] >= ANSWERABLE_PAIRS]
            metric = Metric("refined error, m", aligner, "ratio")
            yield _ratio(metric, enough, "refined_translation_error_m")
            yield _ratio(Metric("true pairs", "", "ratio", True), enough, "n_true")
            continue
        for name, label, higher in (
            ("estimated_success", "success estimated", True),
            ("refined_success", "success refined", True),
            ("false_accepted", "wrongly accepted", False),
        ):
            yield _difference(Metric(label, aligner, "share", higher), own, name)
        ground = own[own[["n_common_a", "n_common_b"]].min(axis=1) >= ANSWERABLE_PAIRS]
        yield _difference(Metric("accepted", aligner, "share", True), ground, "accepted")
        enough = own[scarce[own.index] >= ANSWERABLE_PAIRS]
        metric = Metric("estimated error, m", aligner, "ratio")
        yield _ratio(metric, enough, "translation_error_m")
        rich = own[scarce[own.index] >= MIN_TRUE_PAIRS].set_index(keys)
        for side in "ab":
            column = f"refined_translation_error_m_{side}"
            rich[f"over_oracle_{side}"] = rich[column] / oracle[column].reindex(rich.index)
        metric = Metric("refined / oracle", aligner, "ratio")
        yield _ratio(metric, rich.reset_index(), "over_oracle")


def _ratio(metric: Metric, rows: pd.DataFrame, column: str) -> Values:
    """Log ratios, where both versions have a positive, finite value."""
    a, b = (rows[f"{column}_{side}"].to_numpy(dtype=np.float64) for side in "ab")
    usable = np.isfinite(a) & np.isfinite(b) & (a > 0) & (b > 0)
    equal = np.isfinite(a) & (a == b)
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.where(equal, 0.0, np.log(b) - np.log(a))
    frame = pd.DataFrame({MATCH: rows[MATCH].to_numpy(), "a": a, "b": b, "change": change})
    return Values(metric, frame[usable | equal])


def _difference(metric: Metric, rows: pd.DataFrame, column: str) -> Values:
    a, b = (rows[f"{column}_{side}"].to_numpy(dtype=np.float64) for side in "ab")
    frame = pd.DataFrame({MATCH: rows[MATCH].to_numpy(), "a": a, "b": b, "change": b - a})
    return Values(metric, frame.dropna())


def _path_rms(runs: Runs, column: str) -> pd.DataFrame:
    """Root mean square of an error per run and robot, one run in memory at a time."""
    parts = []
    for rows in runs.each("robots", ["robot", column]):
        keys = [*RUN_KEYS, *setting_columns(rows), "robot"]
        squares = rows.assign(**{column: rows[column] ** 2}).groupby(keys, sort=False)[column]
        parts.append((squares.mean() ** 0.5).reset_index())
    return pd.concat(parts, ignore_index=True)


def _paths(a: Runs, b: Runs) -> Iterator[Values]:
    for column, label in (
        ("path_error_m", "path RMSE, m"),
        ("odometry_error_m", "odometry RMSE, m"),
    ):
        first, second = (_path_rms(runs, column) for runs in (a, b))
        yield _ratio(Metric(label, "", "ratio"), _joined(first, second, ["robot"]), column)


def _fits(a: Runs, b: Runs) -> Iterator[Values]:
    first, second = (runs.read("map_fits", ["map", "rmse_m"]) for runs in (a, b))
    rows = _joined(first, second, ["map"])
    is_fused = rows["map"] == "fused"
    for label, own in (
        ("landmark RMSE, m", rows[~is_fused]),
        ("fused RMSE, m", rows[is_fused]),
    ):
        yield _ratio(Metric(label, "", "ratio"), own, "rmse_m")


def _nees(a: Runs, b: Runs) -> Iterator[Values]:
    """Distance from consistency: too small a covariance is as wrong as one too large."""
    first, second = (_nees_of_pairs(runs) for runs in (a, b))
    rows = _joined(first, second, ["robot_a", "robot_b"])
    rows = rows[(rows["nees_a"] > 0) & (rows["nees_b"] > 0)]
    change = np.abs(np.log(rows["nees_b"])) - np.abs(np.log(rows["nees_a"]))
    frame = pd.DataFrame(
        {MATCH: rows[MATCH], "a": rows["nees_a"], "b": rows["nees_b"], "change": change}
    )
    yield Values(Metric("fused NEES / dof", "", "ln"), frame)


def _nees_of_pairs(runs: Runs) -> pd.DataFrame:
    """Mean NEES per degree of freedom of truly fused landmarks, per run and robot pair."""
    columns = ["robot_a", "robot_b", "nees_with_drift", "degrees_of_freedom", "true_pair"]
    parts = []
    for rows in runs.each("fusion", columns):
        true = rows[rows["true_pair"]]
        per_dof = true.assign(nees=true["nees_with_drift"] / true["degrees_of_freedom"])
        keys = [*RUN_KEYS, *setting_columns(rows), "robot_a", "robot_b"]
        parts.append(per_dof.groupby(keys, sort=False)["nees"].mean().reset_index())
    return pd.concat(parts, ignore_index=True)


def _times(a: Runs, b: Runs) -> Iterator[Values]:
    keys = [*MAP_KEYS, "aligner"]
    first, second = (runs.read("aligner_timings", [*keys, "elapsed_s"]) for runs in (a, b))
    rows = _joined(first, second, keys)
    for aligner in methods_in(rows):
        metric = Metric("time, s", aligner, "ratio", timed=True)
        yield _ratio(metric, rows[rows["aligner"] == aligner], "elapsed_s")
