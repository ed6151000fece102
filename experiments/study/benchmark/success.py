"""The benchmark in short: success, error over the oracle and time of each cell."""

import pandas as pd

from experiments.judge.criteria import is_right
from experiments.run.frames import FLOAT, INT, TEXT, fields
from experiments.study.benchmark.synthetic_pairs import true_pairs_of
from experiments.study.benchmark.trials import CELL
from experiments.study.statistics.wilson import wilson
from mapfusion.align.result import NOT_RUN, Status
from mapfusion.storage import schema

# One row a cell.
SUMMARY = schema(
    "benchmark.summary",
    1,
    fields(
        **CELL,
        n_true=INT,
        n_trials=INT,
        status=TEXT,  # "absent" where the package is, else "ran"
        n_success=INT,  # accepted, and right as estimated
        success=FLOAT,
        success_low=FLOAT,  # Wilson's interval, 95 %
        success_high=FLOAT,
        n_wrong=INT,  # accepted, and not right
        n_failed=INT,  # raised, hung or answered nonsense
        error_m=FLOAT,  # medians over the successes
        error_rad=FLOAT,
        ratio_m=FLOAT,  # of that median to the oracle's on the same maps
        ratio_rad=FLOAT,
        refined_ratio_m=FLOAT,  # the same after the common least squares
        refined_ratio_rad=FLOAT,
        oracle_error_m=FLOAT,  # medians over all trials
        oracle_error_rad=FLOAT,
        elapsed_s=FLOAT,  # median
        elapsed_low_s=FLOAT,  # 10th and 90th percentile
        elapsed_high_s=FLOAT,
    ),
)


def summarise(trials: pd.DataFrame) -> pd.DataFrame:
    """One row a cell (see SUMMARY), in the order of the trials."""
    keys = [trials[name] for name in CELL]

    def by_cell(column: pd.Series) -> "pd.api.typing.SeriesGroupBy":
        return column.groupby(keys, sort=False)

    status = trials["status"]
    good = {prefix: _succeeded(trials, prefix) for prefix in ("", "refined_")}
    wrong = (status == Status.ACCEPTED) & ~good[""]
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
        "n_wrong": by_cell(wrong).sum(),
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


def _succeeded(trials: pd.DataFrame, prefix: str) -> pd.Series:
    """Which estimates (or, with the prefix "refined_", refined ones) are accepted and right."""
    right = is_right(trials[f"{prefix}error_m"], trials[f"{prefix}error_rad"])
    return (trials[f"{prefix}status"] == Status.ACCEPTED) & right
