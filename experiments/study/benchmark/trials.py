"""All methods on made-up maps: success, error over the oracle and time, by outliers and pairs.

One cell is one method at one number of pairs and one share of outliers. Cells run one after the
other in this process, warmed, so that times can be compared; each is kept under a key of all it
depends on, so an interrupted benchmark goes on where it was and a new method costs only its own.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from scipy.stats import binomtest

from experiments.methods.aligner_calls import callable_aligner
from experiments.methods.catalogue import find_method, known_methods
from experiments.methods.threads import single_threaded
from experiments.run.job import Job
from experiments.run.stage import Stage
from experiments.run.store import Store
from experiments.run.tasks import tasks_of
from experiments.scenario.loading import load_scenario
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AlignerEntry
from experiments.study.benchmark.synthetic_pairs import SyntheticPair, synthetic_pair, true_pairs_of
from mapfusion import se2
from mapfusion.align.registration import Registration
from mapfusion.align.result import NOT_RUN, Status
from mapfusion.errors import InputError
from mapfusion.se2 import Float
from mapfusion.storage import read_table, schema, write_table

OUTLIER_SHARES = (0.5, 0.8, 0.9, 0.95, 0.99)
PAIR_COUNTS = (60, 200, 1000, 5000)
# What counts as success. From within the gate of the common least squares (0.5 m) an estimate comes
# to the oracle's answer; 0.1 rad displaces landmarks 5 m away by as much.
TOLERANCE_M = 0.5
TOLERANCE_RAD = 0.1
_LABEL, _FILE = "measure the aligners", "trials.parquet"
_CONFIDENCE = 0.95  # of Wilson's interval
_TIME_BAND = (0.1, 0.9)  # quantiles of the trials


def _schema(kind: str, **types: pa.DataType) -> pa.Schema:
    return schema(f"benchmark.{kind}", 1, [pa.field(name, t) for name, t in types.items()])


_TEXT, _INT, _FLOAT = pa.string(), pa.int32(), pa.float64()
_CELL = {"method": _TEXT, "n_pairs": _INT, "outlier_share": _FLOAT}

# One row a trial. All but the time are the same at every run.
TRIALS = _schema(
    "trials",
    **_CELL,
    trial=_INT,
    status=_TEXT,
    reason=_TEXT,
    error_m=_FLOAT,  # of the translation, at the middle of the world
    error_rad=_FLOAT,
    refined_status=_TEXT,
    refined_error_m=_FLOAT,
    refined_error_rad=_FLOAT,
    oracle_error_m=_FLOAT,  # least squares on the true pairs
    oracle_error_rad=_FLOAT,
    elapsed_s=_FLOAT,
)

# One row a cell.
SUMMARY = _schema(
    "summary",
    **_CELL,
    n_true=_INT,
    n_trials=_INT,
    status=_TEXT,  # "absent" where the package is, else "ran"
    n_success=_INT,  # accepted, and within the tolerance as estimated
    success=_FLOAT,
    success_low=_FLOAT,  # Wilson's interval, 95 %
    success_high=_FLOAT,
    n_wrong=_INT,  # accepted, and outside the tolerance
    n_failed=_INT,  # raised, hung or answered nonsense
    error_m=_FLOAT,  # medians over the successes
    error_rad=_FLOAT,
    ratio_m=_FLOAT,  # of that median to the oracle's on the same maps
    ratio_rad=_FLOAT,
    refined_ratio_m=_FLOAT,  # the same after the common least squares
    refined_ratio_rad=_FLOAT,
    oracle_error_m=_FLOAT,  # medians over all trials
    oracle_error_rad=_FLOAT,
    elapsed_s=_FLOAT,  # median
    elapsed_low_s=_FLOAT,  # 10th and 90th percentile
    elapsed_high_s=_FLOAT,
)


@dataclass(frozen=True)
class Plan:
    """What is measured.

    Attributes:
        aligners: the methods.
        trials: of each cell, each on maps of its own, the same for all methods.
        seed: of maps and methods.
        budget_s: a cell that has taken longer ends with the trials it has.
        pair_counts: numbers of correspondences.
        outlier_shares: shares of false ones.
    """

    aligners: tuple[AlignerEntry, ...]
    trials: int = 100
    seed: int = 0
    budget_s: float = 600.0
    pair_counts: tuple[int, ...] = PAIR_COUNTS
    outlier_shares: tuple[float, ...] = OUTLIER_SHARES


def entries_of(methods: Sequence[str], scenario: Path | None = None) -> tuple[AlignerEntry, ...]:
    """The methods of these names, with their default parameters, or a scenario's aligners.

    With both, the scenario's aligners of these names; with neither, all known methods.

    Raises:
        InputError: a name or the scenario is unknown or unusable.
    """
    names = list(dict.fromkeys(methods))
    if scenario is not None:
        entries = {entry.name: entry for entry in load_scenario(scenario).align.aligners}
        for name in names:
            if name not in entries:
                raise InputError(f"{scenario}: align.aligners: none is named {name}")
        return tuple(entries[name] for name in names or entries)
    for name in names:
        try:
            find_method(name)
        except ValueError as error:
            raise InputError(f"--method: {error}") from error
    return tuple(AlignerEntry(name=name, method=name) for name in names or known_methods())


def run_benchmark(
    plan: Plan, store: Store, on_progress: Callable[[int, int], None]
) -> pd.DataFrame:
    """All trials of all cells, from the store where they are there; told (cells done, in all)."""
    single_threaded()
    cells = list(itertools.product(plan.aligners, plan.pair_counts, plan.outlier_shares))
    trials = []
    for done, (entry, n_pairs, share) in enumerate(cells):
        on_progress(done, len(cells))
        trials.append(_cell(plan, store, entry, n_pairs, share))
    on_progress(len(cells), len(cells))
    return pd.concat(trials, ignore_index=True)


def _cell(
    plan: Plan, store: Store, entry: AlignerEntry, n_pairs: int, share: float
) -> pd.DataFrame:
    method = find_method(entry.method)
    settings = CellSettings(
        **dict(entry),
        origin=method.origin(),
        n_pairs=n_pairs,
        outlier_share=share,
        trials=plan.trials,
        seed=plan.seed,
        budget_s=plan.budget_s,
    )
    loads = (method.target.partition(":")[0],)
    stage = Stage("benchmark", _LABEL, settings, run_cell, (_FILE,), loads=loads)
    for task in tasks_of([stage], store).values():
        task.run()
    return read_table(store.path(stage) / _FILE, TRIALS)[0].to_pandas()


@dataclass(frozen=True)
class CellSettings:
    """All that one method's trials in one cell depend on."""

    name: str
    method: str
    parameters: dict[str, Any]
    time_limit_s: float
    origin: dict[str, str]
    n_pairs: int
    outlier_share: float
    trials: int
    seed: int
    budget_s: float


def run_cell(settings: CellSettings, job: Job) -> None:
    """Run the trials of one cell and write them."""
    started = time.perf_counter()
    aligner = callable_aligner(settings.method, settings.parameters, settings.time_limit_s)
    registration = Registration(aligner, acceptance=None)  # methods are ranked by what they find
    rows: list[dict[str, Any]] = []
    n_pairs, share = settings.n_pairs, settings.outlier_share
    for trial in range(settings.trials):
        maps = ("benchmark", n_pairs, f"{share:g}", trial)
        pair = synthetic_pair(n_pairs, share, generator(settings.seed, *maps))
        draws = (*maps, settings.name)
        if trial == 0:  # compilation, imports and caches; not counted
            _trial(registration, pair, generator(settings.seed, *draws))
        cell = {"method": settings.name, "n_pairs": n_pairs, "outlier_share": share}
        answer = _trial(registration, pair, generator(settings.seed, *draws))
        rows.append(cell | {"trial": trial} | answer)
        if time.perf_counter() - started > settings.budget_s:
            break
    columns = pd.DataFrame(rows, columns=pd.Index(TRIALS.names))
    write_table(job.output / _FILE, {name: columns[name].to_numpy() for name in columns}, TRIALS)


def _trial(registration: Registration, pair: SyntheticPair, rng: np.random.Generator) -> dict:
    done = registration.register(pair.map_a, pair.map_b, pair.correspondences, rng)
    estimated, refined = done.estimated, done.refined
    row = {
        "status": str(estimated.status),
        "reason": estimated.reason,
        "refined_status": str(refined.status),
        "elapsed_s": estimated.elapsed_s,
    }
    oracle = pair.least_squares() if pair.is_true.sum() >= 2 else np.full(3, np.nan)
    for prefix, T in (("", estimated.T_a_b), ("refined_", refined.T_a_b), ("oracle_", oracle)):
        row[f"{prefix}error_m"], row[f"{prefix}error_rad"] = errors(T, pair.T_a_b)
    return row


def errors(T_estimated: Float, T_true: Float) -> tuple[float, float]:
    """Of the translation (m) and the rotation (rad), both 0 or more, NaN without an estimate."""
    difference = T_estimated - T_true
    return float(np.hypot(difference[0], difference[1])), abs(float(se2.wrap(difference[2])))


def summarise(trials: pd.DataFrame) -> pd.DataFrame:
    """One row a cell (see SUMMARY), in the order of the trials."""
    rows = []
    for _, group in trials.groupby(list(_CELL), sort=False):
        cell = {name: group[name].iloc[0] for name in _CELL}
        rows.append(cell | _summary(group, int(cell["n_pairs"]), float(cell["outlier_share"])))
    return pd.DataFrame(rows, columns=pd.Index(SUMMARY.names))


def _summary(group: pd.DataFrame, n_pairs: int, share: float) -> dict[str, Any]:
    n = len(group)
    absent = bool((group["status"] == Status.ABSENT).any())
    good = succeeded(group, "")
    wrong = (group["status"] == Status.ACCEPTED) & ~good
    row: dict[str, Any] = {
        "n_true": true_pairs_of(n_pairs, share),
        "n_trials": n,
        "status": str(Status.ABSENT) if absent else "ran",
        "n_success": int(good.sum()),
        "n_wrong": int(wrong.sum()),
        "n_failed": int((group["status"] == Status.FAILED).sum()),
    }
    if not absent:
        interval = binomtest(int(good.sum()), n).proportion_ci(_CONFIDENCE, "wilson")
        row |= {"success": good.mean(), "success_low": interval.low, "success_high": interval.high}
    for unit in ("m", "rad"):
        row[f"oracle_error_{unit}"] = group[f"oracle_error_{unit}"].median()
        row[f"error_{unit}"] = group[f"error_{unit}"][good].median()
        for prefix in ("", "refined_"):
            ours = group[succeeded(group, prefix)]
            ratio = ours[f"{prefix}error_{unit}"].median() / ours[f"oracle_error_{unit}"].median()
            row[f"{prefix}ratio_{unit}"] = ratio
    elapsed = group["elapsed_s"][~group["status"].isin(NOT_RUN)]
    row["elapsed_s"] = elapsed.median()
    row["elapsed_low_s"], row["elapsed_high_s"] = (elapsed.quantile(q) for q in _TIME_BAND)
    return row


def succeeded(trials: pd.DataFrame, prefix: str) -> pd.Series:
    """Which estimates (or, with the prefix "refined_", refined ones) are accepted and right."""
    return (
        (trials[f"{prefix}status"] == Status.ACCEPTED)
        & (trials[f"{prefix}error_m"] <= TOLERANCE_M)
        & (trials[f"{prefix}error_rad"] <= TOLERANCE_RAD)
    )
