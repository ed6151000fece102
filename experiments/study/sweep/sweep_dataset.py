"""What a sweep writes: `SWEEP/TABLE/NUMBER.parquet`, each with the rows of many runs.

A folder `SWEEP/TABLE` is one Parquet dataset, which pandas and DuckDB read while the sweep goes on.
Each table's columns come after `run_id`, `scenario`, `seed` and one text column for each `--set`
key. `runs` has one row a run and is written after all others: what it calls finished is complete.

Who makes a run puts its rows into one file, `SWEEP/waiting/RUN_ID.arrow`, which no reader of tables
finds; the command joins those that wait (`joined_tables`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from experiments.judge import tables
from experiments.run.code_version import library_versions, source_hash
from experiments.run.frames import FLOAT, TEXT, fields
from experiments.study.sweep.combinations import SweepRun
from mapfusion.errors import DamagedFileError
from mapfusion.sealed import LINE, read_sealed
from mapfusion.storage import UNREADABLE, schema, text_attributes, write_sealed, write_whole

SCHEMA_VERSION = 2
RUNS, RUN_TIMES, ALIGNER_TIMINGS = "runs", "run_times", "aligner_timings"
Rows = pd.DataFrame | list[dict[str, Any]]

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


@dataclass(frozen=True)
class SweepDataset:
    """The folder of a sweep, and the keys of its `--set` options in their order."""

    folder: Path
    keys: tuple[str, ...]

    def path(self, table: str, number: int) -> Path:
        """Where a table's rows of the runs of that number are."""
        return self.folder / table / f"{number:05d}.parquet"

    def files(self, table: str) -> list[Path]:
        """All files of a table."""
        return sorted((self.folder / table).glob("[!.]*.parquet"))

    @property
    def waiting(self) -> Path:
        """Where the rows of runs wait that are not joined yet."""
        return self.folder / "waiting"

    def waiting_path(self, run: SweepRun) -> Path:
        """Where the rows of one run wait."""
        return self.waiting / f"{run.run_id}.arrow"

    def rows(self, table: str, run: SweepRun, rows: Rows) -> pa.Table:
        """A run's rows of one table, preceded by what run they are of."""
        own = _OWN_FIELDS[table] if table in _OWN_FIELDS else list(tables.ALL[table])
        told: dict[str, Any] = {"run_id": run.run_id, "scenario": run.scenario, "seed": run.seed}
        told |= dict(run.settings)
        leading = fields(**dict.fromkeys(told, TEXT) | {"seed": pa.int64()})
        own_schema = schema(
            f"sweep.{table}", SCHEMA_VERSION, [field.remove_metadata() for field in leading + own]
        )
        if not len(rows):
            return own_schema.empty_table()
        names = pd.Index([field.name for field in own])
        frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(rows, columns=names)
        columns = [pa.repeat(pa.scalar(told[f.name], f.type), len(frame)) for f in leading]
        columns += [pa.array(frame[field.name].to_numpy(), field.type) for field in own]
        return pa.Table.from_arrays(columns, schema=own_schema)

    def finish(
        self, run: SweepRun, renderer: str, stages: Sequence[str], made: Mapping[str, Rows]
    ) -> None:
        """Keep all that a run made; it takes the place of whatever was there of the run."""
        row = {"status": "finished", "reason": "", "renderer": renderer} | made_by(stages)
        self._details(run).unlink(missing_ok=True)
        self._keep(run, {**made, RUNS: [row]})

    def fail(
        self, run: SweepRun, reason: str, details: str = "", stages: Sequence[str] = ()
    ) -> Path:
        """Say why a run has no rows; those of an earlier, finished one will go.

        Returns:
            Where the details are, if there are any.
        """
        path = self._details(run)
        path.unlink(missing_ok=True)
        row = {"status": "failed", "reason": reason, "renderer": ""} | made_by(stages)
        self._keep(run, {RUNS: [row]})
        if details:
            text = details.encode("utf-8", "backslashreplace")  # an exception's text may be any
            write_whole(path, lambda file: file.write_bytes(text))
        return path

    def _details(self, run: SweepRun) -> Path:
        return self.folder / "failures" / f"{run.run_id}.txt"

    def _keep(self, run: SweepRun, made: Mapping[str, Rows]) -> None:
        buffer = pa.BufferOutputStream()
        for name, rows in made.items():
            table = self.rows(name, run, rows)
            with pa.ipc.new_stream(buffer, table.schema) as stream:
                stream.write_table(table)
        write_sealed(self.waiting_path(run), buffer.getvalue().to_pybytes() + LINE)


def read_waiting(path: Path) -> dict[str, pa.Table]:
    """The rows of one run by table; raises DamagedFileError."""
    data = read_sealed(path, "file of rows that wait", only_ours=True)
    source, found = pa.BufferReader(data), dict[str, pa.Table]()
    try:
        while source.tell() < len(data) - len(LINE):
            with pa.ipc.open_stream(source) as stream:
                table = stream.read_all()
            kind = text_attributes(path, table).get("kind", "")
            found[kind.rpartition(".")[2]] = table
    except UNREADABLE as error:
        raise DamagedFileError(path, f"damaged ({' '.join(str(error).split())})") from error
    return found


def made_by(stages: Sequence[str]) -> dict[str, str]:
    """What a run was made from, and by which code: columns of `runs`."""
    return {
        "stages": json.dumps(list(stages)),
        "libraries": json.dumps(library_versions()),
        "source_hash": source_hash(),
    }
