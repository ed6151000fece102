"""What two versions of the same runs measured, value beside value, for `mapfusion compare`.

Only what both have counts: the same scenario, seed and settings, robot pair, iteration and aligner.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE, answerable, has_common_ground, rich
from experiments.judge.judged_maps import (
    MAP_KEYS,
    NEEDED,
    OPTIONAL,
    RUN_KEYS,
    maps_of,
    methods_in,
    setting_columns,
)
from experiments.judge.path_errors import path_rms
from experiments.study.statistics.better import log_ratio
from experiments.study.statistics.run_tables import Runs, match_names

MATCH = "match"
# How a change is told: as a ratio b / a, as a difference of shares, or as a difference of distances
# from consistency |ln(NEES per degree of freedom)|.
Scale = Literal["ratio", "share", "ln"]


class Quantity(NamedTuple):
    """What two versions are compared in.

    Attributes:
        metric: its name, with its unit.
        method: the aligner, or empty.
        scale: how its change is told.
        higher_is_better: else lower is.
        timed: depends on the machine and its load, which runs share.
    """

    metric: str
    method: str
    scale: Scale
    higher_is_better: bool = False
    timed: bool = False


class Values(NamedTuple):
    """One quantity in both versions: columns match (the run), a, b, change."""

    quantity: Quantity
    rows: pd.DataFrame


def all_values(a: Runs, b: Runs) -> Iterator[Values]:
    """All quantities that both versions have tables for."""
    for table, build in _BUILT_FROM.items():
        if a.has(table) and b.has(table):
            yield from build(a, b)


def _joined(
    a: Runs, b: Runs, keys: Sequence[str], read: Callable[[Runs], Iterator[pd.DataFrame]]
) -> pd.DataFrame:
    """Rows of both by run and keys, values with the suffixes _a and _b."""
    frames = []
    for runs in (a, b):
        # a run of one robot has no rows, and must not decide the columns' types
        parts = list(read(runs))
        frame = pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)
        dropped = [*RUN_KEYS, *setting_columns(frame)]
        frames.append(frame.assign(match=match_names(frame)).drop(columns=dropped))
    return frames[0].merge(frames[1], on=[MATCH, *keys], suffixes=("_a", "_b"))


def _in_both(rows: pd.DataFrame, kept: Callable[[pd.DataFrame], pd.DataFrame]) -> pd.DataFrame:
    """The rows whose true pairs and common landmarks are enough in both versions."""
    counts = {name: rows[[f"{name}_a", f"{name}_b"]].min(axis=1) for name in ("n_true", "n_common")}
    return rows.loc[kept(pd.DataFrame(counts)).index]


def _of_alignments(a: Runs, b: Runs) -> Iterator[Values]:
    keys = [*MAP_KEYS, "aligner"]
    maps = _joined(a, b, keys, lambda runs: map(maps_of, runs.each("errors", NEEDED, OPTIONAL)))
    refined = "refined_translation_error_m"
    oracle = maps[maps["aligner"] == ORACLE]
    sides = [f"{refined}_a", f"{refined}_b"]
    reference = oracle.set_index([MATCH, *MAP_KEYS])[sides].add_prefix("oracle_")
    maps = maps.join(reference, on=[MATCH, *MAP_KEYS])
    for side in "ab":
        maps[f"over_oracle_{side}"] = maps[f"{refined}_{side}"] / maps[f"oracle_{refined}_{side}"]
    for aligner in methods_in(maps):
        own = maps[maps["aligner"] == aligner]
        for name, label, higher in (
            ("estimated_success", "success estimated", True),
            ("refined_success", "success refined", True),
            ("false_accepted", "wrongly accepted", False),
        ):
            yield _difference(Quantity(label, aligner, "share", higher), own, name)
        ground = _in_both(own, lambda rows: rows[has_common_ground(rows)])
        yield _difference(Quantity("accepted", aligner, "share", True), ground, "accepted")
        quantity = Quantity("estimated error, m", aligner, "ratio")
        yield _ratio(quantity, _in_both(own, answerable), "translation_error_m")
        quantity = Quantity("refined / oracle", aligner, "ratio")
        yield _ratio(quantity, _in_both(own, rich), "over_oracle")
    enough = _in_both(oracle, answerable)
    yield _ratio(Quantity("refined error, m", ORACLE, "ratio"), enough, refined)
    yield _ratio(Quantity("true pairs", "", "ratio", True), enough, "n_true")


def _ratio(quantity: Quantity, rows: pd.DataFrame, column: str) -> Values:
    """Log ratios, where both versions have a positive, finite value; success tells the rest."""
    a, b = (rows[f"{column}_{side}"].to_numpy(dtype=np.float64) for side in "ab")
    frame = pd.DataFrame({MATCH: rows[MATCH].to_numpy(), "a": a, "b": b, "change": log_ratio(b, a)})
    return Values(quantity, frame[np.isfinite(a) & np.isfinite(frame["change"])])


def _difference(quantity: Quantity, rows: pd.DataFrame, column: str) -> Values:
    a, b = (rows[f"{column}_{side}"].to_numpy(dtype=np.float64) for side in "ab")
    frame = pd.DataFrame({MATCH: rows[MATCH].to_numpy(), "a": a, "b": b, "change": b - a})
    return Values(quantity, frame.dropna())


def _of_paths(a: Runs, b: Runs) -> Iterator[Values]:
    def read(runs: Runs) -> Iterator[pd.DataFrame]:
        for rows in runs.each("robots", ["robot", "path_error_m", "odometry_error_m"]):
            yield path_rms(rows, [*RUN_KEYS, *setting_columns(rows), "robot"])

    rows = _joined(a, b, ["robot"], read)
    yield _ratio(Quantity("path RMSE, m", "", "ratio"), rows, "path_m")
    yield _ratio(Quantity("odometry RMSE, m", "", "ratio"), rows, "odometry_m")


def _of_fits(a: Runs, b: Runs) -> Iterator[Values]:
    rows = _joined(a, b, ["map"], lambda runs: runs.each("map_fits", ["map", "rmse_m"]))
    is_fused = rows["map"] == "fused"
    yield _ratio(Quantity("landmark RMSE, m", "", "ratio"), rows[~is_fused], "rmse_m")
    yield _ratio(Quantity("fused RMSE, m", "", "ratio"), rows[is_fused], "rmse_m")


def _of_consistency(a: Runs, b: Runs) -> Iterator[Values]:
    """Distance from consistency: too small a covariance is as wrong as one too large."""

    def read(runs: Runs) -> Iterator[pd.DataFrame]:
        columns = ["robot_a", "robot_b", "nees_with_drift", "degrees_of_freedom", "true_pair"]
        for rows in runs.each("fusion", columns):
            true = rows[rows["true_pair"]]
            per_dof = true.assign(nees=true["nees_with_drift"] / true["degrees_of_freedom"])
            keys = [*RUN_KEYS, *setting_columns(rows), "robot_a", "robot_b"]
            yield per_dof.groupby(keys, sort=False)["nees"].mean().reset_index()

    rows = _joined(a, b, ["robot_a", "robot_b"], read)
    rows = rows[(rows["nees_a"] > 0) & (rows["nees_b"] > 0)]
    off = {side: np.abs(np.log(rows[f"nees_{side}"])) for side in "ab"}
    frame = rows.rename(columns={"nees_a": "a", "nees_b": "b"})[[MATCH, "a", "b"]]
    quantity = Quantity("fused NEES / dof", "", "ln")
    yield Values(quantity, frame.assign(change=off["b"] - off["a"]))


def _of_times(a: Runs, b: Runs) -> Iterator[Values]:
    keys = [*MAP_KEYS, "aligner"]
    rows = _joined(a, b, keys, lambda runs: runs.each("aligner_timings", [*keys, "elapsed_s"]))
    for aligner in methods_in(rows):
        quantity = Quantity("time, s", aligner, "ratio", timed=True)
        yield _ratio(quantity, rows[rows["aligner"] == aligner], "elapsed_s")


_BUILT_FROM = {
    "errors": _of_alignments,
    "robots": _of_paths,
    "map_fits": _of_fits,
    "fusion": _of_consistency,
    "aligner_timings": _of_times,
}
