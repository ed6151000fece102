"""What a sweep writes: `SWEEP/TABLE/RUN_ID.parquet`, one file a run and table, written whole.

A folder `SWEEP/TABLE` is one Parquet dataset, which pandas and DuckDB read while the sweep goes on.
Each table's columns come after `run_id`, `scenario`, `seed` and one text column for each `--set`
key. `runs` has one row a run and is written after all others: what it calls finished is complete.
"""

import json
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
from pydantic import BaseModel, ValidationError

from experiments.judge import tables
from experiments.judge.criteria import answerable, how_far_off
from experiments.run.code_version import library_versions, source_hash
from experiments.run.frames import FLOAT, TEXT, fields, write_rows
from experiments.study.sweep.combinations import SweepRun
from mapfusion.errors import DamagedFileError, InputError, MendedWarning
from mapfusion.sealed import read_sealed
from mapfusion.storage import read_json, read_parquet, schema, write_json, write_whole

SCHEMA_VERSION = 1
RUNS, RUN_TIMES, ALIGNER_TIMINGS = "runs", "run_times", "aligner_timings"
ERRORS = ["translation_error_m", "refined_translation_error_m"]
GIVEN = ["estimated_share", "refined_share"]

_OWN_FIELDS = {
    RUNS: fields(
        status=TEXT,  # finished or failed
        reason=TEXT,  # of a failure, else empty
        renderer=TEXT,
        stages=TEXT,  # JSON list of STAGE/KEY, as folders of the store are named
        libraries=TEXT,  # JSON object of versions
        source_hash=TEXT,
    ),
    # Seconds of work behind the run, by stage: also of stages that it shares with other runs. The
    # figure is elapsed_s, or rendering_s as a part of it. Beside `aligner_timings` the only table
    # that differs from time to time.
    RUN_TIMES: fields(stage=TEXT, key=TEXT, figure=TEXT, seconds=FLOAT),
}


class _Description(BaseModel):
    """What `sweep.json` holds."""

    schema_version: int
    settings: tuple[str, ...]


@dataclass(frozen=True)
class SweepDataset:
    """The folder of a sweep, and the keys of its `--set` options in their order."""

    folder: Path
    keys: tuple[str, ...]

    def path(self, table: str, run: SweepRun) -> Path:
        """Where a run's rows of a table are."""
        return self.folder / table / f"{run.run_id}.parquet"

    def write(self, table: str, run: SweepRun, rows: pd.DataFrame | list[dict[str, Any]]) -> None:
        """Write a run's rows of one table."""
        own = _OWN_FIELDS[table] if table in _OWN_FIELDS else list(tables.ALL[table])
        told: dict[str, Any] = {"run_id": run.run_id, "scenario": run.scenario, "seed": run.seed}
        told |= dict(run.settings)
        leading = fields(**dict.fromkeys(told, TEXT) | {"seed": pa.int64()})
        frame = pd.DataFrame(rows, columns=pd.Index([field.name for field in own])).assign(**told)
        table_schema = schema(f"sweep.{table}", SCHEMA_VERSION, leading + own)
        write_rows(self.path(table, run), table_schema, frame)

    def finish(self, run: SweepRun, renderer: str, stages: Sequence[str]) -> None:
        """Say that all rows of a run are there."""
        row = {"status": "finished", "reason": "", "renderer": renderer}
        self._end(run, row | _made_by(stages))

    def fail(
        self, run: SweepRun, reason: str, details: str = "", stages: Sequence[str] = ()
    ) -> Path:
        """Say why a run has no rows; those of an earlier, finished one are removed.

        Returns:
            Where the details are, if there are any.
        """
        row = {"status": "failed", "reason": reason, "renderer": ""}
        path = self._end(run, row | _made_by(stages))
        for file in self.folder.glob(f"*/{run.run_id}.parquet"):
            if file.parent.name != RUNS:
                file.unlink(missing_ok=True)
        if details:
            text = details.encode("utf-8", "backslashreplace")  # an exception's text may be any
            write_whole(path, lambda file: file.write_bytes(text))
        return path

    def _end(self, run: SweepRun, row: dict[str, str]) -> Path:
        """Write the row of `runs`; returns where details of a failure go, none of which is left."""
        details = self.folder / "failures" / f"{run.run_id}.txt"
        details.unlink(missing_ok=True)
        self.write(RUNS, run, [row])
        return details

    def holds(self, run: SweepRun, stages: Sequence[str]) -> bool:
        """Whether the run is finished, made from these stages by the source as it is now.

        And whether its tables are as they were written: a damaged one is told, and made again.
        """
        path, wanted = self.path(RUNS, run), {"status": "finished"} | _made_by(stages)
        if not path.is_file():
            return False
        try:
            if read_parquet(path, RUNS, list(wanted)).to_pylist() != [wanted]:
                return False
            for file in self.folder.glob(f"*/{run.run_id}.parquet"):
                read_sealed(file, "table of a sweep")
        except DamagedFileError as error:
            told = f"{error}; the run's tables are written again"
            warnings.warn(told, MendedWarning, stacklevel=2)
            return False
        return True


def _made_by(stages: Sequence[str]) -> dict[str, str]:
    return {
        "stages": json.dumps(list(stages)),
        "libraries": json.dumps(library_versions()),
        "source_hash": source_hash(),
    }


def open_dataset(folder: Path, keys: Iterable[str]) -> SweepDataset:
    """A new or an existing sweep's folder, to which more runs may be added.

    Raises:
        InputError: the folder holds something else, or a sweep over other settings.
    """
    dataset = SweepDataset(folder, tuple(keys))
    path = folder / "sweep.json"
    if path.exists():
        _require_settings(path, dataset.keys)
    elif folder.exists() and any(folder.iterdir()):
        what = "is no folder of a sweep (no sweep.json); give another --output"
        raise InputError(f"{folder}: {what}")
    else:
        own = {"schema_version": SCHEMA_VERSION, "kind": "sweep", "settings": dataset.keys}
        write_json(path, own)
    return dataset


def _require_settings(path: Path, keys: tuple[str, ...]) -> None:
    try:
        found = _Description.model_validate(read_json(path, "description of a sweep"))
    except ValidationError as error:
        raise InputError(f"{path}: damaged or no description of a sweep") from error
    version, known = found.schema_version, found.settings
    if version != SCHEMA_VERSION:
        reads = f"this program reads {SCHEMA_VERSION}"
        raise InputError(f"{path}: schema_version is {version}, {reads}")
    if tuple(known) != keys:
        was, now = (", ".join(listed) or "seeds alone" for listed in (known, keys))
        raise InputError(
            f"{path.parent}: is a sweep over {was}, this one is over {now}; "
            "tables of both would not fit together, give this one another --output"
        )


def medians_over_runs(dataset: SweepDataset, runs: Sequence[SweepRun]) -> pd.DataFrame:
    """A sweep's errors in short: medians over runs of each run's own medians.

    One row for each scenario with its values (`setting`) and aligner: ERRORS, infinite without an
    estimate, GIVEN, the shares of answers with one, and the number of runs. Read run by run, so
    that memory does not grow with the sweep.
    """
    parts = []
    for run in runs:
        columns = ["aligner", "n_true", *ERRORS]
        errors = read_parquet(dataset.path("errors", run), "table errors", columns).to_pandas()
        setting = " ".join((run.scenario, *(value for _, value in run.settings)))
        errors = answerable(errors)
        given = {name: errors[of].notna() for name, of in zip(GIVEN, ERRORS, strict=True)}
        judged = errors.assign(**given, **how_far_off(errors, ERRORS))
        groups = judged.groupby("aligner", sort=False)
        medians = groups[ERRORS].median().join(groups[GIVEN].mean())
        parts.append(medians.reset_index().assign(setting=setting))
    grouped = pd.concat(parts).groupby(["setting", "aligner"], sort=False)
    found = grouped[ERRORS].median().join(grouped[GIVEN].mean())
    return found.assign(runs=grouped.size()).reset_index()
