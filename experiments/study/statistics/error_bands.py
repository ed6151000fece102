"""Medians with the 10-90 % of the runs around them: the numbers of figures 4, 5 and 6."""

import numpy as np
import pandas as pd

from experiments.study.statistics.judged_maps import ERROR_COLUMNS, methods_in

BAND = (0.1, 0.9)
_TIME_GROUPS = 8  # as figure 6 joins its points


def error_bands(run_medians: pd.DataFrame) -> pd.DataFrame:
    """Errors against the iteration: median and 10-90 % over the runs that gave an estimate.

    Args:
        run_medians: rows of `medians_of_run`.

    Returns:
        robot_a, robot_b, aligner, iteration, n_runs, and for each error _low, the median, _high.
    """
    keys = ["robot_a", "robot_b", "aligner", "iteration"]
    groups = run_medians.groupby(keys, sort=False)
    parts = [groups["run_id"].nunique().rename("n_runs")]
    for column in ERROR_COLUMNS:
        low, high = (groups[column].quantile(q) for q in BAND)
        parts += [low.rename(f"{column}_low"), groups[column].median()]
        parts += [high.rename(f"{column}_high")]
    return pd.concat(parts, axis=1).reset_index()


def medians_of_run(errors: pd.DataFrame) -> pd.DataFrame:
    """A run's repetitions reduced to their median: signed rotation errors, NaN where all failed.

    The band of several runs is then over the runs, each of which counts once.
    """
    keys = ["run_id", "robot_a", "robot_b", "aligner", "iteration"]
    groups = errors.groupby(keys, sort=False)
    counts = ["n_correspondences", "n_true", "n_common"]
    return pd.concat([groups[list(ERROR_COLUMNS)].median(), groups[counts].first()], axis=1)


def time_bands(timings: pd.DataFrame) -> pd.DataFrame:
    """Time of one alignment against the overlap, in groups of about equal size.

    Args:
        timings: the table `aligner_timings` of some runs; each row is a median of repeats.

    Returns:
        aligner, n_common_low, n_common_high, n_runs, n_maps, and the 10 %, 50 % and 90 % of the
        maps' times: elapsed_low_s, elapsed_s, elapsed_high_s.
    """
    rows = []
    timed = timings.dropna(subset="elapsed_s")
    for aligner in methods_in(timed):
        own = timed[timed["aligner"] == aligner]
        group = np.ceil(own["n_common"].rank(pct=True) * _TIME_GROUPS)  # ties stay together
        for _, part in own.groupby(group):
            low, high = part["elapsed_s"].quantile(BAND[0]), part["elapsed_s"].quantile(BAND[1])
            row = {"aligner": aligner, "n_common_low": part["n_common"].min()}
            row |= {"n_common_high": part["n_common"].max(), "n_runs": part["run_id"].nunique()}
            row |= {"n_maps": len(part), "elapsed_low_s": low}
            rows.append(row | {"elapsed_s": part["elapsed_s"].median(), "elapsed_high_s": high})
    return pd.DataFrame(rows)
