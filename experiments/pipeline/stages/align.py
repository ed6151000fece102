"""Stage: estimates of all aligners for one pair of robots, joined in order of iteration."""

from dataclasses import dataclass

import pandas as pd

from experiments.pipeline.stage import Job
from experiments.pipeline.stages import match
from experiments.pipeline.tables import CORRESPONDENCES, ESTIMATES, RIVALS, read_rows, write_rows

LABEL = match.LABEL
WRITES = ("estimates.parquet", "correspondences.parquet", "rivals.parquet")


@dataclass(frozen=True)
class JoinSettings:
    """Batches of the aligners' stages."""

    batches: tuple[str, ...]


def run(settings: JoinSettings, job: Job) -> None:
    """Write one table of estimates, one of correspondences and one of rivals."""
    aligners = [folder for name, folder in job.inputs.items() if name != "match"]
    matched = [job.inputs["match"]]
    tables = (
        (ESTIMATES, match.batch_path, aligners),
        (CORRESPONDENCES, match.batch_path, matched),
        (RIVALS, match.rivals_path, matched),
    )
    for file, (schema, path_of, folders) in zip(WRITES, tables, strict=True):
        paths = [path_of(folder, part) for part in settings.batches for folder in folders]
        joined = pd.concat([read_rows(path, schema) for path in paths], ignore_index=True)
        # a stable sort keeps the order of the aligners within an iteration
        joined = joined.sort_values("iteration", kind="stable", ignore_index=True)
        write_rows(job.output / file, schema, joined)
