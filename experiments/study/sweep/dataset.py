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
from experiments.study.sweep.grid import Axis, Run
from mapfusion.errors import InputError
from mapfusion.storage import schema, write_table, write_whole

SCHEMA_VERSION = 1
RUNS, RUN_TIMES, ALIGNER_TIMINGS = "runs", "run_times", "aligner_timings"
FINISHED, FAILED = "finished", "failed"
# All that a run's rows can depend on.
SOURCES = ("mapfusion", "sim", "experiments")

_TEXT = pa.string()
_RUNS_FIELDS = [
    pa.field("status", _TEXT),  # finished or failed
    pa.field("reason", _TEXT),  # of a failure, else empty
    pa.field("renderer", _TEXT),
    pa.field("stages", _TEXT),  # JSON list of STAGE/KEY, as folders of the store are named
    pa.field("libraries", _TEXT),  # JSON object of versions
    pa.field("source_hash", _TEXT),
]
# Seconds of work behind the run, by stage: also of stages that it shares with other runs. Beside
# `aligner_timings` the only table that differs from time to time.
_RUN_TIMES_FIELDS = [
    pa.field("stage", _TEXT),
    pa.field("key", _TEXT),
    pa.field("figure", _TEXT),  # elapsed_s, or rendering_s as a part of it
    pa.field("seconds", pa.float64()),
]


@dataclass(frozen=True)
class Dataset:
    """The folder of a sweep.

    Attributes:
        folder: SWEEP.
        keys: of the `--set` options, in their order.
    """

    folder: Path
    keys: tuple[str, ...]

    def path(self, table: str, run: Run) -> Path:
        """Where a run's rows of a table are."""
        return self.folder / table / f"{run.run_id}.parquet"

    def write(self, table: str, run: Run, rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> None:
        """Write a run's rows of one table."""
        own = _own_fields(table)
        frame = pd.DataFrame(rows, columns=pd.Index([field.name for field in own]))
        columns: dict[str, Any] = {
            name: [value] * len(frame) for name, value in self._described(run).items()
        }
        columns |= {str(name): frame[name].to_numpy() for name in frame}
        fields = [
            pa.field("run_id", _TEXT),
            pa.field("scenario", _TEXT),
            pa.field("seed", pa.int64()),
            *(pa.field(key, _TEXT) for key in self.keys),
            *own,
        ]
        write_table(
            self.path(table, run), columns, schema(f"sweep.{table}", SCHEMA_VERSION, fields)
        )

    def _described(self, run: Run) -> dict[str, Any]:
        settings = dict(zip(self.keys, run.settings, strict=True))
        return {"run_id": run.run_id, "scenario": run.scenario, "seed": run.seed} | settings

    def finish(self, run: Run, renderer: str, stages: Sequence[str]) -> None:
        """Say that all rows of a run are there."""
        row = {"status": FINISHED, "reason": "", "renderer": renderer} | _made_by(stages)
        self._details(run).unlink(missing_ok=True)
        self.write(RUNS, run, [row])

    def fail(self, run: Run, reason: str, details: str = "", stages: Sequence[str] = ()) -> None:
        """Say why a run has no rows; those of an earlier, finished one are removed."""
        row = {"status": FAILED, "reason": reason, "renderer": ""} | _made_by(stages)
        self.write(RUNS, run, [row])
        for folder in self.folder.iterdir():
            if folder.is_dir() and folder.name != RUNS:
                (folder / f"{run.run_id}.parquet").unlink(missing_ok=True)
        self._details(run).unlink(missing_ok=True)
        if details:
            write_whole(self._details(run), lambda file: file.write_text(details, encoding="utf-8"))

    def _details(self, run: Run) -> Path:
        return self.folder / "failures" / f"{run.run_id}.txt"

    def holds(self, run: Run, stages: Sequence[str]) -> bool:
        """Whether the run is finished, made from these stages by the source as it is now."""
        try:
            found = pq.read_table(self.path(RUNS, run), columns=["status", *_made_by(stages)])
        except (OSError, pa.ArrowInvalid):
            return False
        return found.to_pylist() == [{"status": FINISHED} | _made_by(stages)]


def _own_fields(table: str) -> list[pa.Field]:
    special = {RUNS: _RUNS_FIELDS, RUN_TIMES: _RUN_TIMES_FIELDS}
    return special[table] if table in special else list(tables.ALL[table])


def _made_by(stages: Sequence[str]) -> dict[str, str]:
    return {
        "stages": json.dumps(list(stages)),
        "libraries": json.dumps(library_versions()),
        "source_hash": source_hash(SOURCES),
    }


def open_dataset(folder: Path, axes: Sequence[Axis]) -> Dataset:
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
    return Dataset(folder, keys)


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
