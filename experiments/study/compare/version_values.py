"""What two versions of the same runs measured, value beside value, for `mapfusion compare`.

Only what both have counts: the same scenario, seed and settings, robot pair, iteration and aligner.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from experiments.judge.criteria import ANSWERABLE_PAIRS, COMMON_LANDMARKS, ORACLE, RICH_PAIRS
from experiments.judge.judged_maps import (
    COUNTS,
    MAP_KEYS,
    MAP_PAIR,
    NEEDED,
    OPTIONAL,
    RUN_KEYS,
    maps_of,
    methods_in,
    setting_columns,
)
from experiments.judge.path_errors import path_rms
from experiments.study.statistics.better import log_ratio
from experiments.study.statistics.error_bands import ROBOT_PAIR
from experiments.study.statistics.run_tables import Runs, match_names

_ROBOT = ("run_id", "robot")
_KEYS = (*MAP_PAIR, "aligner", "robot", "map")
_NEES, _REFINED = "nees_with_drift", "refined_translation_error_m"
_EACH = "each method"


class Quantity(NamedTuple):
    """What two versions are compared in: a column of the rows of a table, or of those `where`.

    Their counts are the lesser ones of the two versions. A change is told as a ratio b / a, as a
    difference of shares, or as one of distances from consistency |ln(NEES per degree of freedom)|.
    It is `of` each method, of the oracle, or of no aligner. What is timed depends on the machine
    and its load, which runs share.
    """

    table: str
    metric: str
    column: str
    scale: Literal["ratio", "share", "ln"] = "ratio"
    of: str = ""
    higher_is_better: bool = False
    where: str = ""
    timed: bool = False


def all_values(a: Runs, b: Runs) -> Iterator[tuple[Quantity, str, pd.DataFrame]]:
    """All quantities that both have tables for, the method, and columns run_id, a, b, change."""
    for table in _READ:
        if not (a.has(table) and b.has(table)):
            continue
        rows = _joined(a, b, table)
        for method in [*(methods_in(rows, oracle=True) if "aligner" in rows else []), ""]:
            own = rows[rows["aligner"] == method] if method else rows
            of = method if method in ("", ORACLE) else _EACH
            for quantity in _QUANTITIES:
                if (quantity.table, quantity.of) == (table, of):
                    values = _changes(quantity, own)
                    if len(values):
                        yield quantity, method, values


def _joined(a: Runs, b: Runs, table: str) -> pd.DataFrame:
    """Rows of both by run and keys, values with the suffixes _a and _b; the lesser counts."""
    frames = []
    for runs in (a, b):
        parts = list(_reduced(runs, table))
        # a run of one robot has no rows, and must not decide the columns' types
        parts = [part for part in parts if len(part)] or parts[:1]
        frames.append(pd.concat(parts, ignore_index=True))
    keys = [name for name in _KEYS if name in frames[0]]
    joined = frames[0].merge(frames[1], on=keys, suffixes=("_a", "_b"))
    lesser = {name: joined.filter(like=name).min(axis=1) for name in COUNTS if name in frames[0]}
    return joined.assign(**lesser)


def _reduced(runs: Runs, table: str) -> Iterator[pd.DataFrame]:
    """Each run's rows, the run named by what it is matched by."""
    columns, optional, reduce = _READ[table]
    for rows in runs.each(table, columns, optional):
        named = rows.drop(columns=[*RUN_KEYS, *setting_columns(rows)])
        yield reduce(named.assign(run_id=match_names(rows)))


def _changes(quantity: Quantity, rows: pd.DataFrame) -> pd.DataFrame:
    """Where both versions have a value and the change is finite; success tells the rest."""
    rows = rows.query(quantity.where) if quantity.where else rows
    a, b = (rows[f"{quantity.column}_{side}"].to_numpy(dtype=np.float64) for side in "ab")
    if quantity.scale == "ln":  # too small a covariance is as wrong as one too large
        change = np.abs(log_ratio(b, np.ones(1))) - np.abs(log_ratio(a, np.ones(1)))
    else:
        change = b - a if quantity.scale == "share" else log_ratio(b, a)
    frame = pd.DataFrame({"run_id": rows["run_id"], "a": a, "b": b, "change": change})
    return frame[np.isfinite(a) & np.isfinite(change)]


def _maps_over_oracle(errors: pd.DataFrame) -> pd.DataFrame:
    """Rows of `maps_of`, with each map's refined error over the oracle's there."""
    maps = maps_of(errors)
    of_oracle = maps.assign(oracle=maps[_REFINED].where(maps["aligner"] == ORACLE))
    reference = of_oracle.groupby(MAP_PAIR)["oracle"].transform("first")
    return maps.assign(over_oracle=maps[_REFINED] / reference)


def _nees_per_dof(fusion: pd.DataFrame) -> pd.DataFrame:
    true = fusion[fusion["true_pair"]]
    per_dof = true.assign(nees=true[_NEES] / true["degrees_of_freedom"])
    return per_dof.groupby(["run_id", *ROBOT_PAIR], sort=False)["nees"].mean().reset_index()


# What is read of each table, what older runs may lack of it, and how a run's rows are reduced.
_READ: dict[str, tuple[Sequence[str], Sequence[str], Callable[..., pd.DataFrame]]] = {
    "errors": (NEEDED, OPTIONAL, _maps_over_oracle),
    "robots": (["robot", "path_error_m", "odometry_error_m"], (), partial(path_rms, by=_ROBOT)),
    "map_fits": (["map", "rmse_m"], (), pd.DataFrame),
    "fusion": ([*ROBOT_PAIR, "true_pair", _NEES, "degrees_of_freedom"], (), _nees_per_dof),
    "aligner_timings": ([*MAP_KEYS, "aligner", "elapsed_s"], (), pd.DataFrame),
}
_GROUND = f"n_common >= {COMMON_LANDMARKS}"
_ENOUGH, _RICH = f"n_true >= {ANSWERABLE_PAIRS}", f"n_true >= {RICH_PAIRS}"
_OFFERED = f"aligner == '{ORACLE}' and {_ENOUGH}"
_QUANTITIES = (
    Quantity("errors", "success estimated", "estimated_success", "share", _EACH, True),
    Quantity("errors", "success refined", "refined_success", "share", _EACH, True),
    Quantity("errors", "wrongly accepted", "false_accepted", "share", _EACH),
    Quantity("errors", "accepted", "accepted", "share", _EACH, True, _GROUND),
    Quantity("errors", "estimated error, m", "translation_error_m", of=_EACH, where=_ENOUGH),
    Quantity("errors", "refined / oracle", "over_oracle", of=_EACH, where=_RICH),
    Quantity("errors", "refined error, m", _REFINED, of=ORACLE, where=_ENOUGH),
    Quantity("errors", "true pairs", "n_true", higher_is_better=True, where=_OFFERED),
    Quantity("robots", "path RMSE, m", "path_m"),
    Quantity("robots", "odometry RMSE, m", "odometry_m"),
    Quantity("map_fits", "landmark RMSE, m", "rmse_m", where="map != 'fused'"),
    Quantity("map_fits", "fused RMSE, m", "rmse_m", where="map == 'fused'"),
    Quantity("fusion", "fused NEES / dof", "nees", "ln"),
    Quantity("aligner_timings", "time, s", "elapsed_s", of=_EACH, timed=True),
)
