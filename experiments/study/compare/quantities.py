"""What two versions are compared in, and what is read for it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import pandas as pd

from experiments.judge import judged_maps
from experiments.judge.criteria import (
    ANSWERABLE_PAIRS,
    COMMON_LANDMARKS,
    ORACLE,
    RICH_PAIRS,
    is_false_merge,
    right_refined,
)
from experiments.judge.judged_fusers import last_fused
from experiments.judge.judged_maps import MAP_KEYS, MAP_PAIR
from experiments.judge.path_errors import path_rms
from experiments.judge.team_figures import believed
from experiments.study.statistics.error_bands import ROBOT_PAIR

EACH_METHOD = "each method"  # fusers too
_ROBOT = ("run_id", "robot")
_NEES, _REFINED = "nees_with_drift", "refined_translation_error_m"


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


def _maps_over_oracle(errors: pd.DataFrame) -> pd.DataFrame:
    """Rows of `maps_of`, with each map's refined error over the oracle's there."""
    maps = judged_maps.maps_of(errors)
    of_oracle = maps.assign(oracle=maps[_REFINED].where(maps["aligner"] == ORACLE))
    reference = of_oracle.groupby(MAP_PAIR)["oracle"].transform("first")
    return maps.assign(over_oracle=maps[_REFINED] / reference)


def _nees_per_dof(fusion: pd.DataFrame) -> pd.DataFrame:
    true = fusion[fusion["true_pair"]]
    per_dof = true.assign(nees=true[_NEES] / true["degrees_of_freedom"])
    return per_dof.groupby(["run_id", *ROBOT_PAIR], sort=False)["nees"].mean().reset_index()


def _fused_last(fusers: pd.DataFrame) -> pd.DataFrame:
    """Each fuser's last map, as of a method."""
    return last_fused(fusers).drop(columns="iteration").rename(columns={"fuser": "aligner"})


def _team_alignments(pairs: pd.DataFrame) -> pd.DataFrame:
    used, right = believed(pairs), right_refined(pairs)
    false = is_false_merge(pairs) & used
    off_m = pairs["team_translation_error_m"]
    return pairs.assign(found=(right & used).astype(float), false=false.astype(float), off_m=off_m)


_SMOOTHER = ("path_rmse_m", "landmark_rmse_m", "nees_per_dof")
_FUSERS = ("landmark_rmse_m", "over_better_filter", "nees_per_dof", "coverage_95")
# What is read of each table, what older runs may lack of it, and how a run's rows are reduced.
READ: dict[str, tuple[Sequence[str] | None, Sequence[str], Callable[..., pd.DataFrame]]] = {
    "errors": (judged_maps.NEEDED, judged_maps.OPTIONAL, _maps_over_oracle),
    "robots": (["robot", "path_error_m", "odometry_error_m"], (), partial(path_rms, by=_ROBOT)),
    "map_fits": (["map", "rmse_m"], (), pd.DataFrame),
    "smoother": (["robot", *_SMOOTHER], (), pd.DataFrame),
    "fusers": (["fuser", "iteration", *_FUSERS], (), _fused_last),
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
