"""Tables of a sweep: rows of all its runs.

A folder `SWEEP/TABLE` is one Parquet dataset, which pandas and DuckDB read while the sweep goes on.
Each table's columns come after `run_id`, `scenario`, `seed` and one text column for each `--set`
key. `runs` has one row a run and is written after all others: what it calls finished is complete.

Who makes a run puts its rows into one file, `SWEEP/waiting/RUN_ID.arrow`, which no reader of tables
finds; the command joins those that wait (`joined_tables`).

Every run of a folder has its place, in the order in which runs were first asked for (`sweep.json`),
and a file holds the runs of so many places one after the other: the same bytes in whatever order
they were made. A file is replaced whole by one that holds more, so that no reader finds a run's
rows twice, and rows that wait go only when they are in the tables.
"""

import fcntl
import hashlib
import heapq
import itertools
import json
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ValidationError

from experiments.evaluation import tables
from experiments.evaluation.criteria import answerable, how_far_off
from experiments.pipeline.code_version import library_versions, source_hash
from experiments.pipeline.tables import FLOAT, TEXT, fields
from experiments.studies.sweep_combinations import SweepRun
from mapfusion.errors import DamagedFileError, InputError, MendedWarning
from mapfusion.files import (
    UNREADABLE,
    read_json,
    read_parquet,
    require_file,
    row_groups,
    schema,
    text_attributes,
    write_json,
    write_whole,
)

SCHEMA_VERSION = 2
_DIGEST_BYTES = hashlib.sha256().digest_size
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
        rows = buffer.getvalue().to_pybytes()
        whole = rows + hashlib.sha256(rows).digest()  # Arrow's streams have no checksums
        write_whole(self.waiting_path(run), lambda file: file.write_bytes(whole))


def read_waiting(path: Path) -> dict[str, pa.Table]:
    """The rows of one run by table; raises DamagedFileError."""
    require_file(path, "file of rows that wait")
    whole = path.read_bytes()
    rows, digest = whole[:-_DIGEST_BYTES], whole[-_DIGEST_BYTES:]
    if hashlib.sha256(rows).digest() != digest:
        raise DamagedFileError(path, "damaged, it does not fit its digest")
    source, found = pa.BufferReader(rows), dict[str, pa.Table]()
    try:
        while source.tell() < len(rows):
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


# Runs a file: of runs of 20 frames up to 1 MB, of long ones some 100 MB.
RUNS_PER_FILE = 1000
# Rows that are in memory at one time, some 20 MB; whole runs, so that readers get them whole.
_ROWS_PER_GROUP = 100_000
_TOLD = ("status", "stages", "libraries", "source_hash")


class _Description(BaseModel):
    """What `sweep.json` holds."""

    schema_version: int
    settings: tuple[str, ...]
    runs: tuple[str, ...] = ()


class JoinedTables:
    """The tables of a sweep, which one command alone writes."""

    def __init__(self, dataset: SweepDataset, runs: Iterable[str] = ()) -> None:
        """`runs` are all the folder's, by their names, in the order of their places."""
        self.dataset = dataset
        self._place = {run_id: place for place, run_id in enumerate(runs)}
        self._held: dict[int, dict[str, str]] = {}  # by file: what its runs were made from
        self._damaged: set[int] = set()  # files that go before others take their place

    @classmethod
    def of(cls, dataset: SweepDataset) -> "JoinedTables":
        """As they are on disk; nothing is written.

        Raises:
            InputError: the folder holds something else, or a sweep over other settings.
        """
        folder, path = dataset.folder, dataset.folder / "sweep.json"
        if path.exists():
            return cls(dataset, _described(path, dataset.keys))
        if folder.exists() and any(folder.iterdir()):
            what = "is no folder of a sweep (no sweep.json); give another --output"
            raise InputError(f"{folder}: {what}")
        return cls(dataset)

    @property
    def run_ids(self) -> list[str]:
        """All runs of the folder, in the order of their places."""
        return list(self._place)

    def place(self, run: SweepRun) -> int:
        """Where a run is in the folder's order."""
        return self._place[run.run_id]

    def number(self, run: SweepRun) -> int:
        """Which of the files holds a run."""
        return self.place(run) // RUNS_PER_FILE

    def holds(self, run: SweepRun, stages: Sequence[str]) -> bool:
        """Whether the run is finished, made from these stages by the source as it is now.

        And whether its tables are as they were written: damaged ones are told, and made again.
        """
        wanted = {"status": "finished"} | made_by(stages)
        return self._told(run) == _digest(wanted[name] for name in _TOLD)

    def _told(self, run: SweepRun) -> str | None:
        path = self.dataset.waiting_path(run)
        if path.is_file() and (tables := _waiting_or_none(path)):
            return _digests(tables[RUNS])[run.run_id]
        if run.run_id not in self._place:
            return None
        number = self.number(run)
        if number not in self._held:
            self._held[number] = self._checked(number)
        return self._held[number].get(run.run_id)

    def _checked(self, number: int) -> dict[str, str]:
        """What the runs in the files of that number were made from; none if one is damaged."""
        path, files = self.dataset.path(RUNS, number), self._files(number)
        if not path.is_file():
            return {}
        try:
            for file in files:
                read_parquet(file, "table of a sweep")
            return _digests(read_parquet(path, RUNS, ["run_id", *_TOLD]))
        except DamagedFileError as error:
            told = f"{error}; the runs in it are made again, when a sweep asks for them"
            warnings.warn(told, MendedWarning, stacklevel=2)
            self._damaged.add(number)
            return {}

    def _files(self, number: int) -> list[Path]:
        return sorted(self.dataset.folder.glob(f"*/{self.dataset.path('', number).name}"))

    def join(self, only: int | None = None) -> None:
        """Put rows that wait into the tables: all, or those of the files of one number.

        Raises:
            DamagedFileError: a table is not as it was written.
        """
        waiting: dict[int, dict[int, Path]] = {}
        for path in self.dataset.waiting.glob("[!.]*.arrow"):
            place = self._place.get(path.stem)
            if place is not None and only in (None, place // RUNS_PER_FILE):
                waiting.setdefault(place // RUNS_PER_FILE, {})[place] = path
        for number in sorted(waiting):
            self._join(number, waiting[number])
        if self.dataset.waiting.is_dir() and not any(self.dataset.waiting.iterdir()):
            self.dataset.waiting.rmdir()

    def _join(self, number: int, waiting: Mapping[int, Path]) -> None:
        if number in self._damaged:
            for file in (self.dataset.path(RUNS, number), *self._files(number)):
                file.unlink(missing_ok=True)
            self._damaged.remove(number)
        made = {place: _waiting_or_none(path) for place, path in waiting.items()}
        names = {path.parent.name for path in self._files(number)}
        names |= {name for tables in made.values() for name in tables}
        if not self.runs_in(RUNS, number).isdisjoint(path.stem for path in waiting.values()):
            # of runs that were made again nothing is said until all their tables are there
            self.replace(RUNS, number, dict.fromkeys(made))
        for name in [*sorted(names - {RUNS}), RUNS]:
            self.replace(name, number, {place: made[place].get(name) for place in made})
        for path in waiting.values():
            path.unlink(missing_ok=True)

    def runs_in(self, table: str, number: int) -> set[str]:
        """Names of the runs that have rows in a file."""
        path = self.dataset.path(table, number)
        found = read_parquet(path, table, ["run_id"]) if path.is_file() else None
        return set() if found is None else set(found["run_id"].to_pylist())

    def replace(self, table: str, number: int, rows: Mapping[int, pa.Table | None]) -> None:
        """Write a file of a table anew, with these rows in place of those it had of their runs.

        Rows by their run's place, None for a run that has none.
        """
        path = self.dataset.path(table, number)
        new = [(place, own) for place, own in sorted(rows.items()) if own is not None]
        old = self._rows_in(path, table) if path.is_file() else iter(())
        kept = ((place, own) for place, own in old if place not in rows)
        parts = (own for _, own in heapq.merge(kept, new, key=itemgetter(0)))
        if new:
            _write(path, new[0][1].schema, parts)
        elif path.is_file():
            _write(path, next(row_groups(path, table)).schema, parts)
        self._held.pop(number, None)

    def _rows_in(self, path: Path, table: str) -> Iterator[tuple[int, pa.Table]]:
        """The rows of each run by its place; the file holds them in this order."""
        for rows in row_groups(path, f"table {table}"):
            of = rows["run_id"].to_numpy()
            starts = np.flatnonzero(np.append(True, of[1:] != of[:-1])[: len(of)])
            for start, end in itertools.pairwise([*starts.tolist(), len(of)]):
                yield self._place[of[start]], rows.slice(start, end - start)


def open_dataset(dataset: SweepDataset, runs: Sequence[SweepRun] = ()) -> JoinedTables:
    """A new or an existing sweep's folder, to which these runs may be added.

    Raises:
        InputError: the folder holds something else, or a sweep over other settings.
    """
    path = dataset.folder / "sweep.json"
    known = JoinedTables.of(dataset).run_ids
    every = list(dict.fromkeys([*known, *(run.run_id for run in runs)]))
    if len(every) > len(known) or not path.exists():
        own = {"schema_version": SCHEMA_VERSION, "kind": "sweep", "settings": dataset.keys}
        write_json(path, own | {"runs": every})
    return JoinedTables(dataset, every)


@contextmanager
def written_by_nobody_else(folder: Path) -> Iterator[None]:
    """For a `with` block; it ends with the process, however that does.

    Raises:
        InputError: another process is in such a block.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            others = "another sweep writes into it; wait for its end, or give another --output"
            raise InputError(f"{folder}: {others}") from error
        except OSError:  # a file system that knows no locks
            pass
        yield
    finally:
        os.close(handle)


def _described(path: Path, keys: tuple[str, ...]) -> tuple[str, ...]:
    try:
        found = _Description.model_validate(read_json(path, "description of a sweep"))
    except ValidationError as error:
        raise InputError(f"{path}: damaged or no description of a sweep") from error
    if found.schema_version != SCHEMA_VERSION:
        reads = f"this program adds to {SCHEMA_VERSION} alone; give it another --output"
        raise InputError(f"{path}: schema_version is {found.schema_version}, {reads}")
    if found.settings != keys:
        was, now = (", ".join(listed) or "seeds alone" for listed in (found.settings, keys))
        raise InputError(
            f"{path.parent}: is a sweep over {was}, this one is over {now}; "
            "tables of both would not fit together, give this one another --output"
        )
    return found.runs


def _waiting_or_none(path: Path) -> dict[str, pa.Table]:
    """Rows that wait; of a damaged file, which is told, none."""
    try:
        return read_waiting(path)
    except DamagedFileError as error:
        told = f"{error}; the same command makes its run again"
        warnings.warn(told, MendedWarning, stacklevel=2)
        return {}


def _write(path: Path, table_schema: pa.Schema, parts: Iterable[pa.Table]) -> None:
    """Write the rows of runs one after the other, whole runs in a row group."""
    buffer, group, n_rows = pa.BufferOutputStream(), list[pa.Table](), 0
    with pq.ParquetWriter(
        buffer, table_schema, compression="zstd", write_page_checksum=True
    ) as writer:
        for rows in parts:
            group.append(_fitted(rows, table_schema))
            n_rows += len(rows)
            if n_rows >= _ROWS_PER_GROUP:
                writer.write_table(pa.concat_tables(group).combine_chunks())
                group, n_rows = [], 0
        if group:
            writer.write_table(pa.concat_tables(group).combine_chunks())
    write_whole(path, lambda temporary: temporary.write_bytes(buffer.getvalue()))


def _fitted(rows: pa.Table, table_schema: pa.Schema) -> pa.Table:
    """With the columns of that schema; null where an earlier version had none of the name."""
    if rows.schema == table_schema:
        return rows
    columns = [
        rows[field.name].cast(field.type)
        if field.name in rows.column_names
        else pa.nulls(len(rows), field.type)
        for field in table_schema
    ]
    return pa.Table.from_arrays(columns, schema=table_schema)


def _digests(runs: pa.Table) -> dict[str, str]:
    """What rows of `runs` say by run, in few bytes: a sweep may have very many."""
    columns = [runs[name].to_pylist() for name in _TOLD]
    of_rows = map(_digest, zip(*columns, strict=True))
    return dict(zip(runs["run_id"].to_pylist(), of_rows, strict=True))


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()


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
