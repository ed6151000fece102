"""Figures that a run, or several runs pooled, are judged by.

Each takes the tables of one or more runs, pooled, with a column `seed`, and gives one number; NaN
where the tables hold no row it could be computed from. Errors are compared as medians over seeds,
robot pairs and iterations, after the repetitions on the same maps: single ratios exceed their bound
by chance. A new metric is a name in `experiments/scenario/settings.py` and a function here with
`@metric()`; one that takes a further argument `aligner` is of each aligner; several of one shape
are one function with `@metric(NAME=WHICH, ...)`.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import pandas as pd

from experiments.evaluation import criteria
from experiments.evaluation.criteria import (
    ORACLE,
    error_over_oracle,
    merged_robots,
    rich,
    summarise_alignments,
)
from experiments.evaluation.path_errors import path_rms, rms
from experiments.evaluation.team_errors import edge_precision, edge_recall
from experiments.scenario.settings import FUSER_METRICS

# The four methods of the paper, algorithm 1 in both readings, as the default list names them.
PAPER_ALIGNERS = ("ransac", "svd", "svd-solved", "icp", "impicp")
USED_TABLES = ("robots", "errors", "fusion", "map_fits", "fused_motions", "team", "team_pairs")
USED_TABLES += ("smoother", "fusers")
MERGED_ROBOTS = "team.merged_robots"
WITHOUT_TRUTH = (MERGED_ROBOTS,)  # those that can be measured where no truth is known

Tables = Mapping[str, pd.DataFrame]
Metric = Callable[..., float]
METRICS: dict[str, Metric] = {}
ALIGNER_METRICS: dict[str, Metric] = {}  # named ALIGNER.NAME, of each aligner
_PAIR = ["seed", "robot_a", "robot_b"]


def metric(**which: str) -> Callable[[Metric], Metric]:
    """Let scenarios expect this number by the function's name, or one number by each name given."""

    def register(function: Metric) -> Metric:
        of_aligner = "aligner" in inspect.signature(function).parameters
        known = ALIGNER_METRICS if of_aligner else METRICS
        variants = {name: partial(function, which=value) for name, value in which.items()}
        known.update(variants or {function.__name__: function})
        return function

    return register


def _of(errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    return errors[errors["aligner"] == aligner]


@metric(path_rmse_m="path_m", odometry_rmse_m="odometry_m")
def _path_rmse_m(tables: Tables, which: str) -> float:
    """Error of FastSLAM's online path, or of odometry, RMS over iterations, median over robots."""
    return path_rms(tables["robots"], ("seed", "robot"))[which].median()


@metric()
def path_over_odometry(tables: Tables) -> float:
    """FastSLAM's path RMSE over odometry's (ratio of the medians)."""
    return METRICS["path_rmse_m"](tables) / METRICS["odometry_rmse_m"](tables)


_SMOOTHER = ("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share")
_SMOOTHER += ("nees_per_dof", "coverage_95")


def _of_a_fuser(tables: Tables, fuser: str, name: str) -> float:
    """A column of the table `fusers` at the last iteration, median over seeds."""
    rows = tables["fusers"]
    rows = rows[rows["fuser"] == fuser].sort_values("iteration", kind="stable")
    return rows.groupby("seed")[name].last().median()


@metric(**{f"smoother.{name}": name for name in _SMOOTHER})
def _of_the_smoother(tables: Tables, which: str) -> float:
    """A column of the table `smoother`, median over robots and seeds."""
    return tables["smoother"][which].median()


@metric(
    oracle_translation_m="refined_translation_error_m",
    oracle_rotation_rad="refined_rotation_error_rad",
    true_pairs_at_end="n_true",
)
def _oracle_at_the_end(tables: Tables, which: str) -> float:
    """The oracle's errors and true pairs at the last iteration, median over seeds and pairs."""
    rows = criteria.at_the_end(_of(tables["errors"], ORACLE))
    return criteria.absolute_errors(rows, [which])[which].median()


def _truly_fused(tables: Tables) -> pd.DataFrame:
    """A false pair has no single truth."""
    return tables["fusion"][tables["fusion"]["true_pair"]]


@metric()
def fused_over_parents(tables: Tables) -> float:
    """RMS error of fused landmarks over the mean of their parents', median over seeds and pairs."""
    a, b, fused = (
        _truly_fused(tables).groupby(_PAIR)[f"error_{of}_m"].agg(rms) for of in ("a", "b", "fused")
    )
    return (fused / ((a + b) / 2)).median()


@metric(fused_nees_with_drift="nees_with_drift", fused_nees_without_drift="nees_without_drift")
def _nees_per_dof(tables: Tables, which: str) -> float:
    """Mean NEES per degree of freedom of fused landmarks; 1 is consistent."""
    rows = _truly_fused(tables)
    return (rows[which] / rows["degrees_of_freedom"]).mean()


@metric(landmark_rmse_median_m="median", landmark_rmse_worst_m="max")
def _landmark_rmse_m(tables: Tables, which: str) -> float:
    """Robots' landmark RMSE after the best rigid fit: median or worst robot, then seed."""
    fits = tables["map_fits"]
    return fits[fits["map"] != "fused"].groupby("seed")["rmse_m"].agg(which).agg(which)


@metric()
def fused_landmark_rmse_m(tables: Tables) -> float:
    """The fused map's landmark RMSE after the best rigid fit, median over the seeds."""
    return tables["map_fits"].query("map == 'fused'")["rmse_m"].median()


@metric(**{MERGED_ROBOTS: "tx_m"})
def _merged_robots(tables: Tables, which: str) -> float:
    """Robots whose maps became one map, median over the seeds; 0 where none were merged."""
    return tables["fused_motions"].groupby("seed")[which].agg(merged_robots).median()


@metric(**{"team.ate_rmse_m": "rmse"})
def _team_ate_m(tables: Tables, which: str) -> float:
    """ATE (RMSE) of all merged robots' final paths under one rigid fit, median over the seeds."""
    return tables["team"].query("component == 1 and source == 'final'")[which].median()


@metric(
    **{
        "team.translation_m": "team_translation_error_m",
        "team.rotation_rad": "team_rotation_error_rad",
    }
)
def _team_pair_error(tables: Tables, which: str) -> float:
    """Error of T_a_b as the team places a and b, median over seeds and pairs in one map."""
    return tables["team_pairs"][which].abs().median()


@metric(**{"team.edge_precision": "precision", "team.edge_recall": "recall"})
def _team_edges(tables: Tables, which: str) -> float:
    """Of all seeds' pairs: right among the believed; right and believed among those that met."""
    of = {"precision": edge_precision, "recall": edge_recall}[which]
    return of(tables["team_pairs"])


@metric()
def refined_oracle_distance_m(tables: Tables, aligner: str) -> float:
    """Refined translation against the oracle's, where there are 30 or more true pairs."""
    rows = rich(_of(tables["errors"], aligner))
    return criteria.absolute_errors(rows, ["oracle_distance_m"])["oracle_distance_m"].median()


@metric(
    refined_over_oracle="refined_translation_error_m", estimated_over_oracle="translation_error_m"
)
def _over_oracle(tables: Tables, aligner: str, which: str) -> float:
    """Median translation error over the oracle's, 30 or more true pairs."""
    errors = rich(tables["errors"])
    maps = summarise_alignments(errors[errors["aligner"].isin([aligner, ORACLE])])
    return error_over_oracle(maps, which).get(aligner, np.nan)


@metric()
def estimated_translation_m(tables: Tables, aligner: str) -> float:
    """Median translation error as estimated, iterations with three or more true pairs."""
    maps = summarise_alignments(criteria.answerable(_of(tables["errors"], aligner)))
    return maps["translation_error_m"].median()


@metric()
def lead_over_others(tables: Tables, aligner: str) -> float:
    """How many times larger the best median error of the paper's other aligners is; over 1: best.

    As estimated. The paper's claim is about its own four (algorithm 1 in both readings).
    """
    medians = (
        summarise_alignments(rich(tables["errors"]))
        .groupby("aligner")["translation_error_m"]
        .median()
    )
    others = medians[medians.index.isin({*PAPER_ALIGNERS} - {aligner})]
    return others.min() / medians.get(aligner, np.nan)


@metric()
def scatter_m(tables: Tables, aligner: str) -> float:
    """What the method's own randomness does: `repetition_spread_m`, 30 or more true pairs."""
    return repetition_spread_m(rich(_of(tables["errors"], aligner)))


def repetition_spread_m(rows: pd.DataFrame) -> float:
    """10-90 % range of one aligner's translation error over the repetitions on the same maps.

    As estimated, of those repetitions that gave an estimate; median over seeds, pairs, iterations.
    """
    keys = [name for name in ("run_id", *_PAIR, "iteration") if name in rows]
    groups = rows.groupby(keys)["translation_error_m"]
    return float((groups.quantile(0.9) - groups.quantile(0.1)).median())


@metric()
def false_merges(tables: Tables, aligner: str) -> float:
    """Share of false merges among all of an aligner's answers (pairs, iterations, repetitions)."""
    return criteria.is_false_merge(_of(tables["errors"], aligner)).mean()


@metric()
def missed_merges(tables: Tables, aligner: str) -> float:
    """Share refused of an aligner's answers where there are 20 or more true correspondences."""
    return (~criteria.mergeable(_of(tables["errors"], aligner))["accepted"]).mean()


def compute(name: str, tables: Tables) -> float:
    """The metric `name`, or `method.name` for those of one aligner or fuser."""
    if name in METRICS:
        return float(METRICS[name](tables))
    method, _, of_method = name.rpartition(".")
    if of_method in FUSER_METRICS:
        return float(_of_a_fuser(tables, method, of_method))
    return float(ALIGNER_METRICS[of_method](tables, method))
