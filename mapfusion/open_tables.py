"""Tables that anybody may write: maps and logs, by this program, by pandas, or as CSV.

A file of another program needs no metadata and may leave out what has a default. Numbers may be of
any width, lists of any list type; in CSV a list is columns NAME_0, NAME_1, ... Without any height
(z_m and its covariances) data are planar. `experiments/docs/formats.md` lists all columns.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from mapfusion.errors import InputError
from mapfusion.storage import UNREADABLE, read_parquet, require_kind, text_attributes

_ABOUT, _DEFAULT = b"about", b"default"
HEIGHT = ("z_m", "cov_xz_m2", "cov_yz_m2", "cov_zz_m2")


def told(field: pa.Field, about: str, default: float | None = None) -> pa.Field:
    """A field with what it means, and with its value where a file lacks it."""
    metadata = {_ABOUT: about.encode()}
    if default is not None:
        metadata[_DEFAULT] = str(default).encode()
    return field.with_metadata(metadata)


def about(field: pa.Field) -> str:
    """What `told` was told of a field; empty where nothing was."""
    return (field.metadata or {}).get(_ABOUT, b"").decode()


def default_of(field: pa.Field) -> float | None:
    """What a file that lacks the column stands for; None where it must not."""
    text = (field.metadata or {}).get(_DEFAULT)
    return None if text is None else float(text)


def table_path(folder: Path, name: str) -> Path:
    """Where a folder keeps a table: NAME.csv if there is no NAME.parquet."""
    parquet, csv = (folder / f"{name}.{kind}" for kind in ("parquet", "csv"))
    return csv if csv.is_file() and not parquet.is_file() else parquet


def read_open_table(path: Path, table_schema: pa.Schema) -> tuple[pa.Table, dict[str, str]]:
    """Read a table whoever wrote it.

    Returns:
        The table with the columns of the schema, and its text attributes; `planar` is among them
        for a table without heights.

    Raises:
        InputError: it is missing, damaged, of another kind, lacks a column, or has an empty cell
            where a number must be.
    """
    kind = table_schema.metadata[b"mapfusion.kind"].decode()
    table = _read_csv(path, kind) if path.suffix == ".csv" else read_parquet(path, f"{kind} table")
    attributes = text_attributes(path, table)
    if "kind" in attributes and not _is_earlier(attributes, table_schema):
        require_kind(path, table, attributes, table_schema)
    names = table.column_names
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{path}: has two columns {', '.join(twice)}")
    planar = not set(HEIGHT) & set(names)
    found = {field.name: _column(path, table, field, planar) for field in table_schema}
    if missing := [name for name, values in found.items() if values is None]:
        remedy = f"add to this {kind} table what experiments/docs/formats.md says of them"
        raise InputError(f"{path}: has no column {', '.join(missing)}; {remedy}")
    if planar:
        attributes = {"planar": "true"} | attributes
    plain = [pa.field(field.name, field.type) for field in table_schema]
    return pa.table(found, schema=pa.schema(plain)), attributes


def _is_earlier(attributes: Mapping[str, str], table_schema: pa.Schema) -> bool:
    """Whether an earlier version of this program wrote it; later columns have defaults."""
    wanted = (
        table_schema.metadata[f"mapfusion.{key}".encode()] for key in ("kind", "schema_version")
    )
    kind, version = (text.decode() for text in wanted)
    found = attributes.get("schema_version", "")
    return attributes["kind"] == kind and found.isdecimal() and 0 < int(found) < int(version)


def _read_csv(path: Path, kind: str) -> pa.Table:
    if not path.is_file():
        raise InputError(f"{path}: no such file (expected a {kind} table)")
    try:
        table = pyarrow.csv.read_csv(pa.BufferReader(path.read_bytes()))
        _ = table.column_names  # decoded here first: they may be no UTF-8
        return table
    except UNREADABLE as error:
        raise InputError(f"{path}: not readable as CSV ({error})") from error


def _column(path: Path, table: pa.Table, field: pa.Field, planar: bool) -> pa.Array | None:
    """A column in the type of the schema; its default where it is not there, None without."""
    default = 0.0 if planar and field.name in HEIGHT else default_of(field)
    try:
        if pa.types.is_fixed_size_list(field.type):
            return _rows_of_numbers(table, field)
        if field.name not in table.column_names:
            filled = None if default is None else np.full(table.num_rows, default)
            return None if filled is None else pa.array(filled).cast(field.type)
        values = table.column(field.name).combine_chunks()
        is_number = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
        if not is_number and values.null_count < len(values):
            raise InputError(f"{path}: column {field.name} holds {values.type}, not numbers")
        is_float = pa.types.is_floating(field.type)
        if pa.types.is_floating(values.type) and not is_float:  # as pandas makes of gaps
            values = pa.array(values.to_numpy(zero_copy_only=False), from_pandas=True)
        empty = np.nan if is_float else default  # pandas stores NaN as an empty cell
        if values.null_count and empty is None:
            row = values.is_null().to_pylist().index(True)
            raise InputError(f"{path}: column {field.name} is empty in row {row}")
        values = values.cast(field.type)
        return values.fill_null(pa.scalar(empty, field.type)) if values.null_count else values
    except pa.ArrowException as error:
        reason = f"{' '.join(str(error).split())} (expected {field.type})"
        raise InputError(f"{path}: column {field.name}: {reason}") from error


def _call(name: str, values: pa.Array) -> pa.Array:
    return pc.call_function(name, [values])


def _is_as_it_should_be(table: pa.Table, field: pa.Field) -> bool:
    """Whether a table has a column of lists of the field's type, each number of them."""
    if field.name not in table.column_names:
        return False
    values = table.column(field.name).combine_chunks()
    return values.type == field.type and not values.null_count and not values.flatten().null_count


def _rows_of_numbers(table: pa.Table, field: pa.Field) -> pa.Array:
    """A column of lists, (N, k) of NaN where there is none; also of columns NAME_0, NAME_1, ..."""
    width, n = field.type.list_size, table.num_rows
    apart = [f"{field.name}_{i}" for i in range(width)]
    are_apart = set(apart) <= set(table.column_names)
    if not are_apart and _is_as_it_should_be(table, field):
        return table.column(field.name).combine_chunks()
    matrix = np.full((n, width), np.nan)
    if are_apart:
        for i, name in enumerate(apart):
            matrix[:, i] = table.column(name).cast(pa.float64()).fill_null(np.nan).to_numpy()
    elif field.name in table.column_names:
        values = table.column(field.name).combine_chunks()
        if values.null_count < n:
            lengths = _call("list_value_length", values).drop_null().unique().to_pylist()
            if lengths != [width]:
                raise pa.ArrowInvalid(f"lists of {sorted(lengths)} numbers")
            there = ~values.is_null().to_numpy(zero_copy_only=False)
            flat = _call("list_flatten", values).cast(pa.float64()).fill_null(np.nan)
            matrix[there] = flat.to_numpy(zero_copy_only=False).reshape(-1, width)
    flat = pa.array(matrix.ravel().astype(field.type.value_type.to_pandas_dtype()))
    return pa.FixedSizeListArray.from_arrays(flat, type=field.type)
