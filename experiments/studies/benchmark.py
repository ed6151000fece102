"""Benchmark of aligners on synthetic pairs of maps: success, error and time.

A cell is one method, one number of pairs and one share of outliers. Cells run one after the other
in this process after a first call, so times can be compared. Each cell is kept under a key of
everything it depends on: an interrupted benchmark continues, and a new method adds only its cells.
"""

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_criteria import is_right
from experiments.pipeline.stage import Job, Stage
from experiments.pipeline.store import Store
from experiments.pipeline.tables import FLOAT, INT, TEXT, fields, read_rows, write_rows
from experiments.pipeline.tasks import OnProgress, run_tasks, tasks_of
from experiments.pipeline.workers import single_threaded, workers
from experiments.plugins.discovery import callable_aligner, find_method, known_methods
from experiments.scenario.settings import AlignerEntry
from experiments.scenario.suite import chosen_aligners, settings_of
from experiments.studies.intervals import log_ratio, wilson
from mapfusion.align.alignment import NOT_RUN, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.files import schema
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float, generator
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.registration import Registration

# Constants, so that tables of different versions can be compared.
SIZE_M = 20.0  # side of the square that contains the landmarks
SIGMA_M = 0.05  # standard deviation of a true pair's residual, per axis
_OBSERVATIONS = 5  # count of each landmark; no aligner uses it


@dataclass(frozen=True)
class SyntheticPair:
    """Two planar maps and N correspondences between them, in random order.

    Attributes:
        T_a_b: (3,) true motion.
        is_true: (N,) bool, True for correspondences of one point of the world.
    """

    map_a: LandmarkMap
    map_b: LandmarkMap
    correspondences: Correspondences
    T_a_b: Float
    is_true: np.ndarray

    def least_squares(self) -> Float:
        """Return T_a_b (3,) of least squares on the true pairs; all have equal noise."""
        c = self.correspondences
        p_a, p_b = self.map_a.position_m[c.index_a], self.map_b.position_m[c.index_b]
        return np.array(fit_rigid(p_a, p_b, np.flatnonzero(self.is_true)))


def true_pairs_of(n_pairs: int, outlier_share: float) -> int:
    """Return the number of true pairs among n."""
    return round((1 - outlier_share) * n_pairs)


def synthetic_pair(
    n_pairs: int, outlier_share: float, rng: np.random.Generator, unpaired_share: float = 0.0
) -> SyntheticPair:
    """Draw a world, two maps of it, the motion between them and the correspondences.

    Landmarks are uniform in a square about the origin of frame b. So the translation error is the
    displacement of the centre of the world. Both landmarks of a false pair are uniform and
    independent. Each map has half of the residual's variance, and its covariances say so.

    Args:
        n_pairs: number of correspondences.
        outlier_share: share of these that are false.
        rng: random generator.
        unpaired_share: share of each map's landmarks without a correspondence; they are uniform
            and independent, too.
    """
    half_m = SIZE_M / 2
    T_a_b = np.array([*rng.uniform(-half_m, half_m, 2), rng.uniform(-math.pi, math.pi)])
    p_b = rng.uniform(-half_m, half_m, (n_pairs, 2))
    p_a = p_b.copy()
    is_true = np.arange(n_pairs) < true_pairs_of(n_pairs, outlier_share)
    p_a[~is_true] = rng.uniform(-half_m, half_m, (np.count_nonzero(~is_true), 2))
    own_m = SIGMA_M / math.sqrt(2)
    p_a = se2.transform_points(T_a_b, p_a) + rng.normal(0, own_m, p_a.shape)
    p_b = p_b + rng.normal(0, own_m, p_b.shape)
    index_a, index_b, order = (rng.permutation(n_pairs) for _ in range(3))
    distance = rng.uniform(0, 0.3, n_pairs)  # of accepted matches; they carry no information
    n_alone = round(n_pairs * unpaired_share / (1 - unpaired_share))
    alone_a, alone_b = rng.uniform(-half_m, half_m, (2, n_alone, 2))
    last = np.arange(n_pairs, n_pairs + n_alone)
    p_a, p_b = np.vstack([p_a, se2.transform_points(T_a_b, alone_a)]), np.vstack([p_b, alone_b])
    map_a = _map(p_a, np.concatenate([index_a, last]), own_m, "a")
    map_b = _map(p_b, np.concatenate([index_b, last]), own_m, "b")
    pairs = Correspondences(index_a[order], index_b[order], distance)
    return SyntheticPair(map_a, map_b, pairs, T_a_b, is_true[order])


def _map(points_m: Float, rows: np.ndarray, sigma_m: float, name: str) -> LandmarkMap:
    """Return the map whose landmark `rows[i]` is point i of (N, 2)."""
    n = len(points_m)
    position = np.zeros((n, 3))
    position[rows, :2] = points_m
    return LandmarkMap(
        position,
        np.tile(np.diag([sigma_m**2, sigma_m**2, 0.0]), (n, 1, 1)),
        np.full(n, _OBSERVATIONS, np.int32),
        np.arange(n, dtype=np.int64),
        planar=True,
        name=name,
    )


TRIALS_FILE = "trials.parquet"
CELL = {"method": TEXT, "n_pairs": INT, "outlier_share": FLOAT}

# One row per trial. All columns except the time are the same in every run.
TRIALS = schema(
    "benchmark.trials",
    1,
    fields(
        **CELL,
        trial=INT,
        status=TEXT,
        reason=TEXT,
        error_m=FLOAT,  # of the translation, at the centre of the world
        error_rad=FLOAT,
        refined_status=TEXT,
        refined_error_m=FLOAT,
        refined_error_rad=FLOAT,
        oracle_error_m=FLOAT,  # least squares on the true pairs
        oracle_error_rad=FLOAT,
        elapsed_s=FLOAT,
    ),
)


@dataclass(frozen=True)
class CellSettings:
    """Settings of one cell: an aligner as in scenarios, and the cell."""

    name: str
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]
    n_pairs: int
    outlier_share: float
    unpaired_share: float
    trials: int
    seed: int
    budget_s: float


def run_cell(settings: CellSettings, job: Job) -> None:
    """Run the trials of one cell and write them."""
    single_threaded()
    started = time.perf_counter()
    n_pairs, share = settings.n_pairs, settings.outlier_share
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    registration = Registration(
        aligner, verifier=None
    )  # no verdict: methods are ranked by their estimates
    cell = {"method": settings.name, "n_pairs": n_pairs, "outlier_share": share}
    rows: list[dict[str, Any]] = []
    for trial in range(settings.trials):
        maps = ("benchmark", n_pairs, f"{share:g}", trial)
        drawn = generator(settings.seed, *maps)
        pair = synthetic_pair(n_pairs, share, drawn, settings.unpaired_share)
        for _ in range(2 if trial == 0 else 1):  # the first call compiles and fills caches
            rng = generator(settings.seed, *maps, settings.name)
            answers = registration.register(pair.map_a, pair.map_b, pair.correspondences, rng)
        estimated, refined, _ = answers
        row = {
            "status": str(estimated.status),
            "reason": estimated.reason,
            "refined_status": str(refined.status),
            "elapsed_s": estimated.elapsed_s,
        }
        oracle = pair.least_squares() if pair.is_true.sum() >= 2 else np.full(3, np.nan)
        for prefix, T in (("", estimated.T_a_b), ("refined_", refined.T_a_b), ("oracle_", oracle)):
            x, y, theta = T - pair.T_a_b
            row[f"{prefix}error_m"] = float(np.hypot(x, y))
            row[f"{prefix}error_rad"] = abs(float(se2.wrap(theta)))
        rows.append(cell | {"trial": trial} | row)
        if time.perf_counter() - started > settings.budget_s:
            break
    write_rows(job.output / TRIALS_FILE, TRIALS, rows)


OUTLIER_SHARES = (0.5, 0.8, 0.9, 0.95, 0.99)
PAIR_COUNTS = (60, 200, 1000, 5000)

# One row per cell. n_success: accepted estimates that are right; success: with Wilson's interval;
# n_wrong: accepted estimates that are wrong; n_failed: exceptions, timeouts and invalid answers.
# Errors: medians over successes; ratios: to the oracle's errors on the same maps, as estimated and
# after the common least squares; oracle_error: medians over all trials; elapsed: median, 10th and
# 90th percentile.
SUMMARY = schema(
    "benchmark.summary",
    1,
    fields(
        **CELL,
        n_true=INT,
        n_trials=INT,
        status=TEXT,  # "absent" if the package is not installed, else "ran"
        n_success=INT,
        **dict.fromkeys(("success", "success_low", "success_high"), FLOAT),
        n_wrong=INT,
        n_failed=INT,
        **dict.fromkeys(("error_m", "error_rad", "ratio_m", "ratio_rad"), FLOAT),
        **dict.fromkeys(("refined_ratio_m", "refined_ratio_rad"), FLOAT),
        **dict.fromkeys(("oracle_error_m", "oracle_error_rad"), FLOAT),
        **dict.fromkeys(("elapsed_s", "elapsed_low_s", "elapsed_high_s"), FLOAT),
    ),
)


@dataclass(frozen=True)
class BenchmarkDesign:
    """Design of a benchmark.

    Attributes:
        aligners: methods; all get the same maps.
        trials: number of trials per cell, each on its own maps.
        seed: seed of maps and methods.
        budget_s: time after which a cell ends with the trials it has.
        pair_counts: numbers of pairs.
        outlier_shares: shares of false pairs.
        unpaired_share: share of each map's landmarks without a correspondence, below 1.
    """

    aligners: tuple[AlignerEntry, ...]
    trials: int = 100
    seed: int = 0
    budget_s: float = 600.0
    pair_counts: tuple[int, ...] = PAIR_COUNTS
    outlier_shares: tuple[float, ...] = OUTLIER_SHARES
    unpaired_share: float = 0.0


def entries_of(
    methods: Sequence[str], scenario: str | Path | None = None
) -> tuple[AlignerEntry, ...]:
    """Return aligners by name, as `chosen_aligners` does.

    Without names, return all aligners of the scenario, or without a scenario all known methods.

    Raises:
        InputError: a name or the scenario is unknown or unusable.
    """
    if scenario is None:
        return chosen_aligners(list(methods) or list(known_methods()))
    entries = settings_of(scenario).align.aligners
    return chosen_aligners(methods, entries) if methods else tuple(entries)


def run_benchmark(design: BenchmarkDesign, store: Store, on_progress: OnProgress) -> pd.DataFrame:
    """Return all trials of all cells (TRIALS); finished cells come from the store."""
    stages = list[Stage]()
    cells = itertools.product(design.aligners, design.pair_counts, design.outlier_shares)
    for entry, n_pairs, share in cells:
        method = find_method(entry.method)
        settings = CellSettings(
            **dict(entry),
            origin=method.origin(),
            n_pairs=n_pairs,
            outlier_share=share,
            unpaired_share=design.unpaired_share,
            trials=design.trials,
            seed=design.seed,
            budget_s=design.budget_s,
        )
        label, loads = "measure the aligners", (method.own_module,)
        stages.append(Stage("benchmark", label, settings, run_cell, (TRIALS_FILE,), loads=loads))
    with workers(1) as this_process:
        run_tasks(list(tasks_of(stages, store).values()), this_process, on_progress)
    trials = [read_rows(store.path(stage) / TRIALS_FILE, TRIALS) for stage in stages]
    return pd.concat(trials, ignore_index=True)


def summarise(trials: pd.DataFrame) -> pd.DataFrame:
    """Return one row per cell (see SUMMARY), in the order of the trials."""
    keys = [trials[name] for name in CELL]

    def by_cell(column: pd.Series) -> "pd.api.typing.SeriesGroupBy":
        return column.groupby(keys, sort=False)

    status = trials["status"]
    good = {
        prefix: (trials[f"{prefix}status"] == Status.ACCEPTED)
        & is_right(trials[f"{prefix}error_m"], trials[f"{prefix}error_rad"])
        for prefix in ("", "refined_")
    }
    absent = by_cell(status == Status.ABSENT).any()
    n, n_success = by_cell(status).size(), by_cell(good[""]).sum()
    low, high = wilson(n_success, n)
    elapsed = by_cell(trials["elapsed_s"].mask(status.isin(NOT_RUN)))
    columns = {
        "n_trials": n,
        "status": absent.map({True: str(Status.ABSENT), False: "ran"}),
        "n_success": n_success,
        "success": (n_success / n).mask(absent),
        "success_low": pd.Series(low, n.index).mask(absent),
        "success_high": pd.Series(high, n.index).mask(absent),
        "n_wrong": by_cell((status == Status.ACCEPTED) & ~good[""]).sum(),
        "n_failed": by_cell(status == Status.FAILED).sum(),
        "elapsed_s": elapsed.median(),
        "elapsed_low_s": elapsed.quantile(0.1),
        "elapsed_high_s": elapsed.quantile(0.9),
    }
    for unit in ("m", "rad"):
        oracle = trials[f"oracle_error_{unit}"]
        columns[f"oracle_error_{unit}"] = by_cell(oracle).median()
        columns[f"error_{unit}"] = by_cell(trials[f"error_{unit}"].where(good[""])).median()
        for prefix, own in good.items():
            error = by_cell(trials[f"{prefix}error_{unit}"].where(own)).median()
            columns[f"{prefix}ratio_{unit}"] = error / by_cell(oracle.where(own)).median()
    cells = pd.DataFrame(columns).reset_index()
    cells["n_true"] = list(map(true_pairs_of, cells["n_pairs"], cells["outlier_share"]))
    return cells[SUMMARY.names]


def median_errors(trials: pd.DataFrame) -> pd.DataFrame:
    """Return the median translation error of all trials by share of false pairs and method.

    A trial without an accepted estimate has an infinite error. The successes alone, as in SUMMARY,
    would hide how often a method fails.
    """
    error = trials["error_m"].where(trials["status"] == Status.ACCEPTED, math.inf)
    given = trials.assign(error_m=error)
    return given.pivot_table("error_m", "outlier_share", "method", aggfunc="median")


def crossing_shares(errors: pd.DataFrame, first: str, second: str) -> list[float]:
    """Return the shares of false pairs at which the order of two methods' errors changes.

    Args:
        errors: value of `median_errors`.
        first: name of a method.
        second: name of the other method.

    Returns:
        Shares between two neighbouring rows, interpolated linearly in the logarithm of the ratio;
        the middle if an error is 0 or infinite.
    """
    share = errors.index.to_numpy(np.float64)
    change = log_ratio(errors[first].to_numpy(), errors[second].to_numpy())
    found = []
    for k in np.flatnonzero(change[:-1] * change[1:] < 0):
        left, right = change[k : k + 2]
        known = np.isfinite(left) and np.isfinite(right)
        along = left / (left - right) if known else 0.5
        found.append(float(share[k] + along * (share[k + 1] - share[k])))
    return found


# Shares of landmarks without a correspondence in the trials of `crossing_designs`: maps that the
# correspondences cover, and maps as those of the scenarios, where few landmarks have one.
UNPAIRED_SHARES = (0.0, 0.75)
_N_PAIRS = 200
_FALSE_SHARES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


def crossing_designs(aligners: Sequence[str], trials: int) -> list[BenchmarkDesign]:
    """Return benchmarks of aligners on maps with known shares of false pairs."""
    entries = entries_of(aligners)
    return [
        BenchmarkDesign(
            entries,
            trials,
            pair_counts=(_N_PAIRS,),
            outlier_shares=_FALSE_SHARES,
            unpaired_share=unpaired,
        )
        for unpaired in UNPAIRED_SHARES
    ]


# One row per share of unpaired landmarks, share of false pairs and aligner.
CROSSING = schema(
    "paper.crossing",
    1,
    fields(unpaired_share=FLOAT, outlier_share=FLOAT, method=TEXT, n_trials=INT, error_m=FLOAT),
)


def crossing_rows(trials: Mapping[float, pd.DataFrame]) -> pd.DataFrame:
    """Return the median errors of the trials of each share of unpaired landmarks (CROSSING)."""
    parts = []
    for unpaired, rows in trials.items():
        errors = median_errors(rows).reset_index()
        long = errors.melt("outlier_share", var_name="method", value_name="error_m")
        n = rows.groupby(["outlier_share", "method"]).size().rename("n_trials").reset_index()
        parts.append(long.merge(n, "left").assign(unpaired_share=unpaired))
    return pd.concat(parts, ignore_index=True)[CROSSING.names]


def crossings(rows: pd.DataFrame, first: str, second: str) -> dict[float, list[float]]:
    """Return `crossing_shares` by share of unpaired landmarks for rows of CROSSING."""
    found = {}
    for unpaired, own in rows.groupby("unpaired_share"):
        errors = own.pivot_table("error_m", "outlier_share", "method")
        found[float(str(unpaired))] = crossing_shares(errors, first, second)
    return found
