"""What a sweep writes: `SWEEP/TABLE/RUN_ID.parquet`, one file a run and table, written whole.

A folder `SWEEP/TABLE` is one Parquet dataset, which pandas and DuckDB read while the sweep goes on.
Each table's columns come after `run_id`, `scenario`, `seed` and one text column for each `--set`
key. `runs` has one row a run and is written after all others: what it calls finished is complete.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.judge import tables
from experiments.run.code_version import library_versions, source_hash
from experiments.run.dask_worker import SOURCES
from experiments.run.frames import FLOAT, TEXT, fields
from experiments.study.sweep.combinations import Axis, SweepRun
from mapfusion.errors import InputError
from mapfusion.storage import schema, write_table, write_whole

SCHEMA_VERSION = 1
RUNS, RUN_TIMES, ALIGNER_TIMINGS = "runs", "run_times", "aligner_timings"
FINISHED, FAILED = "finished", "failed"

_RUNS_FIELDS = fields(
    status=TEXT,  # finished or failed
    reason=TEXT,  # of a failure, else empty
    renderer=TEXT,
    stages=TEXT,  # JSON list of STAGE/KEY, as folders of the store are named
    libraries=TEXT,  # JSON object of versions
    source_hash=TEXT,
)
# Seconds of work behind the run, by stage: also of stages that it shares with other runs. Beside
# `aligner_timings` the only table that differs from time to time.
_RUN_TIMES_FIELDS = fields(
    stage=TEXT,
    key=TEXT,
    figure=TEXT,  # elapsed_s, or rendering_s as a part of it
    seconds=FLOAT,
)
_OWN_FIELDS = {RUNS: _RUNS_FIELDS, RUN_TIMES: _RUN_TIMES_FIELDS}


@dataclass(frozen=True)
class SweepDataset:
    """The folder of a sweep.

    Attributes:
        folder: SWEEP.
        keys: of the `--set` options, in their order.
    """

    folder: Path
    keys: tuple[str, ...]

    def path(self, table: str, run: SweepRun) -> Path:
        """Where a run's rows of a table are."""
        return self.folder / table / f"{run.run_id}.parquet"

    def write(
        self, table: str, run: SweepRun, rows: pd.DataFrame | Sequence[Mapping[str, Any]]
    ) -> None:
        """Write a run's rows of one table."""
        own = _OWN_FIELDS[table] if table in _OWN_FIELDS else list(tables.ALL[table])
        frame = pd.DataFrame(rows, columns=pd.Index([field.name for field in own]))
        settings = dict(run.settings)
        described = {"run_id": run.run_id, "scenario": run.scenario, "seed": run.seed} | settings
        columns: dict[str, Any] = {name: [value] * len(frame) for name, value in described.items()}
        columns |= {str(name): frame[name].to_numpy() for name in frame}
        leading = fields(
            run_id=TEXT, scenario=TEXT, seed=pa.int64(), **dict.fromkeys(settings, TEXT)
        )
        table_schema = schema(f"sweep.{table}", SCHEMA_VERSION, leading + own)
        write_table(self.path(table, run), columns, table_schema)

    def finish(self, run: SweepRun, renderer: str, stages: Sequence[str]) -> None:
        """Say that all rows of a run are there."""
        row = {"status": FINISHED, "reason": "", "renderer": renderer} | _made_by(stages)
        self._details(run).unlink(missing_ok=True)
        self.write(RUNS, run, [row])

    def fail(
        self, run: SweepRun, reason: str, details: str = "", stages: Sequence[str] = ()
    ) -> None:
        """Say why a run has no rows; those of an earlier, finished one are removed."""
        row = {"status": FAILED, "reason": reason, "renderer": ""} | _made_by(stages)
        self.write(RUNS, run, [row])
        for folder in self.folder.iterdir():
            if folder.is_dir() and folder.name != RUNS:
                (folder / f"{run.run_id}.parquet").unlink(missing_ok=True)
        self._details(run).unlink(missing_ok=True)
        if details:
            write_whole(self._details(run), lambda file: file.write_text(details, encoding="utf-8"))

    def _details(self, run: SweepRun) -> Path:
        return self.folder / "failures" / f"{run.run_id}.txt"

    def holds(self, run: SweepRun, stages: Sequence[str]) -> bool:
        """Whether the run is finished, made from these stages by the source as it is now."""
        try:
            found = pq.read_table(self.path(RUNS, run), columns=["status", *_made_by(stages)])
        except (OSError, pa.ArrowInvalid):
            return False
        return found.to_pylist() == [{"status": FINISHED} | _made_by(stages)]


def _made_by(stages: Sequence[str]) -> dict[str, str]:
    return {
        "stages": json.dumps(list(stages)),
        "libraries": json.dumps(library_versions()),
        "source_hash": source_hash(SOURCES),
    }


def open_dataset(folder: Path, axes: Sequence[Axis]) -> SweepDataset:
    """A new or an existing sweep's folder, to which more runs may be added.

    Raises:
        InputError: the folder holds something else, or a sweep over other settings.
    """
    keys = tuple(axis.key for axis in axes)
    path = folder / "sweep.json"
    if path.exists():
        known = _read_description(path)
        if known != keys:
            raise InputError(
                f"{folder}: is a sweep over {_listed(known)}, this one is over {_listed(keys)}; "
                "tables of both would not fit together, give this one another --output"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise InputError(
            f"{folder}: is no folder of a sweep (no sweep.json); give another --output"
        )
    else:
        description = {"schema_version": SCHEMA_VERSION, "kind": "sweep", "settings": keys}
        text = json.dumps(description, indent=1)
        write_whole(path, lambda file: file.write_text(text, encoding="utf-8"))
    return SweepDataset(folder, keys)


def _listed(keys: Sequence[str]) -> str:
    return ", ".join(keys) or "seeds alone"


def _read_description(path: Path) -> tuple[str, ...]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        version, settings = found["schema_version"], found["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged or no description of a sweep ({error})") from error
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{path}: schema_version is {version}, this program reads {SCHEMA_VERSION}"
        )
    return tuple(settings)
