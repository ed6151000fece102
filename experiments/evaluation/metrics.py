"""Metrics that scenarios bound in `expect`, and checks of these bounds.

A metric is a function of the tables of one or more runs, concatenated, with a column `seed`. It
returns one number; NaN if the tables have no row for it. Errors are summarised over repetitions on
the same maps first, and then as medians over seeds, robot pairs and iterations, because single
ratios exceed a bound by chance.

A new metric needs its name in `experiments/scenario/settings.py` and a function here with
`@metric()`. A function with a second argument `aligner` defines a metric of each aligner. A
function with `@metric(NAME=WHICH, ...)` defines several metrics.
"""

import inspect
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import alignment_criteria, tables
from experiments.evaluation.adoption import false_adoptions
from experiments.evaluation.alignment_criteria import (
    ORACLE,
    NothingMerged,
    edge_precision,
    edge_recall,
    error_over_oracle,
    merged_robots,
    nothing_merged,
    path_rms,
    repetition_spread_m,
    rich,
    rms,
    summarise_alignments,
)
from experiments.evaluation.loop_closures import loop_closures
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import FUSER_METRICS, SMOOTHED_METRICS, AnyScenario, Bound
from experiments.scenario.suite import scenarios_of, with_aligners
from mapfusion.errors import InputError

# The four methods of the paper, algorithm 1 in both readings, as the default list names them.
PAPER_ALIGNERS = ("ransac", "svd", "svd-solved", "icp", "impicp")
USED_TABLES = ("robots", "errors", "fusion", "map_fits", "fused_motions", "team", "team_pairs")
USED_TABLES += ("smoother", "fusers", "sightings", "smoothed_errors", "adoptions", "team_members")
MERGED_ROBOTS = "team.merged_robots"
WITHOUT_TRUTH = (MERGED_ROBOTS,)  # metrics that need no truth

Tables = Mapping[str, pd.DataFrame]
Metric = Callable[..., float]
METRICS: dict[str, Metric] = {}
ALIGNER_METRICS: dict[str, Metric] = {}  # metrics ALIGNER.NAME of each aligner
_PAIR = ["seed", "robot_a", "robot_b"]


def metric(**variants: str) -> Callable[[Metric], Metric]:
    """Register a metric under the name of its function, or several variants of it.

    Args:
        variants: value of the function's argument `variant`, by the name of the metric.
    """

    def register(function: Metric) -> Metric:
        is_aligner_metric = "aligner" in inspect.signature(function).parameters
        registry = ALIGNER_METRICS if is_aligner_metric else METRICS
        functions = {name: partial(function, variant=value) for name, value in variants.items()}
        registry.update(functions or {function.__name__: function})
        return function

    return register


def _of(errors: pd.DataFrame, aligner: str) -> pd.DataFrame:
    return errors[errors["aligner"] == aligner]


@metric(path_rmse_m="path_m", odometry_rmse_m="odometry_m")
def _path_rmse_m(tables: Tables, variant: str) -> float:
    """Return the RMS error of online paths or odometry, median over robots and seeds."""
    return path_rms(tables["robots"], ("seed", "robot"))[variant].median()


@metric()
def path_over_odometry(tables: Tables) -> float:
    """Return the path RMSE of FastSLAM over that of odometry (ratio of the medians)."""
    return METRICS["path_rmse_m"](tables) / METRICS["odometry_rmse_m"](tables)


@metric()
def effective_sample_size(tables: Tables) -> float:
    """Return the effective sample size of the filter, median over frames, robots and seeds."""
    return tables["robots"]["effective_sample_size"].median()


@metric()
def spread_after_closure(tables: Tables) -> float:
    """Return the spread of the particles after a loop closure over that before it.

    Of each seed, the closure with the largest fall counts, as in figure 3; the value is the largest
    over seeds.
    """
    falls = []
    for seed, sightings in tables["sightings"].groupby("seed"):
        robots = tables["robots"]
        closures = loop_closures(sightings, robots[robots["seed"] == seed])
        ratios = [each.after_m / each.before_m for each in closures if each.before_m > 0]
        falls += [min(ratios)] if ratios else []
    return max(falls, default=np.nan)


_SMOOTHER = ("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share")
_SMOOTHER += ("nees_per_dof", "coverage_95")


@metric(**{f"smoother.{name}": name for name in _SMOOTHER})
def _smoother_column(tables: Tables, variant: str) -> float:
    """Return a column of the table `smoother`, median over robots and seeds."""
    return tables["smoother"][variant].median()


@metric(
    oracle_translation_m="refined_translation_error_m",
    oracle_rotation_rad="refined_rotation_error_rad",
    true_pairs_at_end="n_true",
)
def _oracle_at_the_end(tables: Tables, variant: str) -> float:
    """Return an error or the true pairs of the oracle at the end, median over seeds and pairs."""
    rows = alignment_criteria.at_last_iteration(_of(tables["errors"], ORACLE))
    return alignment_criteria.absolute_errors(rows, [variant])[variant].median()


def _truly_fused(tables: Tables) -> pd.DataFrame:
    """Return the landmarks that were fused from the same true point."""
    return tables["fusion"][tables["fusion"]["true_pair"]]


@metric()
def fused_over_parents(tables: Tables) -> float:
    """Return the RMS error of fused landmarks over the mean RMS error of their parents.

    The result is the median over seeds and robot pairs.
    """
    a, b, fused = (
        _truly_fused(tables).groupby(_PAIR)[f"error_{name}_m"].agg(rms)
        for name in ("a", "b", "fused")
    )
    return (fused / ((a + b) / 2)).median()


@metric(fused_nees_with_drift="nees_with_drift", fused_nees_without_drift="nees_without_drift")
def _nees_per_dof(tables: Tables, variant: str) -> float:
    """Return the mean NEES per degree of freedom of fused landmarks; 1 is consistent."""
    rows = _truly_fused(tables)
    return (rows[variant] / rows["degrees_of_freedom"]).mean()


@metric(landmark_rmse_median_m="median", landmark_rmse_worst_m="max")
def _landmark_rmse_m(tables: Tables, variant: str) -> float:
    """Return the landmark RMSE after a rigid fit: median or maximum over robots, then seeds."""
    fits = tables["map_fits"]
    return fits[fits["map"] != "fused"].groupby("seed")["rmse_m"].agg(variant).agg(variant)


@metric()
def fused_landmark_rmse_m(tables: Tables) -> float:
    """Return the landmark RMSE of the fused map after a rigid fit, median over seeds."""
    return tables["map_fits"].query("map == 'fused'")["rmse_m"].median()


@metric(**{MERGED_ROBOTS: "tx_m"})
def _merged_robots(tables: Tables, variant: str) -> float:
    """Return the number of robots whose maps were merged, median over seeds."""
    return tables["fused_motions"].groupby("seed")[variant].agg(merged_robots).median()


def _adopting(tables: Tables) -> pd.DataFrame:
    """Return the last row of `team_members` of each robot that adopted a map."""
    rows = tables["team_members"].sort_values("iteration").groupby(["seed", "robot"]).tail(1)
    adopted = tables["adoptions"].query("event == 'adopted'")[["seed", "robot"]].drop_duplicates()
    return rows.merge(adopted, on=["seed", "robot"])


@metric(**{"adoption.robots": "number", "adoption.first_iteration": "first"})
def _adoptions(tables: Tables, variant: str) -> float:
    """Return the number of adopting robots or the first iteration of it, median over seeds."""
    if tables["team_members"].empty:
        return np.nan
    adopted = tables["adoptions"].query("event == 'adopted'")
    if variant == "number":
        n_robots = adopted.groupby("seed")["robot"].nunique()
        return n_robots.reindex(tables["team_members"]["seed"].unique(), fill_value=0).median()
    return adopted.groupby("seed")["iteration"].min().median()


@metric(**{"adoption.false_adoptions": "all"})
def _false_adoptions(tables: Tables, variant: str) -> float:
    """Return the number of wrong maps that robots adopted and did not drop, over all seeds."""
    if tables["team_members"].empty:
        return np.nan
    runs = tables["adoptions"].groupby("seed")
    return float(sum(false_adoptions(rows) for _, rows in runs))


@metric(**{"adoption.path_over_alone": "median", "adoption.path_over_alone_worst": "max"})
def _path_over_alone(tables: Tables, variant: str) -> float:
    """Return the path error since the merge over the independent robot's.

    It is the median or the max over robots and seeds.
    """
    rows = _adopting(tables)
    return (rows["merged_path_rmse_m"] / rows["alone_merged_path_rmse_m"]).agg(variant)


_ADOPTED = ("landmark_rmse_m", "frame_nees_per_dof", "frame_coverage_95", "shared_share", "sent_kb")


@metric(**{f"adoption.{name.removeprefix('frame_')}": name for name in _ADOPTED})
def _adopted_column(tables: Tables, variant: str) -> float:
    """Return a column of the last rows of `team_members`, median over adopting robots and seeds."""
    return _adopting(tables)[variant].median()


@metric(**{"team.ate_rmse_m": "rmse"})
def _team_ate_m(tables: Tables, variant: str) -> float:
    """Return the ATE (RMSE) of the final paths of all merged robots, median over seeds."""
    return tables["team"].query("component == 1 and source == 'final'")[variant].median()


@metric(
    **{
        "team.translation_m": "team_translation_error_m",
        "team.rotation_rad": "team_rotation_error_rad",
    }
)
def _team_pair_error(tables: Tables, variant: str) -> float:
    """Return the error of T_a_b in the fused map, median over seeds and merged pairs."""
    return tables["team_pairs"][variant].abs().median()


@metric(**{"team.edge_precision": "precision", "team.edge_recall": "recall"})
def _team_edges(tables: Tables, variant: str) -> float:
    """Return precision or recall of the alignments that the team uses, over all seeds."""
    measure = {"precision": edge_precision, "recall": edge_recall}[variant]
    return measure(tables["team_pairs"])


@metric()
def refined_oracle_distance_m(tables: Tables, aligner: str) -> float:
    """Return the distance of refined translations from the oracle's, median over rich pairs."""
    rows = rich(_of(tables["errors"], aligner))
    return alignment_criteria.absolute_errors(rows, ["oracle_distance_m"])[
        "oracle_distance_m"
    ].median()


@metric(
    refined_over_oracle="refined_translation_error_m", estimated_over_oracle="translation_error_m"
)
def _over_oracle(tables: Tables, aligner: str, variant: str) -> float:
    """Return the median translation error over the oracle's, for rich pairs."""
    errors = rich(tables["errors"])
    maps = summarise_alignments(errors[errors["aligner"].isin([aligner, ORACLE])])
    return error_over_oracle(maps, variant).get(aligner, np.nan)


@metric()
def estimated_translation_m(tables: Tables, aligner: str) -> float:
    """Return the median translation error before refinement, for answerable pairs."""
    maps = summarise_alignments(alignment_criteria.answerable(_of(tables["errors"], aligner)))
    return maps["translation_error_m"].median()


@metric()
def largest_translation_m(tables: Tables, aligner: str) -> float:
    """Return the largest translation error before refinement, for mergeable pairs."""
    rows = alignment_criteria.mergeable(_of(tables["errors"], aligner))
    return alignment_criteria.absolute_errors(rows, ["translation_error_m"])[
        "translation_error_m"
    ].max()


@metric(motion_nees_per_dof="nees_per_dof", motion_coverage_90="inside")
def _alignment_consistency(tables: Tables, aligner: str, variant: str) -> float:
    """Return the consistency of T_a_b: the median NEES per degree of freedom, or the coverage."""
    values = alignment_criteria.alignment_consistency(_of(tables["errors"], aligner))[variant]
    return values.median() if variant == "nees_per_dof" else values.mean()


@metric()
def lead_over_others(tables: Tables, aligner: str) -> float:
    """Return the smallest median error of the paper's other aligners over that of this aligner.

    Values above 1: the aligner is the best. Errors are before refinement. Only the aligners of the
    paper are compared, algorithm 1 in both readings.
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
    """Return `repetition_spread_m` of an aligner for rich pairs."""
    return repetition_spread_m(rich(_of(tables["errors"], aligner)))


@metric(false_merges="")
def _all_false_merges(tables: Tables, variant: str) -> float:
    """Return the share of false merges among all alignments of all aligners.

    Alignments of the filter's maps and of the smoothed maps count.
    """
    errors = pd.concat([tables["errors"], tables["smoothed_errors"]], ignore_index=True)
    return alignment_criteria.is_false_merge(errors[errors["aligner"] != ORACLE]).mean()


@metric()
def false_merges(tables: Tables, aligner: str) -> float:
    """Return the share of false merges among all alignments of an aligner."""
    return alignment_criteria.is_false_merge(_of(tables["errors"], aligner)).mean()


@metric()
def missed_merges(tables: Tables, aligner: str) -> float:
    """Return the share of refused alignments of an aligner among mergeable pairs."""
    return (~alignment_criteria.mergeable(_of(tables["errors"], aligner))["accepted"]).mean()


def on_smoothed(tables: Tables, aligner: str, aligner_metric: Metric) -> float:
    """Return a metric of an aligner's alignments of smoothed maps."""
    return aligner_metric({**tables, "errors": tables["smoothed_errors"]}, aligner)


ALIGNER_METRICS |= {
    f"smoothed_{name}": partial(on_smoothed, aligner_metric=ALIGNER_METRICS[name])
    for name in SMOOTHED_METRICS
}


def compute(name: str, tables: Tables) -> float:
    """Compute the metric `name`, or `METHOD.NAME` of an aligner or fuser."""
    if name in METRICS:
        return float(METRICS[name](tables))
    method, _, of_method = name.rpartition(".")
    if of_method in FUSER_METRICS:  # a column of `fusers` at the last iteration
        rows = tables["fusers"]
        rows = rows[rows["fuser"] == method].sort_values("iteration", kind="stable")
        return float(rows.groupby("seed")[of_method].last().median())
    return float(ALIGNER_METRICS[of_method](tables, method))


def load_checked(
    path: Path,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    content: dict[str, Any] | None = None,
) -> AnyScenario:
    """Load a scenario whose expected metrics can be computed; arguments as of `load_scenario`.

    Raises:
        InputError: the scenario is wrong, or an expected metric needs a truth that is unknown.
    """
    scenario = load_scenario(path, overrides, seed, content)
    needing_truth = [name for name in scenario.expect if name not in WITHOUT_TRUTH]
    if needing_truth and (reason := scenario.why_no_truth()):
        name = needing_truth[0]
        raise InputError(f"{path}: expect.{name}: {reason}; leave `expect` out, or add the file")
    return scenario


@dataclass(frozen=True)
class Outcome:
    """Value of an expected metric.

    Attributes:
        scenario: name of the scenario.
        metric: name of the metric.
        value: value over all seeds.
        bound: range of the expectation.
        per_seed: values by seed.
    """

    scenario: str
    metric: str
    value: float
    bound: Bound
    per_seed: Mapping[int, float]

    @property
    def passed(self) -> bool:
        """True if the value is finite and within the bound."""
        low = -math.inf if self.bound.min is None else self.bound.min
        high = math.inf if self.bound.max is None else self.bound.max
        return math.isfinite(self.value) and low <= self.value <= high

    @property
    def bound_text(self) -> str:
        """Bound as an inequality of x."""
        low = "" if self.bound.min is None else f"{self.bound.min:g} <= "
        high = "" if self.bound.max is None else f" <= {self.bound.max:g}"
        return f"{low}x{high}"


def check(scenario: AnyScenario, results: Mapping[int, Path]) -> list[Outcome]:
    """Compute the expected metrics of a scenario from its result folders by seed."""
    by_seed: dict[int, dict[str, pd.DataFrame]] = {seed: {} for seed in results}
    for seed, result in results.items():
        for name in USED_TABLES:
            rows = tables.read(tables.table_path(result, name), name)
            by_seed[seed][name] = rows.assign(seed=seed)
    parts = {
        name: [tables_of_seed[name] for tables_of_seed in by_seed.values()] for name in USED_TABLES
    }
    pooled = {name: pd.concat(each, ignore_index=True) for name, each in parts.items()}
    outcomes = []
    for name, bound in scenario.expect.items():
        per_seed = {seed: compute(name, tables_of_seed) for seed, tables_of_seed in by_seed.items()}
        value = compute(name, pooled)
        outcomes.append(Outcome(scenario.name, name, value, bound, per_seed))
    return outcomes


@dataclass(frozen=True)
class CheckedScenario:
    """Outcomes of a scenario, or an error.

    A scenario without outcomes, error and times was not run, because another one cannot be read.

    Attributes:
        scenario: name of the scenario.
        outcomes: values of the expected metrics.
        error: message if the scenario cannot be read or run; the error belongs to the last seed.
        elapsed_s: wall-clock time by seed, of all runs that were started.
        unmerged: seeds whose maps should have been merged but were not.
    """

    scenario: str
    outcomes: Sequence[Outcome] = ()
    error: str = ""
    elapsed_s: Mapping[int, float] = field(default_factory=dict)
    unmerged: Mapping[int, NothingMerged] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """True if all runs finished, all bounds hold and maps were merged where possible."""
        ran = bool(self.elapsed_s) and not self.error
        return ran and not self.unmerged and all(outcome.passed for outcome in self.outcomes)


def check_all(
    words: Sequence[str],
    seeds: Sequence[int],
    overrides: Sequence[str],
    run: Callable[[AnyScenario], Path],
    aligners: Sequence[str] = (),
) -> Iterator[CheckedScenario]:
    """Run and check scenarios.

    No scenario runs if one of them cannot be read. A failed run ends its own scenario. Errors
    other than `InputError` are raised again after the result of the scenario was yielded.

    Args:
        words: files, names or tags of scenarios.
        seeds: seeds of the runs of each scenario.
        overrides: entries `key.sub=value` that replace values of the scenarios.
        run: runs a scenario and returns its result folder.
        aligners: names for `with_aligners`; none keeps the aligners of each scenario.
    """
    loaded: list[CheckedScenario | list[AnyScenario]] = []
    for word in words:
        try:
            paths = scenarios_of([word])
        except InputError as error:
            loaded.append(CheckedScenario(word, error=str(error)))
            continue
        for path in paths:
            try:
                own = with_aligners(path, overrides, aligners)
                loaded.append([load_checked(path, own, seed) for seed in seeds])
            except InputError as error:
                loaded.append(CheckedScenario(path.stem, error=str(error)))
    unreadable = any(isinstance(each, CheckedScenario) for each in loaded)
    for each in loaded:
        if isinstance(each, CheckedScenario):
            yield each
            continue
        name, folders, elapsed_s = each[0].name, dict[int, Path](), dict[int, float]()
        if unreadable:
            yield CheckedScenario(name)
            continue
        try:
            for scenario in each:
                started_s = time.perf_counter()
                try:
                    folders[scenario.seed] = run(scenario)
                finally:
                    elapsed_s[scenario.seed] = time.perf_counter() - started_s
            outcomes = check(each[0], folders)
            # a scenario may bound the number of merged robots itself
            tested = {} if MERGED_ROBOTS in each[0].expect else folders
            merges = {seed: nothing_merged(folder) for seed, folder in tested.items()}
            unmerged = {seed: merge for seed, merge in merges.items() if merge and merge.failed}
        except InputError as error:
            yield CheckedScenario(name, error=str(error), elapsed_s=elapsed_s)
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            yield CheckedScenario(name, error=text, elapsed_s=elapsed_s)
            raise
        else:
            yield CheckedScenario(name, outcomes, elapsed_s=elapsed_s, unmerged=unmerged)
