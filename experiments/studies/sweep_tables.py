"""Tables of a sweep: rows of all its runs.

A folder `SWEEP/TABLE` is one Parquet dataset, which pandas and DuckDB can read while the sweep
runs. Each table begins with `run_id`, `scenario`, `seed` and one text column for each `--set` key.
`runs` has one row per run and is written last: the rows of a finished run are in all tables.

Each run has a place: its position in the order in which the folder was first asked for runs
(`sweep.json`). A file holds the rows of `RUNS_PER_FILE` places in this order, one row group for
every `_RUNS_PER_GROUP` places. So its bytes do not depend on the order in which the runs ended. A
file is always replaced as a whole: readers never find half a file or the rows of a run twice.
"""

import fcntl
import hashlib
import json
import os
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import BaseModel, ValidationError

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import absolute_errors, answerable
from experiments.evaluation.metrics import load_checked
from experiments.pipeline.stage import library_versions, source_hash
from experiments.pipeline.tables import FLOAT, TEXT, fields
from experiments.scenario.settings import AnyScenario
from experiments.studies.run_tables import SWEEP_SCHEMA_VERSION
from mapfusion.errors import DamagedFileError, InputError, StoreRepairWarning
from mapfusion.files import (
    read_json,
    read_parquet,
    row_groups,
    schema,
    write_atomically,
    write_json,
)

_HASH_LENGTH = 8  # hexadecimal digits of a run's values: 32 bits, and clashes are refused
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
    # Seconds of work by stage, including stages that are shared with other runs. The figure is
    # elapsed_s, or its part rendering_s. Only this table and `aligner_timings` contain times.
    RUN_TIMES: fields(stage=TEXT, key=TEXT, figure=TEXT, seconds=FLOAT),
}


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep.

    Attributes:
        path: file of the scenario.
        scenario: its name.
        seed: of the run.
        settings: key and value of each `--set`.
        content: content of the file when the sweep began, one object for all runs of a scenario.
            So a later change of the file does not change the runs.
    """

    path: Path
    scenario: str
    seed: int
    settings: tuple[tuple[str, str], ...] = ()
    content: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def run_id(self) -> str:
        """Name of the run; the same scenario, seed and values give the same name."""
        if not self.settings:
            return f"{self.scenario}-{self.seed}"
        digest = hashlib.sha256(json.dumps(sorted(self.settings)).encode()).hexdigest()
        return f"{self.scenario}-{self.seed}-{digest[:_HASH_LENGTH]}"

    def load(self) -> AnyScenario:
        """Return the scenario of this run; raises InputError."""
        overrides = [f"{key}={value}" for key, value in self.settings]
        return load_checked(self.path, overrides, self.seed, self.content)


@dataclass(frozen=True)
class SweepDataset:
    """Folder of a sweep and the keys of its `--set` options, in their order."""

    folder: Path
    keys: tuple[str, ...]

    def path(self, table: str, number: int) -> Path:
        """Return the path of a table's file of this number."""
        return self.folder / table / f"{number:05d}.parquet"

    def files(self, table: str) -> list[Path]:
        """Return all files of a table."""
        return sorted((self.folder / table).glob("[!.]*.parquet"))

    def rows(self, table: str, run: SweepRun, rows: Rows) -> pa.Table:
        """Return a run's rows of one table, with the columns that describe the run in front."""
        own = _OWN_FIELDS[table] if table in _OWN_FIELDS else list(tables.ALL[table])
        described: dict[str, Any] = {
            "run_id": run.run_id,
            "scenario": run.scenario,
            "seed": run.seed,
        }
        described |= dict(run.settings)
        leading = fields(**dict.fromkeys(described, TEXT) | {"seed": pa.int64()})
        own_schema = schema(
            f"sweep.{table}",
            SWEEP_SCHEMA_VERSION,
            [field.remove_metadata() for field in leading + own],
        )
        if not len(rows):
            return own_schema.empty_table()
        names = pd.Index([field.name for field in own])
        frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(rows, columns=names)
        columns = [pa.repeat(pa.scalar(described[f.name], f.type), len(frame)) for f in leading]
        columns += [pa.array(frame[field.name].to_numpy(), field.type) for field in own]
        return pa.Table.from_arrays(columns, schema=own_schema)

    def finished(
        self, run: SweepRun, renderer: str, stages: Sequence[str], made: Mapping[str, Rows]
    ) -> dict[str, pa.Table]:
        """Return the rows of a finished run, by table."""
        row = {"status": "finished", "reason": "", "renderer": renderer} | origin_columns(stages)
        return {name: self.rows(name, run, rows) for name, rows in {**made, RUNS: [row]}.items()}

    def failed(self, run: SweepRun, reason: str, stages: Sequence[str]) -> dict[str, pa.Table]:
        """Return the one row of a failed run, by table."""
        row = {"status": "failed", "reason": reason, "renderer": ""} | origin_columns(stages)
        return {RUNS: self.rows(RUNS, run, [row])}


def origin_columns(stages: Sequence[str]) -> dict[str, str]:
    """Return the columns of `runs` that identify the stages, libraries and source of a run."""
    return {
        "stages": json.dumps(list(stages)),
        "libraries": json.dumps(library_versions()),
        "source_hash": source_hash(),
    }


# A table of 1000 runs is about 1 MB for runs of 20 frames and about 100 MB for long runs. A row
# group is what is in memory at a time. It holds whole runs, so readers get whole runs.
RUNS_PER_FILE, _RUNS_PER_GROUP = 1000, 50
_MADE_FROM = ("status", "stages", "libraries", "source_hash")


class _Description(BaseModel):
    """Content of `sweep.json`."""

    schema_version: int
    settings: tuple[str, ...]
    runs: tuple[str, ...] = ()


class JoinedTables:
    """Tables of a sweep, and the rows that are to be written into them.

    Attributes:
        dataset: folder of the tables.
        run_ids: all runs of the folder, in the order of their places.
        waiting_bytes: size in memory of the rows that wait for `write`.
    """

    def __init__(self, dataset: SweepDataset) -> None:
        """Open the tables of a new or an existing sweep; nothing is written.

        Raises:
            InputError: the folder holds something else, or a sweep over other settings.
        """
        folder, keys = dataset.folder, dataset.keys
        self.dataset, self._path = dataset, folder / "sweep.json"
        self.run_ids = list[str]()
        if self._path.exists():
            try:
                stored = _Description.model_validate(
                    read_json(self._path, "description of a sweep")
                )
            except ValidationError as error:
                raise InputError(f"{self._path}: damaged or no description of a sweep") from error
            if stored.schema_version != SWEEP_SCHEMA_VERSION:
                version = f"schema_version is {stored.schema_version}"
                reads = f"this program adds to {SWEEP_SCHEMA_VERSION} alone"
                raise InputError(f"{self._path}: {version}, {reads}; give it another --output")
            if stored.settings != keys:
                was, now = (", ".join(names) or "seeds alone" for names in (stored.settings, keys))
                raise InputError(
                    f"{folder}: is a sweep over {was}, this one is over {now}; "
                    "tables of both would not fit together, give this one another --output"
                )
            self.run_ids += stored.runs
        elif folder.exists() and any(folder.iterdir()):
            what = "is no folder of a sweep (no sweep.json); give another --output"
            raise InputError(f"{folder}: {what}")
        self._place = {run_id: place for place, run_id in enumerate(self.run_ids)}
        self._waiting = defaultdict[int, dict[str, Mapping[str, pa.Table]]](dict)  # by number, run
        self.waiting_bytes = 0
        self._made_from: dict[int, dict[str, int]] = {}  # hash of `_MADE_FROM` by number, run
        self._damaged: set[int] = set()

    def ask_for(self, runs: Sequence[SweepRun]) -> None:
        """Add runs to the folder, behind those that were asked for before."""
        for run_id in dict.fromkeys(run.run_id for run in runs):
            if run_id not in self._place:
                self._place[run_id] = len(self.run_ids)
                self.run_ids.append(run_id)
        description = {
            "schema_version": SWEEP_SCHEMA_VERSION,
            "kind": "sweep",
            "settings": self.dataset.keys,
        }
        write_json(self._path, description | {"runs": self.run_ids})

    def number(self, run: SweepRun) -> int:
        """Return the number of the files that hold a run's rows."""
        return self._place[run.run_id] // RUNS_PER_FILE

    def holds(self, run: SweepRun, stages: Sequence[str]) -> bool:
        """Return True if a run is finished and was made from these stages by the current source.

        Damaged files hold no run: a warning names them, and `write` replaces them.
        """
        if run.run_id not in self._place:
            return False
        wanted = {"status": "finished"} | origin_columns(stages)
        found = self._runs_made(self.number(run)).get(run.run_id)
        return found == hash(tuple(wanted[name] for name in _MADE_FROM))

    def _runs_made(self, number: int) -> dict[str, int]:
        """Return a hash of what each run in the files of this number was made from."""
        if number not in self._made_from:
            self._made_from[number] = {}
            try:
                for path in self._files(number):
                    for group in row_groups(path, "table of a sweep"):  # checks all values
                        if path.parent.name == RUNS:
                            self._made_from[number] |= _hashes(group)
            except DamagedFileError as error:
                message = f"{error}; the runs in it are made again, when a sweep asks for them"
                warnings.warn(message, StoreRepairWarning, stacklevel=2)
                self._damaged.add(number)
                self._made_from[number] = {}
        return self._made_from[number]

    def _files(self, number: int) -> list[Path]:
        return sorted(self.dataset.folder.glob(f"*/{self.dataset.path('', number).name}"))

    def add(self, run: SweepRun, made: Mapping[str, pa.Table]) -> None:
        """Take a run's rows by table; `write` puts them in place of the run's earlier rows."""
        number = self.number(run)
        self._runs_made(number).update(_hashes(made[RUNS]))
        self._waiting[number][run.run_id] = made
        self.waiting_bytes += sum(table.nbytes for table in made.values())

    def write(self) -> None:
        """Write the rows that wait.

        Raises:
            DamagedFileError: a table is not as it was written.
        """
        for number, made in self._waiting.items():
            if number in self._damaged:
                for file in (self.dataset.path(RUNS, number), *self._files(number)):
                    file.unlink(missing_ok=True)
                self._damaged.remove(number)
            if not made.keys().isdisjoint(self.runs_in(RUNS, number)):
                # runs that were made again are not in `runs` until all their tables are written
                self.replace(RUNS, number, dict.fromkeys(made))
            names = {path.parent.name for path in self._files(number)}.union(*made.values())
            for name in [*sorted(names - {RUNS}), RUNS]:
                self.replace(name, number, {run_id: own.get(name) for run_id, own in made.items()})
        self._waiting.clear()
        self.waiting_bytes = 0

    def runs_in(self, table: str, number: int) -> set[str]:
        """Return the ids of the runs that have rows in a file."""
        path = self.dataset.path(table, number)
        groups = row_groups(path, table, lambda _: ["run_id"]) if path.is_file() else ()
        return {run_id for group in groups for run_id in group["run_id"].to_pylist()}

    def replace(self, table: str, number: int, rows: Mapping[str, pa.Table | None]) -> None:
        """Replace the rows that a file holds of these runs, by run id; None stands for no rows."""
        path, what = self.dataset.path(table, number), "table of a sweep"
        new = [own for own in rows.values() if own is not None]
        if new:
            own_schema = new[0].schema
        elif path.is_file():
            own_schema = next(row_groups(path, what)).schema
        else:
            return
        groups = row_groups(path, what) if path.is_file() else iter(())
        nothing, stays = own_schema.empty_table(), ~pc.field("run_id").isin(list(rows))

        def merged(run_ids: Sequence[str]) -> pa.Table:
            """Return the next row group with the new rows of these runs."""
            made = (rows.get(run_id) for run_id in run_ids)
            parts = [next(groups, nothing).filter(stays), *(own for own in made if own is not None)]
            # rows of an earlier version may lack columns, which become null, or have more
            every = pa.concat_tables([nothing, *parts], promote_options="permissive")
            place = [self._place[run_id] for run_id in every["run_id"].to_pylist()]
            ordered = every.take(np.argsort(place, kind="stable"))
            return ordered.select(own_schema.names).cast(own_schema)

        buffer, of_file = pa.BufferOutputStream(), self.run_ids[number * RUNS_PER_FILE :]
        options = {"compression": "zstd", "write_page_checksum": True}
        with pq.ParquetWriter(buffer, own_schema, **options) as writer:
            for start in range(0, len(of_file[:RUNS_PER_FILE]), _RUNS_PER_GROUP):
                writer.write_table(merged(of_file[start:][:_RUNS_PER_GROUP]))
        write_atomically(path, lambda file: file.write_bytes(buffer.getvalue()))


def _hashes(runs: pa.Table) -> dict[str, int]:
    """Return a hash of `_MADE_FROM` by run: the texts of many runs would fill the memory."""
    columns = (runs[name].to_pylist() for name in _MADE_FROM)
    return dict(zip(runs["run_id"].to_pylist(), map(hash, zip(*columns, strict=True)), strict=True))


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock a folder during a `with` block; the lock also ends with the process.

    Raises:
        InputError: another process has locked it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            others = "another sweep writes into it; wait for its end, or give another --output"
            raise InputError(f"{folder}: {others}") from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(handle)


ERRORS = ["translation_error_m", "refined_translation_error_m"]
GIVEN = ["estimated_share", "refined_share"]


def medians_over_runs(dataset: SweepDataset, runs: Sequence[SweepRun]) -> pd.DataFrame:
    """Return medians over runs of each run's own median errors.

    Files are read one by one, so memory does not grow with the number of runs.

    Returns:
        One row per scenario with its values (`setting`) and aligner: ERRORS (infinite without an
        estimate), GIVEN (shares of answers with an estimate) and the number of runs.
    """
    wanted, leading = {run.run_id for run in runs}, ["scenario", *dataset.keys]
    parts = []
    for file in dataset.files("errors"):
        columns = ["run_id", *leading, "aligner", "n_true", *ERRORS]
        errors = read_parquet(file, "table errors", columns).to_pandas()
        errors = answerable(errors[errors["run_id"].isin(wanted)])
        given = {name: errors[of].notna() for name, of in zip(GIVEN, ERRORS, strict=True)}
        rows = errors.assign(**given, **absolute_errors(errors, ERRORS))
        groups = rows.groupby(["run_id", *leading, "aligner"], sort=False)
        parts.append(groups[ERRORS].median().join(groups[GIVEN].mean()).reset_index())
    every = pd.concat(parts)
    every["setting"] = every[leading].agg(" ".join, axis=1) if len(every) else ""
    grouped = every.groupby(["setting", "aligner"], sort=False)
    found = grouped[ERRORS].median().join(grouped[GIVEN].mean())
    return found.assign(runs=grouped.size()).reset_index()
