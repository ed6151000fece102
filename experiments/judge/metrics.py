"""Figures that a run, or several runs pooled, are judged by.

Each takes the tables of one or more runs, pooled, with a column `seed`, and gives one number; NaN
where the tables hold no row it could be computed from. Errors are compared as medians over seeds,
robot pairs and iterations, after the repetitions on the same maps: single ratios exceed their bound
by chance. A new metric is a function with `@metric`, or `@aligner_metric` for one of each aligner.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from experiments.judge.criteria import (
    ORACLE,
    answerable,
    at_the_end,
    is_false_merge,
    mergeable,
    rich,
)
from experiments.judge.judged_maps import error_over_oracle, maps_of
from experiments.judge.path_errors import path_rms, rms

# The four methods of the paper, algorithm 1 in both readings, as the default list names them.
PAPER_ALIGNERS = ("ransac", "svd", "svd-solved", "icp", "impicp")
USED_TABLES = ("robots", "errors", "fusion", "map_fits")

Tables = Mapping[str, pd.DataFrame]
METRICS: dict[str, Callable[[Tables], float]] = {}
ALIGNER_METRICS: dict[str, Callable[[Tables, str], float]] = {}
_PAIR = ["seed", "robot_a", "robot_b"]


def metric(function: Callable[[Tables], float]) -> Callable[[Tables], float]:
    """Let scenarios expect this number, by the function's name."""
    METRICS[function.__name__] = function
    return function


def aligner_metric(function: Callable[[Tables, str], float]) -> Callable[[Tables, str], float]:
    """Likewise `ALIGNER.NAME`, of each aligner."""
    ALIGNER_METRICS[function.__name__] = function
    return function


@metric
def path_rmse_m(tables: Tables) -> float:
    """FastSLAM's online path error, RMS over iterations, median over seeds and robots."""
    return float(path_rms(tables["robots"], ("seed", "robot"))["path_m"].median())


@metric
def odometry_rmse_m(tables: Tables) -> float:
    """The same for odometry alone."""
    return float(path_rms(tables["robots"], ("seed", "robot"))["odometry_m"].median())


@metric
def path_over_odometry(tables: Tables) -> float:
    """FastSLAM's path RMSE over odometry's (ratio of the medians)."""
    return path_rmse_m(tables) / odometry_rmse_m(tables)


def _of(errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    return errors[errors["aligner"] == aligner]


def _oracle_at_the_end(tables: Tables) -> pd.DataFrame:
    return at_the_end(_of(tables["errors"], ORACLE))


@metric
def oracle_translation_m(tables: Tables) -> float:
    """Oracle's translation error at the last iteration, median over seeds and pairs."""
    return float(_oracle_at_the_end(tables)["refined_translation_error_m"].median())


@metric
def oracle_rotation_rad(tables: Tables) -> float:
    """Oracle's absolute rotation error at the last iteration, median over seeds and pairs."""
    return float(_oracle_at_the_end(tables)["refined_rotation_error_rad"].abs().median())


@metric
def true_pairs_at_end(tables: Tables) -> float:
    """True correspondences at the last iteration, median over seeds and pairs."""
    return float(_oracle_at_the_end(tables)["n_true"].median())


@metric
def fused_over_parents(tables: Tables) -> float:
    """RMS error of fused landmarks in frame a over the mean of their parents' RMS errors.

    Over true pairs: a false one has no single truth. Median over seeds and pairs.
    """
    fusion = tables["fusion"]
    ratios = []
    for _, rows in fusion[fusion["true_pair"]].groupby(_PAIR):
        parents = (rms(rows["error_a_m"]) + rms(rows["error_b_m"])) / 2
        ratios.append(rms(rows["error_fused_m"]) / parents)
    return float(np.median(ratios)) if ratios else np.nan


def _nees_per_dof(tables: Tables, column: str) -> float:
    fusion = tables["fusion"]
    rows = fusion[fusion["true_pair"]]
    return float((rows[column] / rows["degrees_of_freedom"]).mean()) if len(rows) else np.nan


@metric
def fused_nees_with_drift(tables: Tables) -> float:
    """Mean NEES per degree of freedom of fused landmarks, s_drift included; 1 is consistent."""
    return _nees_per_dof(tables, "nees_with_drift")


@metric
def fused_nees_without_drift(tables: Tables) -> float:
    """The same from the landmarks' own covariances alone."""
    return _nees_per_dof(tables, "nees_without_drift")


def _fits(tables: Tables, fused: bool) -> pd.DataFrame:
    fits = tables["map_fits"]
    return fits[(fits["map"] == "fused") == fused]


@metric
def landmark_rmse_median_m(tables: Tables) -> float:
    """Landmark RMSE after the best rigid fit: median over robots, then over seeds."""
    return float(_fits(tables, fused=False).groupby("seed")["rmse_m"].median().median())


@metric
def landmark_rmse_worst_m(tables: Tables) -> float:
    """Landmark RMSE after the best rigid fit: the worst robot of the worst seed."""
    return float(_fits(tables, fused=False)["rmse_m"].max())


@metric
def fused_landmark_rmse_m(tables: Tables) -> float:
    """The fused map's landmark RMSE after the best rigid fit, median over the seeds."""
    return float(_fits(tables, fused=True)["rmse_m"].median())


@aligner_metric
def refined_oracle_distance_m(tables: Tables, aligner: str) -> float:
    """Refined translation against the oracle's, where there are 30 or more true pairs."""
    return float(rich(_of(tables["errors"], aligner))["oracle_distance_m"].median())


@aligner_metric
def refined_over_oracle(tables: Tables, aligner: str) -> float:
    """Median refined translation error over the oracle's, 30 or more true pairs."""
    return _over_oracle(tables, aligner, "refined_translation_error_m")


@aligner_metric
def estimated_over_oracle(tables: Tables, aligner: str) -> float:
    """Median translation error as estimated over the oracle's, 30 or more true pairs."""
    return _over_oracle(tables, aligner, "translation_error_m")


def _over_oracle(tables: Tables, aligner: str, column: str) -> float:
    errors = rich(tables["errors"])
    maps = maps_of(errors[errors["aligner"].isin([aligner, ORACLE])])
    return float(error_over_oracle(maps, column).get(aligner, np.nan))


@aligner_metric
def estimated_translation_m(tables: Tables, aligner: str) -> float:
    """Median translation error as estimated, iterations with three or more true pairs."""
    maps = maps_of(answerable(_of(tables["errors"], aligner)))
    return float(maps["translation_error_m"].median())


@aligner_metric
def lead_over_others(tables: Tables, aligner: str) -> float:
    """How many times larger the best median error of the paper's other aligners is; over 1: best.

    As estimated. The paper's claim is about its own four (algorithm 1 in both readings).
    """
    maps = maps_of(rich(tables["errors"]))
    medians = maps.groupby("aligner")["translation_error_m"].median()
    others = medians[[name for name in medians.index if name in PAPER_ALIGNERS and name != aligner]]
    return float(others.min() / medians[aligner]) if len(others) and aligner in medians else np.nan


@aligner_metric
def scatter_m(tables: Tables, aligner: str) -> float:
    """10-90 % range of the translation error as estimated, median over seeds, pairs, iterations.

    Over the repetitions on the same maps: what the method's own randomness does.
    """
    return repetition_spread_m(rich(_of(tables["errors"], aligner)))


def repetition_spread_m(rows: pd.DataFrame) -> float:
    """The same of some rows of `errors` of one aligner."""
    keys = [name for name in ("run_id", *_PAIR, "iteration") if name in rows]
    groups = rows.groupby(keys)["translation_error_m"]
    return float((groups.quantile(0.9) - groups.quantile(0.1)).median())


@aligner_metric
def false_merges(tables: Tables, aligner: str) -> float:
    """Share of false merges among all of an aligner's answers (pairs, iterations, repetitions)."""
    return float(is_false_merge(_of(tables["errors"], aligner)).mean())


@aligner_metric
def missed_merges(tables: Tables, aligner: str) -> float:
    """Share refused of an aligner's answers where there are 20 or more true correspondences."""
    return float((~mergeable(_of(tables["errors"], aligner))["accepted"]).mean())


def known_metrics(aligners: list[str]) -> list[str]:
    """Every metric name a scenario with these aligners may use."""
    return [*METRICS, *(f"{aligner}.{name}" for aligner in aligners for name in ALIGNER_METRICS)]


def compute(name: str, tables: Tables) -> float:
    """The metric `name`, or `aligner.name` for those of one aligner."""
    if name in METRICS:
        return METRICS[name](tables)
    aligner, _, of_aligner = name.rpartition(".")
    return ALIGNER_METRICS[of_aligner](tables, aligner)
