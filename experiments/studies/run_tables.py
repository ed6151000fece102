"""Tables of many runs as one: result folders of `run` and of `sweep`.

Files are read some at a time and only in the columns asked for, so that whoever reduces each batch
before going on holds that much in memory, however many runs there are.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa

from experiments.evaluation import tables
from experiments.evaluation.alignment_summary import RUN_KEYS, setting_columns
from experiments.evaluation.result_files import read_scenario, require_tables
from experiments.studies.sweep_tables import SCHEMA_VERSION
from mapfusion.errors import InputError
from mapfusion.files import read_json, require_version, row_groups, text_attributes

_VERSION = b"mapfusion.schema_version"
_TOLD = ("status", "reason")  # of each run of a sweep
# Reducing costs a call what 10 000 rows cost; so many rows of `errors` are some 15 MB.
BATCH_ROWS = 100_000


class RunPath(NamedTuple):
    """A result folder or a table of runs; a run's columns where the rows lack them.

    Of a sweep that goes on, rows of all but the `finished` runs are not complete, and left out.
    """

    path: Path
    run: dict[str, Any]
    finished: frozenset[str] | None = None


@dataclass(frozen=True)
class Runs:
    """The runs of some result and sweep folders."""

    results: tuple[RunPath, ...]
    sweeps: tuple[Path, ...]

    def files(self, table: str) -> list[RunPath]:
        """The files of one table in a fixed order; none where no run has it."""
        paths = [RunPath(tables.table_path(path, table), run) for path, run, _ in self.results]
        found = [file for file in paths if file.path.is_file()]
        for sweep in self.sweeps:
            finished = self._finished(sweep)
            if finished is None or finished:
                found += [RunPath(path, {}, finished) for path in _whole_files(sweep / table)]
        return found

    def _finished(self, sweep: Path) -> frozenset[str] | None:
        """The runs of a sweep that are in all its tables; None where nothing says so."""
        told = self._told[self._told["sweep"] == str(sweep)]
        is_finished = told["status"] == "finished"
        return None if told.empty else frozenset(told.loc[is_finished, "run_id"])

    def has(self, table: str) -> bool:
        """Whether any run has this table."""
        return bool(self.files(table))

    def batches(
        self, table: str, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
    ) -> Iterator[pd.DataFrame]:
        """Rows of a few whole runs at a time, about `BATCH_ROWS`; see `read`."""
        if not self.has(table):
            where = ", ".join(map(str, [*(result.path for result in self.results), *self.sweeps]))
            what = f"no table {table} (expected the results of `run` or `sweep`)"
            raise InputError(f"{where}: {what}")
        seen: dict[str, RunPath] = {}
        batch: list[pd.DataFrame] = []
        for file, rows in self._pieces(table, columns, optional):
            for run_id in rows["run_id"].unique():
                if seen.setdefault(run_id, file) is not file:
                    also = f"run {run_id} is also in {seen[run_id].path}"
                    raise InputError(f"{file.path}: {also}")
            batch.append(rows)
            if sum(map(len, batch)) >= BATCH_ROWS:
                yield pd.concat(batch, ignore_index=True)
                batch = []
        if batch:
            yield pd.concat(batch, ignore_index=True)

    def _pieces(
        self, table: str, columns: Sequence[str] | None, optional: Sequence[str]
    ) -> Iterator[tuple[RunPath, pd.DataFrame]]:
        for file in self.files(table):
            for rows in _read(file, table, columns, optional):
                yield file, rows

    def read(
        self, table: str, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
    ) -> pd.DataFrame:
        """One table of all runs.

        Args:
            table: its name (see experiments.evaluation.tables).
            columns: of the table; all by default.
            optional: further columns, NaN for runs made before these were introduced.

        Returns:
            Columns run_id, scenario, seed, then what a sweep varied (one text column a setting),
            then those of the table.

        Raises:
            InputError: no such table, a damaged file, one made by a newer program, a missing
                column, or a run given twice.
        """
        return pd.concat(list(self.batches(table, columns, optional)), ignore_index=True)

    @cached_property
    def described(self) -> pd.DataFrame:
        """All runs that have errors or paths: run_id, scenario, seed, and what a sweep varied."""
        tables_there = filter(self.has, ("errors", "robots"))
        every = (rows for table in tables_there for rows in self.batches(table, ["iteration"]))
        parts = [rows.drop(columns="iteration").drop_duplicates("run_id") for rows in every]
        none = pd.DataFrame(columns=pd.Index(RUN_KEYS))
        return pd.concat(parts).drop_duplicates("run_id") if parts else none

    @cached_property
    def _told(self) -> pd.DataFrame:
        """The tables `runs` of all sweeps that have one, with the sweep's folder."""
        parts = [
            rows.assign(sweep=str(sweep))
            for sweep in self.sweeps
            for path in _whole_files(sweep / "runs")
            for rows in _read(RunPath(path, {}), "runs", _TOLD, ())
        ]
        none = pd.DataFrame(columns=["sweep", *RUN_KEYS, *_TOLD])
        return pd.concat(parts, ignore_index=True) if parts else none

    @property
    def failed(self) -> pd.DataFrame:
        """Runs of sweeps that failed: run_id, scenario, seed, reason."""
        is_failed = self._told["status"] == "failed"
        return self._told.loc[is_failed, [*RUN_KEYS, "reason"]].reset_index(drop=True)


def find_runs(paths: Path | Sequence[Path]) -> Runs:
    """What result and sweep folders lie at these paths.

    Raises:
        InputError: a path is neither, or its description is damaged.
    """
    results, sweeps = [], []
    for path in [paths] if isinstance(paths, Path) else paths:
        if (path / "sweep.json").is_file():
            about = path / "sweep.json"
            require_version(about, read_json(about, "description of a sweep"), SCHEMA_VERSION)
            sweeps.append(path)
        elif (path / "scenario.json").is_file():
            require_tables(path)
            results.append(RunPath(path, _run_of(path / "scenario.json")))
        else:
            what = "no such folder" if not path.is_dir() else "no scenario.json and no sweep.json"
            expected = "a result folder of `run` or a folder of `sweep`"
            raise InputError(f"{path}: {what} (expected {expected})")
    return Runs(tuple(results), tuple(sweeps))


def match_names(frame: pd.DataFrame, apart_from: Collection[str] = ()) -> pd.Series:
    """What a run is matched by: scenario, seed, settings but for those named."""
    names = frame["scenario"].astype(str) + " seed " + frame["seed"].astype(str)
    for column in sorted(set(setting_columns(frame)).difference(apart_from)):
        names = names + " " + column + "=" + frame[column].astype(str)
    return names


def _whole_files(folder: Path) -> list[Path]:
    """The tables in a folder; names with a dot in front are files still being written."""
    return sorted(folder.glob("[!.]*.parquet"))


def _run_of(path: Path) -> dict[str, Any]:
    """The run's columns, by its scenario: the folder may have been renamed since."""
    found = read_scenario(path)
    name, seed = found["name"], int(found["seed"])
    return {"run_id": f"{name}-{seed}", "scenario": name, "seed": seed}


def _read(
    file: RunPath, table: str, columns: Sequence[str] | None, optional: Sequence[str]
) -> Iterator[pd.DataFrame]:
    """Rows of whole runs, as many at a time as were written together."""

    def wanted(found: pa.Schema) -> Sequence[str]:
        _require_readable(file.path, table, text_attributes(file.path, found.empty_table()))
        of_run = () if file.run else RUN_KEYS
        missing = [name for name in (*of_run, *(columns or ())) if name not in found.names]
        if missing:
            raise InputError(f"{file.path}: has no column {', '.join(missing)} (a table {table})")
        if columns is None:
            return found.names
        own = set(tables.ALL[table].names) if table in tables.ALL else set(_TOLD)
        leading = [] if file.run else takewhile(lambda name: name not in own, found.names)
        there = (name for name in optional if name in found.names)
        return list(dict.fromkeys([*leading, *columns, *there]))

    for piece in row_groups(file.path, f"table {table}", wanted):
        rows = piece.to_pandas()
        for place, (name, value) in enumerate(file.run.items()):
            rows.insert(place, name, value)
        if file.finished is not None:
            is_finished = rows["run_id"].isin(file.finished)
            rows = rows if is_finished.all() else rows[is_finished]
        yield rows.assign(**{name: float("nan") for name in optional if name not in rows})


def _require_readable(path: Path, table: str, attributes: Mapping[str, str]) -> None:
    """The right table, and none of a newer program; older ones may lack columns, no more."""
    kind = attributes.get("kind", table)
    if kind.rpartition(".")[2] != table:
        raise InputError(f"{path}: kind is {kind}, expected {table}")
    if kind != f"result.{table}":  # a sweep has a version of its own
        return
    known = int(tables.ALL[table].metadata[_VERSION])
    version = attributes.get("schema_version", "0")
    if not version.isdecimal() or int(version) > known:
        raise InputError(f"{path}: schema_version is {version}, this program reads up to {known}")
