"""A sweep's errors in short: medians over runs of each run's own medians."""

from collections.abc import Sequence

import pandas as pd
import pyarrow.parquet as pq

from experiments.judge.criteria import answerable
from experiments.study.sweep.combinations import SweepRun
from experiments.study.sweep.sweep_dataset import SweepDataset

ERRORS = ["translation_error_m", "refined_translation_error_m"]


def medians_over_runs(dataset: SweepDataset, runs: Sequence[SweepRun]) -> pd.DataFrame:
    """One row for each scenario with its values (`setting`) and aligner: ERRORS, number of runs.

    Run by run, so that memory does not grow with the sweep.
    """
    parts = []
    for run in runs:
        columns = ["aligner", "n_true", *ERRORS]
        errors = pq.read_table(dataset.path("errors", run), columns=columns).to_pandas()
        setting = " ".join((run.scenario, *(value for _, value in run.settings)))
        medians = answerable(errors).groupby("aligner", sort=False)[ERRORS].median()
        parts.append(medians.reset_index().assign(setting=setting))
    grouped = pd.concat(parts).groupby(["setting", "aligner"], sort=False)
    return grouped[ERRORS].median().assign(runs=grouped.size()).reset_index()
