"""Figures that a run, or several runs pooled, are judged by.

Each takes the tables of one or more runs, pooled, with a column `seed`, and gives one number; NaN
where the tables hold no row it could be computed from. Errors are compared as medians over seeds,
robot pairs, iterations and repetitions: single ratios exceed their bound by chance.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

# The four methods of the paper, algorithm 1 in both readings, as the default list names them.
PAPER_ALIGNERS = ("ransac", "svd", "svd-solved", "icp", "impicp")
# Iterations with fewer true pairs are left out where an aligner is compared with the oracle: with
# a handful of pairs both are dominated by chance.
MIN_TRUE_PAIRS = 30
# An accepted alignment farther off than this is a false merge: it doubles every wall of a room, and
# is several times what the drift of two maps does (0.05 to 0.2 m, 0.01 rad).
FALSE_MERGE_M = 0.5
FALSE_MERGE_RAD = 0.1
# With as many true correspondences a robust method finds the motion, and refusing it is a miss.
MERGEABLE_TRUE_PAIRS = 20
ORACLE = "oracle"

Tables = Mapping[str, pd.DataFrame]
_RUN = ["seed", "robot"]
_PAIR = ["seed", "robot_a", "robot_b"]


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values.dropna())))) if values.notna().any() else np.nan


def path_rmse_m(tables: Tables) -> float:
    """FastSLAM's online path error, RMS over iterations, median over seeds and robots."""
    return float(tables["robots"].groupby(_RUN)["path_error_m"].apply(_rms).median())


def odometry_rmse_m(tables: Tables) -> float:
    """The same for odometry alone."""
    return float(tables["robots"].groupby(_RUN)["odometry_error_m"].apply(_rms).median())


def path_over_odometry(tables: Tables) -> float:
    """FastSLAM's path RMSE over odometry's (ratio of the medians)."""
    return path_rmse_m(tables) / odometry_rmse_m(tables)


def _last(errors: pd.DataFrame) -> pd.DataFrame:
    return errors[errors["iteration"] == errors.groupby(_PAIR)["iteration"].transform("max")]


def _of(errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    return errors[errors["aligner"] == aligner]


def _rich(errors: pd.DataFrame) -> pd.DataFrame:
    return errors[errors["n_true"] >= MIN_TRUE_PAIRS]


def oracle_translation_m(tables: Tables) -> float:
    """Oracle's translation error at the last iteration, median over seeds and pairs."""
    last = _last(_of(tables["errors"], ORACLE))
    return float(last["refined_translation_error_m"].median())


def oracle_rotation_rad(tables: Tables) -> float:
    """Oracle's absolute rotation error at the last iteration, median over seeds and pairs."""
    last = _last(_of(tables["errors"], ORACLE))
    return float(last["refined_rotation_error_rad"].abs().median())


def true_pairs_at_end(tables: Tables) -> float:
    """True correspondences at the last iteration, median over seeds and pairs."""
    return float(_last(_of(tables["errors"], ORACLE))["n_true"].median())


def fused_over_parents(tables: Tables) -> float:
    """RMS error of fused landmarks in frame a over the mean of their parents' RMS errors.

    Over true pairs: a false one has no single truth. Median over seeds and pairs.
    """
    fusion = tables["fusion"]
    ratios = []
    for _, rows in fusion[fusion["true_pair"]].groupby(_PAIR):
        parents = (_rms(rows["error_a_m"]) + _rms(rows["error_b_m"])) / 2
        ratios.append(_rms(rows["error_fused_m"]) / parents)
    return float(np.median(ratios)) if ratios else np.nan


def _nees_per_dof(tables: Tables, column: str) -> float:
    fusion = tables["fusion"]
    rows = fusion[fusion["true_pair"]]
    return float((rows[column] / rows["degrees_of_freedom"]).mean()) if len(rows) else np.nan


def fused_nees_with_drift(tables: Tables) -> float:
    """Mean NEES per degree of freedom of fused landmarks, s_drift included; 1 is consistent."""
    return _nees_per_dof(tables, "nees_with_drift")


def fused_nees_without_drift(tables: Tables) -> float:
    """The same from the landmarks' own covariances alone."""
    return _nees_per_dof(tables, "nees_without_drift")


def _fits(tables: Tables) -> pd.DataFrame:
    return tables["map_fits"]


def landmark_rmse_median_m(tables: Tables) -> float:
    """Landmark RMSE after the best rigid fit: median over robots, then over seeds."""
    own = _fits(tables)[_fits(tables)["map"] != "fused"]
    return float(own.groupby("seed")["rmse_m"].median().median())


def landmark_rmse_worst_m(tables: Tables) -> float:
    """Landmark RMSE after the best rigid fit: the worst robot of the worst seed."""
    return float(_fits(tables)[_fits(tables)["map"] != "fused"]["rmse_m"].max())


def fused_landmark_rmse_m(tables: Tables) -> float:
    """The fused map's landmark RMSE after the best rigid fit, median over the seeds."""
    return float(_fits(tables)[_fits(tables)["map"] == "fused"]["rmse_m"].median())


def refined_oracle_distance_m(tables: Tables, aligner: str) -> float:
    """Refined translation against the oracle's, where there are 30 or more true pairs."""
    return float(_rich(_of(tables["errors"], aligner))["oracle_distance_m"].median())


def refined_over_oracle(tables: Tables, aligner: str) -> float:
    """Median refined translation error over the oracle's, 30 or more true pairs."""
    rich = _rich(tables["errors"])
    return float(
        _of(rich, aligner)["refined_translation_error_m"].median()
        / _of(rich, ORACLE)["refined_translation_error_m"].median()
    )


def estimated_over_oracle(tables: Tables, aligner: str) -> float:
    """Median translation error as estimated over the oracle's, 30 or more true pairs."""
    rich = _rich(tables["errors"])
    return float(
        _of(rich, aligner)["translation_error_m"].median()
        / _of(rich, ORACLE)["refined_translation_error_m"].median()
    )


def estimated_translation_m(tables: Tables, aligner: str) -> float:
    """Median translation error as estimated, iterations with three or more true pairs."""
    errors = _of(tables["errors"], aligner)
    return float(errors[errors["n_true"] >= 3]["translation_error_m"].median())


def lead_over_others(tables: Tables, aligner: str) -> float:
    """How many times larger the best median error of the paper's other aligners is; over 1: best.

    As estimated. The paper's claim is about its own four (algorithm 1 in both readings).
    """
    errors = _rich(tables["errors"])
    medians = errors.groupby("aligner")["translation_error_m"].median()
    others = medians[[name for name in medians.index if name in PAPER_ALIGNERS and name != aligner]]
    return float(others.min() / medians[aligner]) if len(others) and aligner in medians else np.nan


def scatter_m(tables: Tables, aligner: str) -> float:
    """10-90 % range of the translation error as estimated, median over seeds, pairs, iterations.

    Over the repetitions on the same maps: what the method's own randomness does.
    """
    rich = _of(_rich(tables["errors"]), aligner)
    groups = rich.groupby([*_PAIR, "iteration"])["translation_error_m"]
    return float((groups.quantile(0.9) - groups.quantile(0.1)).median())


def is_false_merge(rows: pd.DataFrame) -> pd.Series:
    """Bool per row of `errors`: accepted without common ground, or more than 0.5 m or 0.1 rad off.

    An alignment of maps without one common landmark has nothing to be right about.
    """
    off = (rows["refined_translation_error_m"] > FALSE_MERGE_M) | (
        rows["refined_rotation_error_rad"].abs() > FALSE_MERGE_RAD
    )
    return rows["accepted"] & (off | (rows["n_common"] == 0))


def false_merges(tables: Tables, aligner: str) -> float:
    """Share of false merges among all of an aligner's answers (pairs, iterations, repetitions)."""
    return float(is_false_merge(_of(tables["errors"], aligner)).mean())


def missed_merges(tables: Tables, aligner: str) -> float:
    """Share refused of an aligner's answers where there are 20 or more true correspondences."""
    errors = _of(tables["errors"], aligner)
    return float((~errors[errors["n_true"] >= MERGEABLE_TRUE_PAIRS]["accepted"]).mean())


METRICS: dict[str, Callable[[Tables], float]] = {
    function.__name__: function
    for function in (
        path_rmse_m,
        odometry_rmse_m,
        path_over_odometry,
        oracle_translation_m,
        oracle_rotation_rad,
        true_pairs_at_end,
        fused_over_parents,
        fused_nees_with_drift,
        fused_nees_without_drift,
        landmark_rmse_median_m,
        landmark_rmse_worst_m,
        fused_landmark_rmse_m,
    )
}
ALIGNER_METRICS: dict[str, Callable[[Tables, str], float]] = {
    function.__name__: function
    for function in (
        refined_oracle_distance_m,
        refined_over_oracle,
        estimated_over_oracle,
        estimated_translation_m,
        lead_over_others,
        scatter_m,
        false_merges,
        missed_merges,
    )
}
USED_TABLES = ("robots", "errors", "fusion", "map_fits")


def known_metrics(aligners: list[str]) -> list[str]:
    """Every metric name a scenario with these aligners may use."""
    return [*METRICS, *(f"{aligner}.{name}" for aligner in aligners for name in ALIGNER_METRICS)]


def compute(name: str, tables: Tables) -> float:
    """The metric `name`, or `aligner.name` for those of one aligner."""
    if name in METRICS:
        return METRICS[name](tables)
    aligner, _, metric = name.rpartition(".")
    return ALIGNER_METRICS[metric](tables, aligner)
