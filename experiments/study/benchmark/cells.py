"""All methods on made-up maps, cell by cell: one method, number of pairs and share of outliers.

Cells run one after the other in this process, warmed, so that times can be compared; each is kept
under a key of all it depends on, so an interrupted benchmark goes on where it was and a new method
costs only its own.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.judge.criteria import is_right
from experiments.methods.catalogue import find_method, known_methods
from experiments.run.frames import FLOAT, INT, TEXT, fields, read_rows
from experiments.run.stage import Stage
from experiments.run.store import Store
from experiments.run.tasks import OnProgress, run_tasks, tasks_of
from experiments.run.workers import workers
from experiments.scenario.settings import AlignerEntry
from experiments.scenario.suite import settings_of
from experiments.study.benchmark.synthetic_pairs import true_pairs_of
from experiments.study.benchmark.trials import CELL, TRIALS, TRIALS_FILE, CellSettings, run_cell
from experiments.study.statistics.intervals import wilson
from mapfusion.align.result import NOT_RUN, Status
from mapfusion.errors import InputError
from mapfusion.storage import schema

OUTLIER_SHARES = (0.5, 0.8, 0.9, 0.95, 0.99)
PAIR_COUNTS = (60, 200, 1000, 5000)

# One row a cell. n_success: accepted, and right as estimated, with Wilson's 95 % interval; n_wrong:
# accepted, and not right; n_failed: raised, hung or answered nonsense. Errors: medians over the
# successes; ratios: of those to the oracle's on the same maps, as estimated and after the common
# least squares; oracle_error: medians over all trials; elapsed: median, 10th and 90th percentile.
SUMMARY = schema(
    "benchmark.summary",
    1,
    fields(
        **CELL,
        n_true=INT,
        n_trials=INT,
        status=TEXT,  # "absent" where the package is, else "ran"
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
    """What is measured: methods, each on the same maps, in all cells of these counts and shares.

    Each of a cell's trials is on maps of its own; a cell that has taken longer than its budget ends
    with the trials it has. The seed is of maps and methods.
    """

    aligners: tuple[AlignerEntry, ...]
    trials: int = 100
    seed: int = 0
    budget_s: float = 600.0
    pair_counts: tuple[int, ...] = PAIR_COUNTS
    outlier_shares: tuple[float, ...] = OUTLIER_SHARES


def entries_of(
    methods: Sequence[str], scenario: str | Path | None = None
) -> tuple[AlignerEntry, ...]:
    """The methods of these names, with their default parameters, or a scenario's aligners.

    With both, the scenario's aligners of these names; with neither, all known methods.

    Raises:
        InputError: a name or the scenario is unknown or unusable.
    """
    names = list(dict.fromkeys(methods))
    if scenario is not None:
        entries = {entry.name: entry for entry in settings_of(scenario).align.aligners}
        for name in names:
            if name not in entries:
                raise InputError(f"{scenario}: align.aligners: none is named {name}")
        return tuple(entries[name] for name in names or entries)
    try:
        for name in names:
            find_method(name)
    except ValueError as error:
        raise InputError(f"--method: {error}") from error
    return tuple(AlignerEntry(name=name, method=name) for name in names or known_methods())


def run_benchmark(design: BenchmarkDesign, store: Store, on_progress: OnProgress) -> pd.DataFrame:
    """All trials of all cells (TRIALS), from the store where they are there."""
    cells = itertools.product(design.aligners, design.pair_counts, design.outlier_shares)
    stages = [_stage(design, *cell) for cell in cells]
    with workers(1) as this_process:
        run_tasks(list(tasks_of(stages, store).values()), this_process, on_progress)
    trials = [read_rows(store.path(stage) / TRIALS_FILE, TRIALS) for stage in stages]
    return pd.concat(trials, ignore_index=True)


def _stage(design: BenchmarkDesign, entry: AlignerEntry, n_pairs: int, share: float) -> Stage:
    method = find_method(entry.method)
    settings = CellSettings(
        **dict(entry),
        origin=method.origin(),
        n_pairs=n_pairs,
        outlier_share=share,
        trials=design.trials,
        seed=design.seed,
        budget_s=design.budget_s,
    )
    loads, label = (method.target.partition(":")[0],), "measure the aligners"
    return Stage("benchmark", label, settings, run_cell, (TRIALS_FILE,), loads=loads)


def summarise(trials: pd.DataFrame) -> pd.DataFrame:
    """One row a cell (see SUMMARY), in the order of the trials."""
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
