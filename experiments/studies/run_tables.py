"""Tables of many runs, read from result folders of `run` and folders of `sweep`.

Files are read in batches and only in the requested columns. If each batch is reduced before the
next one is read, memory does not grow with the number of runs.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa

from experiments.evaluation import tables
from experiments.evaluation.alignment_criteria import RUN_KEYS, setting_columns
from experiments.evaluation.tables import read_provenance, read_scenario, require_tables
from mapfusion.errors import InputError
from mapfusion.files import read_json, require_version, row_groups, text_attributes

# Version of a sweep's files: since 3 their row groups are those of `joined_tables`.
SWEEP_SCHEMA_VERSION = 3
_VERSION = b"mapfusion.schema_version"
_STATUS = ("status", "reason")  # columns of `runs` of a sweep
# One call to reduce a batch takes as long as 10 000 rows; a batch of `errors` is about 15 MB.
BATCH_ROWS = 100_000


class RunPath(NamedTuple):
    """Result folder, or file of a table.

    Attributes:
        path: folder or file.
        run: columns that describe the run, for files that lack them.
        finished: ids of the finished runs of a sweep; rows of other runs are incomplete and left
            out. None if the sweep does not list its runs.
    """

    path: Path
    run: dict[str, Any]
    finished: frozenset[str] | None = None


@dataclass(frozen=True)
class Runs:
    """Runs of result folders and sweep folders.

    Attributes:
        results: result folders.
        sweeps: folders of sweeps.
        only: settings and values that the runs of sweeps must have.
    """

    results: tuple[RunPath, ...]
    sweeps: tuple[Path, ...]
    only: tuple[tuple[str, str], ...] = ()

    def files(self, table: str) -> list[RunPath]:
        """Return the files of one table in a fixed order."""
        paths = [RunPath(tables.table_path(path, table), run) for path, run, _ in self.results]
        found = [file for file in paths if file.path.is_file()]
        for sweep in self.sweeps:
            run_rows = self._run_rows[self._run_rows["sweep"] == str(sweep)]
            finished = None  # an earlier version did not write `runs`
            if len(run_rows) or self.only:
                finished = frozenset(run_rows.loc[run_rows["status"] == "finished", "run_id"])
            if finished is None or finished:
                found += [RunPath(path, {}, finished) for path in _whole_files(sweep / table)]
        return found

    def has(self, table: str) -> bool:
        """Return True if any run has this table."""
        return bool(self.files(table))

    def batches(
        self, table: str, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
    ) -> Iterator[pd.DataFrame]:
        """Yield rows of whole runs, about `BATCH_ROWS` at a time; see `read`."""
        if not self.has(table):
            where = ", ".join(map(str, [*(result.path for result in self.results), *self.sweeps]))
            what = f"no table {table} (expected the results of `run` or `sweep`)"
            raise InputError(f"{where}: {what}")
        seen: dict[str, RunPath] = {}
        batch: list[pd.DataFrame] = []
        pieces = (
            (f, rows) for f in self.files(table) for rows in _read(f, table, columns, optional)
        )
        for file, rows in pieces:
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

    def read(
        self, table: str, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
    ) -> pd.DataFrame:
        """Return one table of all runs.

        Args:
            table: name of the table (see experiments.evaluation.tables).
            columns: columns of the table; all by default.
            optional: further columns, NaN for runs of versions that did not have them.

        Returns:
            Columns run_id, scenario, seed, then one text column per setting that a sweep varied,
            then those of the table.

        Raises:
            InputError: no run has the table, a file is damaged or was written by a newer version,
                a column is missing, or a run was given twice.
        """
        return pd.concat(list(self.batches(table, columns, optional)), ignore_index=True)

    @cached_property
    def described(self) -> pd.DataFrame:
        """Runs with errors or paths: run_id, scenario, seed, and the settings of a sweep."""
        tables_there = filter(self.has, ("errors", "robots"))
        every = (rows for table in tables_there for rows in self.batches(table, ["iteration"]))
        parts = [rows.drop(columns="iteration").drop_duplicates("run_id") for rows in every]
        none = pd.DataFrame(columns=pd.Index(RUN_KEYS))
        return pd.concat(parts).drop_duplicates("run_id") if parts else none

    @cached_property
    def _run_rows(self) -> pd.DataFrame:
        """Tables `runs` of all sweeps, with the sweep's folder."""
        parts = [
            rows.assign(sweep=str(sweep))
            for sweep in self.sweeps
            for path in _whole_files(sweep / "runs")
            for rows in _read(RunPath(path, {}), "runs", _STATUS, ("renderer",))
        ]
        none = pd.DataFrame(columns=["sweep", *RUN_KEYS, *_STATUS, "renderer"])
        rows = pd.concat(parts, ignore_index=True) if parts else none
        for setting, value in self.only:
            rows = rows[rows[setting] == value] if setting in rows else rows.iloc[:0]
        return rows

    @cached_property
    def renderers(self) -> dict[str, str]:
        """Name of the renderer of each run; "unknown" for runs that do not tell it."""
        of_sweeps = self._run_rows[self._run_rows["renderer"].notna()]
        found = dict.fromkeys(self.described["run_id"], "unknown")
        found |= dict(zip(of_sweeps["run_id"], of_sweeps["renderer"], strict=True))
        for result in self.results:
            about = result.path / "provenance.json"
            if about.is_file():
                name = read_provenance(about).get("renderer", "unknown")
                found[result.run["run_id"]] = str(name)
        return found

    @property
    def failed(self) -> pd.DataFrame:
        """Failed runs of sweeps: run_id, scenario, seed, reason."""
        is_failed = self._run_rows["status"] == "failed"
        return self._run_rows.loc[is_failed, [*RUN_KEYS, "reason"]].reset_index(drop=True)


def find_runs(paths: Path | Sequence[Path]) -> Runs:
    """Return the runs of result folders and sweep folders.

    Raises:
        InputError: a path is neither, or its description is damaged.
    """
    results, sweeps = [], []
    for path in [paths] if isinstance(paths, Path) else paths:
        if (path / "sweep.json").is_file():
            about = path / "sweep.json"
            require_version(about, read_json(about, "description of a sweep"), SWEEP_SCHEMA_VERSION)
            sweeps.append(path)
        elif (path / "scenario.json").is_file():
            require_tables(path)
            found = read_scenario(path / "scenario.json")  # the folder may have been renamed
            name, seed = found["name"], int(found["seed"])
            run = {"run_id": f"{name}-{seed}", "scenario": name, "seed": seed}
            results.append(RunPath(path, run))
        else:
            what = "no such folder" if not path.is_dir() else "no scenario.json and no sweep.json"
            expected = "a result folder of `run` or a folder of `sweep`"
            raise InputError(f"{path}: {what} (expected {expected})")
    return Runs(tuple(results), tuple(sweeps))


def match_names(frame: pd.DataFrame, apart_from: Collection[str] = ()) -> pd.Series:
    """Return the names that runs are matched by: scenario, seed and settings, except some."""
    names = frame["scenario"].astype(str) + " seed " + frame["seed"].astype(str)
    for column in sorted(set(setting_columns(frame)).difference(apart_from)):
        names = names + " " + column + "=" + frame[column].astype(str)
    return names


def _whole_files(folder: Path) -> list[Path]:
    """Return the tables in a folder; a name that begins with a dot is an unfinished file."""
    return sorted(folder.glob("[!.]*.parquet"))


def _read(
    file: RunPath, table: str, columns: Sequence[str] | None, optional: Sequence[str]
) -> Iterator[pd.DataFrame]:
    """Yield rows of whole runs, one row group at a time."""

    def wanted(found: pa.Schema) -> Sequence[str]:
        attributes = text_attributes(file.path, found.empty_table())
        kind = attributes.get("kind", table)
        if kind.rpartition(".")[2] != table:
            raise InputError(f"{file.path}: kind is {kind}, expected {table}")
        if kind == f"result.{table}":  # tables of sweeps have their own version
            known = int(tables.ALL[table].metadata[_VERSION])
            version = attributes.get("schema_version", "0")
            if not version.isdecimal() or int(version) > known:
                reads = f"this program reads up to {known}"
                raise InputError(f"{file.path}: schema_version is {version}, {reads}")
        of_run = () if file.run else RUN_KEYS
        missing = [name for name in (*of_run, *(columns or ())) if name not in found.names]
        if missing:
            raise InputError(f"{file.path}: has no column {', '.join(missing)} (a table {table})")
        if columns is None:
            return found.names
        own = set(tables.ALL[table].names) if table in tables.ALL else set(_STATUS)
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
