"""Tables on disk as pandas frames, each by its schema."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from mapfusion.storage import read_table, write_table

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
    return table.to_pandas()
