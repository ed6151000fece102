"""Tables of many runs as one: result folders of `run`, and folders of `sweep`.

Files are read run by run and only in the columns asked for, so that whoever reduces each run before
going on holds one run in memory, however many there are.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds

from experiments.judge import tables
from experiments.judge.judged_maps import RUN_KEYS, setting_columns
from mapfusion.errors import InputError

_KIND, _VERSION = b"mapfusion.kind", b"mapfusion.schema_version"
_DAMAGED = (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowKeyError, OSError)


@dataclass(frozen=True)
class _RunFile:
    """One run's rows of a table. Results carry their run's name, sweeps say it in the rows."""

    path: Path
    run: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ResultFolder:
    """One result folder of `run`."""

    folder: Path
    scenario: str
    seed: int

    @property
    def run(self) -> dict[str, Any]:
        """The run's columns. The folder was named so by `run`; it may have been renamed since."""
        run_id = f"{self.scenario}-{self.seed}"
        return {"run_id": run_id, "scenario": self.scenario, "seed": self.seed}


@dataclass(frozen=True)
class Runs:
    """The runs of some result and sweep folders.

    Attributes:
        results: result folders.
        sweeps: sweep folders.
    """

    results: tuple[ResultFolder, ...]
    sweeps: tuple[Path, ...]

    def files(self, table: str) -> list[_RunFile]:
        """The files of one table, one a run, in a fixed order; none where no run has it."""
        found = [
            _RunFile(path, result.run)
            for result in self.results
            if (path := tables.table_path(result.folder, table)).is_file()
        ]
        for sweep in self.sweeps:
            finished = self._finished.get(sweep)
            found += [
                _RunFile(path)
                for path in _whole_files(sweep / table)
                if finished is None or path.stem in finished
            ]
        return found

    def has(self, table: str) -> bool:
        """Whether any run has this table."""
        return bool(self.files(table))

    def each(
        self, table: str, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
    ) -> Iterator[pd.DataFrame]:
        """Each run's rows; see `read`."""
        if not self.has(table):
            where = ", ".join(str(path) for path in self.folders)
            what = f"no table {table} (expected the results of `run` or `sweep`)"
            raise InputError(f"{where}: {what}")
        seen: dict[str, Path] = {}
        for file in self.files(table):
            rows = _read(file, table, columns, optional)
            for run_id in rows["run_id"].unique():
                if run_id in seen:
                    raise InputError(f"{file.path}: run {run_id} is also in {seen[run_id]}")
                seen[run_id] = file.path
            yield rows

    def read(
        self, table: str, columns: Sequence[str] | None = None, optional: Sequence[str] = ()
    ) -> pd.DataFrame:
        """One table of all runs.

        Args:
            table: its name (see experiments.judge.tables).
            columns: of the table; all by default.
            optional: further columns, NaN for runs made before these were introduced.

        Returns:
            Columns run_id, scenario, seed, then what a sweep varied (one text column a setting),
            then those of the table.

        Raises:
            InputError: no such table, a damaged file, one made by a newer program, a missing
                column, or a run given twice.
        """
        return pd.concat(list(self.each(table, columns, optional)), ignore_index=True)

    @property
    def folders(self) -> list[Path]:
        """All folders, results first."""
        return [result.folder for result in self.results] + list(self.sweeps)

    @cached_property
    def names(self) -> set[str]:
        """All runs that have errors or paths, by scenario, seed and settings."""
        found: set[str] = set()
        for table in ("errors", "robots"):
            if self.has(table):
                for rows in self.each(table, ["iteration"]):
                    found |= set(match_names(rows.drop_duplicates("run_id")))
        return found

    @cached_property
    def _said_of_runs(self) -> dict[Path, pd.DataFrame]:
        """The table `runs` of each sweep that has one."""
        said = {}
        for sweep in self.sweeps:
            parts = [
                _read(_RunFile(path), "runs", ["status", "reason"], ())
                for path in _whole_files(sweep / "runs")
            ]
            if parts:
                said[sweep] = pd.concat(parts, ignore_index=True)
        return said

    @cached_property
    def _finished(self) -> dict[Path, set[str]]:
        """Runs of each sweep whose rows are complete; of a sweep that goes on, others are not."""
        return {
            sweep: set(rows.loc[rows["status"] == "finished", "run_id"])
            for sweep, rows in self._said_of_runs.items()
        }

    @property
    def failed(self) -> pd.DataFrame:
        """Runs of sweeps that failed: run_id, scenario, seed, reason."""
        columns = [*RUN_KEYS, "reason"]
        parts = [
            rows.loc[rows["status"] == "failed", columns] for rows in self._said_of_runs.values()
        ]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def find_runs(paths: Path | Sequence[Path]) -> Runs:
    """What result and sweep folders lie at these paths.

    Raises:
        InputError: a path is neither, or its description is damaged.
    """
    results, sweeps = [], []
    for path in [paths] if isinstance(paths, Path) else paths:
        if (path / "sweep.json").is_file():
            sweeps.append(path)
        elif (path / "scenario.json").is_file():
            results.append(_result(path))
        else:
            what = "no such folder" if not path.is_dir() else "no scenario.json and no sweep.json"
            raise InputError(
                f"{path}: {what} (expected a result folder of `run` or a folder of `sweep`)"
            )
    return Runs(tuple(results), tuple(sweeps))


def match_names(frame: pd.DataFrame) -> pd.Series:
    """What a run is matched by: scenario, seed, settings."""
    names = frame["scenario"].astype(str) + " seed " + frame["seed"].astype(str)
    for column in sorted(setting_columns(frame)):
        names = names + " " + column + "=" + frame[column].astype(str)
    return names


def _whole_files(folder: Path) -> list[Path]:
    """The tables in a folder; names with a dot in front are files still being written."""
    return [path for path in sorted(folder.glob("*.parquet")) if not path.name.startswith(".")]


def _result(folder: Path) -> ResultFolder:
    path = folder / "scenario.json"
    try:
        scenario = json.loads(path.read_text(encoding="utf-8"))
        name, seed = str(scenario["name"]), int(scenario["seed"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a resolved scenario with name and seed ({error})") from error
    return ResultFolder(folder, name, seed)


def _read(
    file: _RunFile, table: str, columns: Sequence[str] | None, optional: Sequence[str]
) -> pd.DataFrame:
    try:
        data = ds.dataset(file.path, format="parquet")
        _require_readable(file.path, table, data.schema)
        wanted = _wanted(file, table, data.schema.names, columns, optional)
        rows = data.to_table(columns=wanted).to_pandas()
    except _DAMAGED as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{file.path}: damaged or not a Parquet file ({reason})") from error
    for place, (name, value) in enumerate(file.run.items()):
        rows.insert(place, name, value)
    for name in optional:
        if name not in rows:
            rows[name] = float("nan")
    return rows


def _wanted(
    file: _RunFile,
    table: str,
    found: Sequence[str],
    columns: Sequence[str] | None,
    optional: Sequence[str],
) -> list[str]:
    """The columns to read of those found: the run's, then the table's."""
    own = set(tables.ALL[table].names) if table in tables.ALL else {"status", "reason"}
    leading = [] if file.run else list(takewhile(lambda name: name not in own, found))
    required = [] if file.run else list(RUN_KEYS)
    missing = [name for name in [*required, *(columns or [])] if name not in found]
    if missing:
        raise InputError(f"{file.path}: has no column {', '.join(missing)} (a table {table})")
    if columns is None:
        return list(found)
    chosen = [*leading, *columns, *(name for name in optional if name in found)]
    return list(dict.fromkeys(chosen))


def _require_readable(path: Path, table: str, schema: pa.Schema) -> None:
    """The right table, and none of a newer program; older ones may lack columns, no more."""
    metadata = schema.metadata or {}
    kind = metadata.get(_KIND, table.encode()).decode()
    if kind.rpartition(".")[2] != table:
        raise InputError(f"{path}: kind is {kind}, expected {table}")
    if kind != f"result.{table}":  # a sweep has a version of its own
        return
    known = int(tables.ALL[table].metadata[_VERSION])
    version = metadata.get(_VERSION, b"0").decode()
    if not version.isdigit() or int(version) > known:
        raise InputError(f"{path}: schema_version is {version}, this program reads up to {known}")
