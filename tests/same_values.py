"""Do two folders of tables hold the same values? `python -m tests.same_values BEFORE AFTER`.

For result folders, for sweeps, and for folders of them: every Parquet table below is compared
value by value, NaN equal to NaN. Not compared: times, images, scenario.json, and what names the
source (the store and its keys, a run's id). Run by hand before and after a change that shall
change no result. Exit code 1 if any table differs or stands on one side only.
"""

import argparse
import hashlib
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

TIMES = {"timings", "aligner_timings", "run_times"}
STORE = "store"
ABOUT_THE_SOURCE = {"run_id", "stages", "source_hash", "libraries", "renderer"}


@dataclass(frozen=True)
class Values:
    """A table's columns as text that is exact (-0.0 is not 0.0) and knows one NaN."""

    columns: Mapping[str, list[str]]

    @property
    def sha256(self) -> str:
        """Hash of all columns and values, the same whatever the order of the columns."""
        digest = hashlib.sha256()
        for name, values in sorted(self.columns.items()):
            digest.update("\n".join([name, *values, ""]).encode())
        return digest.hexdigest()

    def difference(self, other: "Values") -> str | None:
        """Return the first difference in words, or None."""
        found = [
            f"column {name} only {side}"
            for side, these, those in (("before", self, other), ("after", other, self))
            for name in these.columns
            if name not in those.columns
        ]
        for name in self.columns:
            if name in other.columns:
                found += _first_change(name, self.columns[name], other.columns[name])
        return "; ".join(found) or None


def _first_change(name: str, before: list[str], after: list[str]) -> list[str]:
    if len(before) != len(after):
        return [f"{name}: {len(before)} rows before, {len(after)} after"]
    for row, (old, new) in enumerate(zip(before, after, strict=True)):
        if old != new:
            n = sum(a != b for a, b in zip(before, after, strict=True))
            return [f"{name}: {n} of {len(before)} rows, first row {row}: {old} -> {new}"]
    return []


def read_values(path: Path) -> Values:
    """The values of a Parquet file, elapsed times and what names the source apart."""
    table = pq.ParquetFile(path).read()
    return Values(
        {
            name: _exact(column)
            for name, column in zip(table.column_names, table.columns, strict=True)
            if "elapsed" not in name and name not in ABOUT_THE_SOURCE
        }
    )


def _exact(column: pa.ChunkedArray) -> list[str]:
    if pa.types.is_floating(column.type):
        column = column.fill_null(math.nan)  # whoever reads the table sees NaN
    return [repr(value) for value in column.to_pylist()]


def read_folder(folder: Path) -> dict[str, Values]:
    """All tables below a folder that must be the same in every run, by their relative path."""
    found = {}
    for path in sorted(folder.rglob("*.parquet")):
        relative = path.relative_to(folder)
        if STORE not in relative.parts and not TIMES & {path.stem, path.parent.name}:
            found[str(relative)] = read_values(path)
    return found


def same_values(before: Path, after: Path) -> bool:
    """Compare two folders and print one line a table; returns whether all are the same."""
    first, second = read_folder(before), read_folder(after)
    for folder, found in ((before, first), (after, second)):
        if not found:
            raise SystemExit(f"{folder}: holds no tables")
    same = True
    for name in sorted(first.keys() | second.keys()):
        if name not in second or name not in first:
            difference = f"only {'before' if name in first else 'after'}"
        else:
            difference = first[name].difference(second[name])
        hashes = {side[name].sha256: None for side in (first, second) if name in side}
        verdict = "equal" if difference is None else f"DIFFERS {difference}"
        sys.stdout.write(f"{' -> '.join(hashes)}  {name}  {verdict}\n")
        same = same and difference is None
    sys.stdout.write(f"{len(first)} tables before, {len(second)} after: ")
    sys.stdout.write("all the same\n" if same else "NOT the same\n")
    return same


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.same_values", description=__doc__)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    folders = parser.parse_args()
    sys.exit(0 if same_values(folders.before, folders.after) else 1)


if __name__ == "__main__":
    main()
