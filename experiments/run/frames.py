"""Tables on disk as pandas frames, each by its schema."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from mapfusion.errors import DamagedFileError
from mapfusion.sealed import read_sealed, tell_unsealed
from mapfusion.storage import UNREADABLE, read_table, write_table

TEXT, INT, FLOAT, BOOL = pa.string(), pa.int32(), pa.float64(), pa.bool_()


def fields(**types: pa.DataType) -> list[pa.Field]:
    """Schema fields by name."""
    return [pa.field(name, kind) for name, kind in types.items()]


def write_rows(
    path: Path,
    table_schema: pa.Schema,
    rows: pd.DataFrame | list[dict[str, Any]],
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write rows as a table of that schema, with further text attributes."""
    frame = pd.DataFrame(rows, columns=pd.Index(table_schema.names))
    columns = {column: frame[column].to_numpy() for column in frame}
    write_table(path, columns, table_schema, attributes)


def read_rows(path: Path, table_schema: pa.Schema) -> pd.DataFrame:
    """Read a table of that schema; raises InputError that names the file."""
    table, _ = read_table(path, table_schema)
    return table.to_pandas(use_threads=False)


def at_iteration(rows: pd.DataFrame, iteration: int) -> pd.DataFrame:
    """The rows of one iteration, of a table that is ordered by it."""
    return rows.iloc[slice(*rows["iteration"].searchsorted([iteration, iteration + 1]))]


def records(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows by column; pandas' own takes ten times as long for a few rows of many columns."""
    names = rows.columns.tolist()
    columns = (rows[name].tolist() for name in names)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def row_groups(
    path: Path, what: str, choose: Callable[[pa.Schema], Sequence[str] | None] = lambda _: None
) -> Iterator[pa.Table]:
    """Any Parquet table, one row group after the other; one without rows as one empty piece.

    Args:
        path: of the file, whose bytes are checked.
        what: it is, for messages.
        choose: which columns, by the schema that the file has; None for all.

    Raises:
        DamagedFileError: the file is missing or damaged.
    """
    source = pa.BufferReader(data := read_sealed(path, what))
    try:
        file = pq.ParquetFile(source, page_checksum_verification=True)
        found, n_groups = file.schema_arrow, file.num_row_groups
    except UNREADABLE as error:
        raise _damaged(path, error) from error
    tell_unsealed(path, data)
    names = choose(found)
    if not n_groups:
        empty = found.empty_table()
        yield empty if names is None else empty.select(names)
    for number in range(n_groups):
        try:
            piece = file.read_row_group(number, names)
        except UNREADABLE as error:
            raise _damaged(path, error) from error
        yield piece if names is None else piece.select(names)


def _damaged(path: Path, error: Exception) -> DamagedFileError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return DamagedFileError(path, f"damaged or not a Parquet file ({reason})")
