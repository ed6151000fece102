"""Stage: the estimates of all aligners for one pair of robots, joined in order of iteration."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pyarrow as pa

from experiments.run.frames import read_rows, write_rows
from experiments.run.job import Job
from experiments.run.stage_tables import CORRESPONDENCES, ESTIMATES
from experiments.run.stages.map_batches import batch_path

WRITES = ("estimates.parquet", "correspondences.parquet")


@dataclass(frozen=True)
class JoinSettings:
    """The batches there are."""

    batches: tuple[str, ...]


def run(settings: JoinSettings, job: Job) -> None:
    """Write one table of estimates and one of correspondences."""
    aligners = [folder for name, folder in job.inputs.items() if name != "match"]
    _join(job, "estimates", ESTIMATES, aligners, settings.batches)
    _join(job, "correspondences", CORRESPONDENCES, [job.inputs["match"]], settings.batches)


def _join(
    job: Job, name: str, schema: pa.Schema, folders: list[Path], batches: tuple[str, ...]
) -> None:
    parts = [read_rows(batch_path(folder, b), schema) for b in batches for folder in folders]
    # within an iteration the aligners stay in their order
    joined = pd.concat(parts, ignore_index=True)
    joined = joined.sort_values("iteration", kind="stable", ignore_index=True)
    write_rows(job.output / f"{name}.parquet", schema, joined)
