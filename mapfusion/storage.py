"""Tables on disk: Parquet with an explicit schema, a kind and a version, written whole."""

import errno
import os
import platform
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mapfusion.errors import InputError

_KIND = b"mapfusion.kind"
_VERSION = b"mapfusion.schema_version"
_PREFIX = "mapfusion."
_WRITER = re.compile(rf"\.{re.escape(platform.node())}-(?P<pid>\d+)\.[^.]+\.part$")


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: nobody sees half a file.

    The temporary name ends in `.part`, so that no pattern like `*.parquet` finds it, also where a
    killed process left it behind; see `remove_abandoned`. An OSError names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{path.name}.{platform.node()}-{os.getpid()}."
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=prefix, suffix=".part")
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:  # a full disk is told without a name, or with one that nobody knows
        if error.filename not in (None, name):
            raise
        reason = error.strerror or str(error)
        raise OSError(error.errno or errno.EIO, reason, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_abandoned(folder: Path) -> None:
    """Remove what `write_whole` left anywhere below a folder when its process was killed.

    Files of other machines, and of processes that live, stay.
    """
    for path in folder.rglob(".*.part"):
        writer = _WRITER.search(path.name)
        if writer and not _lives(int(writer["pid"])):
            path.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def require_writable(folder: Path) -> None:
    """Raise InputError, which says why, unless files can be put into a folder, there yet or not."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise InputError(f"{folder}: cannot be written ({there} is no folder)")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written (no right to write into {there})")


def schema(kind: str, version: int, fields: list[pa.Field]) -> pa.Schema:
    """A schema that carries its kind (what the table is) and its version."""
    return pa.schema(fields, metadata={_KIND: kind.encode(), _VERSION: str(version).encode()})


def write_table(
    path: Path,
    columns: Mapping[Any, Any],
    table_schema: pa.Schema,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write columns (arrays by name, all the schema names) with further text attributes."""
    metadata = dict(table_schema.metadata)
    metadata |= {f"{_PREFIX}{k}".encode(): v.encode() for k, v in (attributes or {}).items()}
    arrays = [_to_arrow(columns[field.name], field.type) for field in table_schema]
    table = pa.Table.from_arrays(arrays, schema=table_schema.with_metadata(metadata))
    write_whole(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))


def _to_arrow(values: Any, kind: pa.DataType) -> pa.Array:
    if pa.types.is_fixed_size_list(kind):
        matrix = np.ascontiguousarray(values).reshape(-1, kind.list_size)
        return pa.FixedSizeListArray.from_arrays(
            pa.array(matrix.ravel(), kind.value_type), kind.list_size
        )
    return pa.array(values, kind)


def read_table(path: Path, table_schema: pa.Schema) -> tuple[pa.Table, dict[str, str]]:
    """Read a table written by `write_table`.

    Returns:
        The table and its text attributes.

    Raises:
        InputError: the file is missing, damaged, of another kind or version, or lacks columns.
    """
    kind = table_schema.metadata[_KIND].decode()
    version = table_schema.metadata[_VERSION].decode()
    if not path.is_file():
        raise InputError(f"{path}: no such file (expected a {kind} table)")
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: damaged or not a Parquet file ({reason})") from error
    metadata = table.schema.metadata or {}
    found_kind = metadata.get(_KIND, b"none").decode()
    if found_kind != kind:
        raise InputError(f"{path}: kind is {found_kind}, expected {kind}")
    found_version = metadata.get(_VERSION, b"none").decode()
    if found_version != version:
        raise InputError(f"{path}: schema_version is {found_version}, this program reads {version}")
    if not table.schema.equals(table_schema, check_metadata=False):
        expected = ", ".join(f"{f.name}: {f.type}" for f in table_schema)
        raise InputError(f"{path}: columns are not those of {kind} ({expected})")
    attributes = {
        k.decode().removeprefix(_PREFIX): v.decode()
        for k, v in metadata.items()
        if k.decode().startswith(_PREFIX)
    }
    return table, attributes


def column(table: pa.Table, name: str) -> np.ndarray:
    """One column as an array: (N,), or (N, k) for a column of fixed-size lists."""
    values = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(values.type):
        return values.flatten().to_numpy(zero_copy_only=False).reshape(-1, values.type.list_size)
    return values.to_numpy(zero_copy_only=False)


def columns(table: pa.Table, names: Sequence[str]) -> np.ndarray:
    """Several columns as one array (N, len(names))."""
    return np.stack([column(table, name) for name in names], -1)


def named_columns(names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """The inverse of `columns`."""
    return dict(zip(names, values.T, strict=True))


def float_fields(names: Sequence[str]) -> list[pa.Field]:
    """Schema fields of columns of numbers."""
    return [pa.field(name, pa.float64()) for name in names]


COVARIANCE_FIELDS = ["cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"]
POSITION_FIELDS = ["x_m", "y_m", "z_m"]
POSE_FIELDS = ["x_m", "y_m", "theta_rad"]
_UPPER = np.triu_indices(3)


def point_columns(position_m: np.ndarray, covariance_m2: np.ndarray) -> dict[str, np.ndarray]:
    """Positions (N, 3) and covariances (N, 3, 3) as the nine flat columns they are stored in."""
    upper = covariance_m2[:, _UPPER[0], _UPPER[1]]
    return named_columns(POSITION_FIELDS, position_m) | named_columns(COVARIANCE_FIELDS, upper)


def points_from(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of `point_columns`."""
    upper = columns(table, COVARIANCE_FIELDS)
    covariance = np.empty((len(upper), 3, 3))
    covariance[:, _UPPER[0], _UPPER[1]] = covariance[:, _UPPER[1], _UPPER[0]] = upper
    return columns(table, POSITION_FIELDS), covariance


def point_fields() -> list[pa.Field]:
    """Schema fields of `point_columns`."""
    return float_fields(POSITION_FIELDS + COVARIANCE_FIELDS)
