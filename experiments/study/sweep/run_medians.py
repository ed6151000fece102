"""A sweep's errors in short."""

from collections.abc import Sequence

import pandas as pd

from experiments.judge.criteria import answerable, how_far_off
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.sweep_dataset import SweepDataset
from mapfusion.storage import read_parquet

ERRORS = ["translation_error_m", "refined_translation_error_m"]
GIVEN = ["estimated_share", "refined_share"]


def medians_over_runs(dataset: SweepDataset, runs: Sequence[SweepRun]) -> pd.DataFrame:
    """A sweep's errors in short: medians over runs of each run's own medians.

    One row for each scenario with its values (`setting`) and aligner: ERRORS, infinite without an
    estimate, GIVEN, the shares of answers with one, and the number of runs. Read file by file, so
    that memory does not grow with the rows of a sweep.
    """
    wanted, leading = {run.run_id for run in runs}, ["scenario", *dataset.keys]
    parts = []
    for file in dataset.files("errors"):
        columns = ["run_id", *leading, "aligner", "n_true", *ERRORS]
        errors = read_parquet(file, "table errors", columns).to_pandas()
        errors = answerable(errors[errors["run_id"].isin(wanted)])
        given = {name: errors[of].notna() for name, of in zip(GIVEN, ERRORS, strict=True)}
        judged = errors.assign(**given, **how_far_off(errors, ERRORS))
        groups = judged.groupby(["run_id", *leading, "aligner"], sort=False)
        parts.append(groups[ERRORS].median().join(groups[GIVEN].mean()).reset_index())
    every = pd.concat(parts)
    every["setting"] = every[leading].agg(" ".join, axis=1) if len(every) else ""
    grouped = every.groupby(["setting", "aligner"], sort=False)
    found = grouped[ERRORS].median().join(grouped[GIVEN].mean())
    return found.assign(runs=grouped.size()).reset_index()
