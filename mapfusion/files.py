"""Files on disk: written whole, with an explicit schema, a kind and a version.

Damage to a file is detected when it is read. A Parquet table has a checksum for each page of
values. Its footer has none, but Arrow writes the schema twice into the footer, and both copies must
agree. A JSON object contains the SHA-256 of its file.
"""

import base64
import errno
import hashlib
import itertools
import json
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mapfusion.errors import DamagedFileError, InputError

_KIND = b"mapfusion.kind"
_VERSION = b"mapfusion.schema_version"
_ABOUT, _DEFAULT = b"about", b"default"  # of a field
_PREFIX = "mapfusion."
_OURS = _PREFIX.encode()
_ARROW_SCHEMA = b"ARROW:schema"
_FOOTER_END = 8  # bytes after the footer of Parquet: its length, and the magic number
# Writer that stores the schema twice and columns one after the other: Arrow's C++ library.
_ARROW = "parquet-cpp-arrow"
DIGEST = "mapfusion.sha256"  # first field of a JSON object: the SHA-256 of the file with zeros here
_NO_DIGEST = "0" * 64
# Errors that Arrow raises for unreadable bytes, directly or through Python code that it calls.
UNREADABLE = (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError)
PART = ".part"
_WRITER = re.compile(rf"\.{re.escape(platform.node())}-(?P<pid>\d+)\.[^.]+\.part$")


# Function that writes a file at a given path; None for a file to remove.
Write = Callable[[Path], object] | None


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write` with a temporary file beside `path`, and then rename that file to `path`.

    No reader sees half a file. The temporary name ends in `.part`, so that patterns like
    `*.parquet` do not find a file that a killed process left behind (see `remove_abandoned`). An
    OSError names `path`.
    """
    write_all_atomically({path: write})


def write_all_atomically(writes: Mapping[Path, Write]) -> None:
    """Write several files as one transaction; remove those whose value is None.

    All are filled before the first is renamed or removed. If one cannot be written, all files stay
    as they were.
    """
    filled: dict[Path, Path] = {}
    try:
        for path, write in writes.items():
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            if write is not None:
                filled[path] = _filled_beside(path, write)
        for path in writes:
            if path in filled:
                filled[path].replace(path)
            else:
                path.unlink(missing_ok=True)
    finally:
        for temporary in filled.values():
            temporary.unlink(missing_ok=True)


def _filled_beside(path: Path, write: Callable[[Path], object]) -> Path:
    """Return a temporary file beside `path` that `write` filled; an OSError names `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(PART, temporary_prefix(path.name), path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        # the error of a full disk has no file name, or the temporary one
        if isinstance(error, OSError) and error.filename in (None, name):
            reason = error.strerror or str(error)
            raise OSError(error.errno or errno.EIO, reason, str(path)) from error
        raise
    return temporary


def temporary_prefix(name: str) -> str:
    """Return how the names of temporary files and folders of this process begin.

    They end in `.part`.
    """
    return f".{name}.{platform.node()}-{os.getpid()}."


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Return a JSON object as text, with the digest of the text as its first field."""
    text = json.dumps({DIGEST: _NO_DIGEST, **content}, indent=1).encode()
    return text.replace(_NO_DIGEST.encode(), hashlib.sha256(text).hexdigest().encode(), 1)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object with the digest of its file."""
    write_atomically(path, lambda temporary: temporary.write_bytes(json_bytes(content)))


def read_json(path: Path, what: str) -> dict[str, Any]:
    """Read a JSON object, and check its digest if it has one; the digest is not returned.

    Args:
        path: of the file.
        what: the file should be, for messages.

    Raises:
        DamagedFileError: the file is missing or damaged, or holds no JSON object.
    """
    require_file(path, what)
    data = path.read_bytes()
    try:
        found = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(path, f"no JSON object ({error}), expected a {what}") from error
    if not isinstance(found, dict):
        held = "null" if found is None else f"a {type(found).__name__}"
        raise DamagedFileError(path, f"no JSON object (it holds {held}), expected a {what}")
    name, value = next(iter(found.items()), ("", ""))
    # detects a damaged name of the field, too: no other first field is a digest
    if name == DIGEST or re.fullmatch("[0-9a-f]{64}", str(value)):
        without = data.replace(str(value).encode(), _NO_DIGEST.encode(), 1)
        if name != DIGEST or hashlib.sha256(without).hexdigest() != value:
            edited = f"if you edited it, remove its field {DIGEST}"
            raise DamagedFileError(path, f"damaged, it does not fit its digest ({edited})")
        del found[name]
    return found


def require_file(path: Path, what: str) -> None:
    """Raise DamagedFileError unless there is a file at `path`, which should be a `what`."""
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "no such file"
        raise DamagedFileError(path, f"{found} (expected a {what})")


def require_version(path: Path, content: Mapping[str, Any], known: int) -> None:
    """Raise InputError for a JSON object whose `schema_version` is above the known one.

    Objects of earlier versions may have none.
    """
    version = content.get("schema_version", known)
    if type(version) is not int or not 1 <= version <= known:
        reads = f"this program reads up to {known}; use the version of mapfusion that wrote it"
        raise InputError(f"{path}: schema_version is {version!r}, {reads}")


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files that killed processes of this machine left below a folder."""
    for path in list(folder.rglob(f".*{PART}")):
        writer = _WRITER.search(path.name)
        if not writer:
            continue
        try:
            os.kill(int(writer["pid"]), 0)
            continue  # the process is running
        except ProcessLookupError:
            pass
        except OSError:  # the process of another user is running
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def name_in_text(name: str) -> str:
    """Return the name of a file as text that can be encoded as UTF-8.

    Without a UTF-8 locale, Python holds the bytes of a name as surrogates. They are decoded as
    UTF-8; invalid bytes are replaced.
    """
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def require_writable(folder: Path) -> None:
    """Raise InputError unless files can be written into a folder, which need not exist yet."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise InputError(f"{folder}: cannot be written ({there} is no folder)")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written (no right to write into {there})")


def schema(kind: str, version: int, fields: list[pa.Field]) -> pa.Schema:
    """Return a schema with the kind of the table and its version in the metadata."""
    return pa.schema(fields, metadata={_KIND: kind.encode(), _VERSION: str(version).encode()})


def write_table(
    path: Path,
    columns: Mapping[Any, Any],
    table_schema: pa.Schema,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write columns (arrays by name) as a table of a schema, with further text attributes."""
    write_atomically(path, table_write(columns, table_schema, attributes))


def table_write(
    columns: Mapping[Any, Any],
    table_schema: pa.Schema,
    attributes: Mapping[str, str] | None = None,
) -> Callable[[Path], object]:
    """Return a function that writes a table to a path; the arguments are those of `write_table`."""
    metadata = dict(table_schema.metadata)
    metadata |= {f"{_PREFIX}{k}".encode(): v.encode() for k, v in (attributes or {}).items()}
    arrays = [_to_arrow(columns[field.name], field.type) for field in table_schema]
    own = pa.schema([field.remove_metadata() for field in table_schema], metadata=metadata)
    table = pa.Table.from_arrays(arrays, schema=own)
    buffer = pa.BufferOutputStream()
    repeats, packed = list[str](), dict[str, str]()
    for field in table_schema:
        is_list = pa.types.is_fixed_size_list(field.type)
        kind = field.type.value_type if is_list else field.type
        is_bytes = pa.types.is_fixed_size_binary(kind)
        # pixels do not compress; better compression of numbers is much slower
        leaf = f"{field.name}.list.element" if is_list else field.name
        packed[leaf] = "none" if is_bytes else "lz4"
        # a dictionary of distinct values would double the time
        if not (is_bytes or pa.types.is_floating(kind)):
            repeats.append(field.name)
    options = {"compression": packed, "use_dictionary": repeats, "write_page_checksum": True}
    pq.write_table(table, buffer, **options, write_statistics=False)  # without checksums
    return lambda temporary: temporary.write_bytes(buffer.getvalue())


def _to_arrow(values: Any, kind: pa.DataType) -> pa.Array:
    """Return values as an Arrow array; lists and bytes of fixed size are rows of a matrix.

    Masked rows of lists are null.
    """
    if pa.types.is_fixed_size_list(kind):
        matrix = np.ascontiguousarray(values).reshape(-1, kind.list_size)
        mask = None
        if np.ma.is_masked(values):
            mask = pa.array(np.ma.getmaskarray(values).reshape(matrix.shape).any(axis=1))
        return pa.FixedSizeListArray.from_arrays(
            pa.array(matrix.ravel(), kind.value_type), kind.list_size, mask=mask
        )
    if pa.types.is_fixed_size_binary(kind):
        matrix = np.ascontiguousarray(values, np.uint8)
        return pa.Array.from_buffers(kind, len(matrix), [None, pa.py_buffer(matrix)])
    return pa.array(values, kind)


def read_parquet(path: Path, what: str, columns: Sequence[str] | None = None) -> pa.Table:
    """Read any Parquet table, all its columns or some; arguments and errors are of `row_groups`."""
    return pa.concat_tables(row_groups(path, what, lambda _: columns))


def row_groups(
    path: Path, what: str, choose: Callable[[pa.Schema], Sequence[str] | None] = lambda _: None
) -> Iterator[pa.Table]:
    """Yield the row groups of any Parquet table, checked; one empty table if it has none.

    Args:
        path: of the file.
        what: the file should be, for messages.
        choose: returns the columns to read, given the schema of the file; None for all.

    Raises:
        DamagedFileError: the file is missing or damaged.
    """
    require_file(path, what)
    data, n_rows = path.read_bytes(), 0
    try:
        # `pq.read_table` would treat the file as a data set, which takes longer than to read it
        file = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
        _require_equal_schemas(file, data)
        names = choose(file.schema_arrow)
        if not file.num_row_groups:
            table = file.schema_arrow.empty_table()
            yield table if names is None else table.select(names)
        for number in range(file.num_row_groups):
            table = file.read_row_group(number, names, use_threads=False)
            _require_disjoint_columns(file, number, table)
            n_rows += len(table)
            yield table if names is None else table.select(names)
        if n_rows != file.metadata.num_rows:
            raise ValueError(f"it has {n_rows} rows in place of {file.metadata.num_rows}")
    except (*UNREADABLE, KeyError) as error:  # KeyError: a column is missing
        if isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DamagedFileError(path, f"damaged or not a Parquet file ({reason})") from error


def _require_equal_schemas(file: pq.ParquetFile, data: bytes) -> None:
    """Raise ValueError unless both copies of the schema agree in a file of ours."""
    found = file.metadata.metadata or {}
    footer = data[-_FOOTER_END - int.from_bytes(data[-_FOOTER_END:][:4], "little") :]
    if _KIND in footer and _KIND not in found:
        raise ValueError("its metadata cannot be read")
    if not file.metadata.created_by.startswith(_ARROW):
        return
    stored = base64.b64decode(found.get(_ARROW_SCHEMA, b""))
    copy = pa.ipc.read_schema(pa.py_buffer(stored)) if stored else pa.schema([])
    ours, again = (
        {name: text for name, text in (metadata or {}).items() if name.startswith(_OURS)}
        for metadata in (found, copy.metadata)
    )
    if ours != again or (ours and not copy.equals(file.schema_arrow)):
        raise ValueError("the two copies of its schema differ")


def _require_disjoint_columns(file: pq.ParquetFile, number: int, table: pa.Table) -> None:
    """Raise ValueError if columns of a row group overlap in a file that Arrow has written.

    Call this function only with the table that was read from the row group. Access to the metadata
    of a footer that Arrow cannot read crashes the process.
    """
    group = file.metadata.row_group(number)
    if group.num_rows != len(table):
        raise ValueError(f"it has {len(table)} rows in place of {group.num_rows}")
    if not len(table) or not file.metadata.created_by.startswith(_ARROW):
        return
    places, names = [], set(table.column_names)
    for k in range(group.num_columns):
        path = file.schema.column(k).path  # NAME, or NAME.list.element
        if {path, path.partition(".")[0]} & names:
            chunk = group.column(k)
            begin = chunk.data_page_offset
            if chunk.has_dictionary_page:
                begin = min(begin, chunk.dictionary_page_offset)
            places.append((begin, begin + chunk.total_compressed_size))
    if any(end > begin for (_, end), (begin, _) in itertools.pairwise(sorted(places))):
        raise ValueError("two of its columns overlap")


def read_table(path: Path, table_schema: pa.Schema) -> tuple[pa.Table, dict[str, str]]:
    """Read a table that `write_table` wrote.

    Returns:
        The table and its text attributes.

    Raises:
        InputError: the file is missing, damaged, of another kind or version, or lacks columns.
    """
    kind = table_schema.metadata[_KIND].decode()
    table = read_parquet(path, f"{kind} table")
    attributes = text_attributes(path, table)
    require_kind(path, table, attributes, table_schema)
    return table, attributes


def require_kind(
    path: Path, table: pa.Table, attributes: Mapping[str, str], table_schema: pa.Schema
) -> None:
    """Raise InputError for a table of another kind, version, or with other columns."""
    kind = table_schema.metadata[_KIND].decode()
    version = table_schema.metadata[_VERSION].decode()
    found_kind = attributes.get("kind", "none")
    if found_kind != kind:
        raise InputError(f"{path}: kind is {found_kind}, expected {kind}")
    found_version = attributes.get("schema_version", "none")
    if found_version != version:
        raise InputError(f"{path}: schema_version is {found_version}, this program reads {version}")
    if not table.schema.equals(table_schema, check_metadata=False):
        expected = ", ".join(f"{f.name}: {f.type}" for f in table_schema)
        raise InputError(f"{path}: columns are not those of {kind} ({expected})")


def text_attributes(path: Path, table: pa.Table) -> dict[str, str]:
    """Return the text attributes of a table, with its kind and version."""
    try:
        texts = {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()}
    except UnicodeDecodeError as error:
        raise DamagedFileError(path, f"its metadata is no UTF-8 text ({error})") from error
    return {k.removeprefix(_PREFIX): v for k, v in texts.items() if k.startswith(_PREFIX)}


def column(table: pa.Table, name: str) -> np.ndarray:
    """Return a column as an array: (N,), or (N, k) for lists of k numbers or for k bytes."""
    chunked = table.column(name)
    values = chunked.chunk(0) if chunked.num_chunks == 1 else chunked.combine_chunks()
    if pa.types.is_fixed_size_binary(values.type):
        k, buffer = values.type.byte_width, values.buffers()[1]
        return np.frombuffer(buffer, np.uint8)[k * values.offset :][: k * len(values)].reshape(
            -1, k
        )
    if pa.types.is_fixed_size_list(values.type):
        return values.flatten().to_numpy(zero_copy_only=False).reshape(-1, values.type.list_size)
    return values.to_numpy(zero_copy_only=False)


def require_cells(
    path: Path,
    table: pa.Table,
    names: Sequence[str],
    is_right: Callable[[np.ndarray], np.ndarray],
    remedy: str,
) -> None:
    """Raise InputError for the first wrong cell; it names the file, the column and the row.

    Args:
        path: of the table, for the message.
        table: holds one number a cell in these columns.
        names: of the columns.
        is_right: returns (N,) bool for the values (N,) of a column.
        remedy: end of the message: what the cells must hold, or what to do.
    """
    for name in names:
        values = column(table, name)
        wrong = np.flatnonzero(~is_right(values))
        if len(wrong):
            found = f"is {values[wrong[0]]:.9g} in row {wrong[0]}"
            raise InputError(f"{path}: column {name}: {found}; {remedy}")


def require_one_row_a_frame(path: Path, table: pa.Table, n_frames: int | None = None) -> None:
    """Raise InputError unless the column `iteration` is 0, 1, 2, ..., one row a frame of the log.

    Args:
        path: of the table, for the message.
        table: with the column.
        n_frames: of the log that the table lies beside; None if it is not known.
    """
    if not np.array_equal(column(table, "iteration"), np.arange(table.num_rows)):
        raise InputError(f"{path}: iterations must be 0, 1, 2, ..., one row each")
    if n_frames is not None and table.num_rows != n_frames:
        frames = f"has {table.num_rows} rows, the log {n_frames} frames"
        raise InputError(f"{path}: {frames}; write one row for each frame, or remove the file")


def columns(table: pa.Table, names: Sequence[str]) -> np.ndarray:
    """Return several columns as one array (N, len(names))."""
    return np.stack([column(table, name) for name in names], -1)


def named_columns(names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Return an array (N, len(names)) as columns by name; the inverse of `columns`."""
    return dict(zip(names, values.T, strict=True))


def described(field: pa.Field, about: str, default: float | None = None) -> pa.Field:
    """Return a field with its description, and the default that replaces a missing column."""
    metadata = {_ABOUT: about.encode()}
    if default is not None:
        metadata[_DEFAULT] = str(default).encode()
    return field.with_metadata(metadata)


def description_of(field: pa.Field) -> str:
    """Return the description of a field; empty if it has none."""
    return (field.metadata or {}).get(_ABOUT, b"").decode()


def default_of(field: pa.Field) -> float | None:
    """Return the default of a missing column; None if the column is required."""
    text = (field.metadata or {}).get(_DEFAULT)
    return None if text is None else float(text)


def float_fields(names: Sequence[str]) -> list[pa.Field]:
    """Return schema fields of float64 columns."""
    return [pa.field(name, pa.float64()) for name in names]


COVARIANCE_FIELDS = ["cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"]
POSITION_FIELDS = ["x_m", "y_m", "z_m"]
POSE_FIELDS = ["x_m", "y_m", "theta_rad"]
_UPPER = np.triu_indices(3)


def point_columns(position_m: np.ndarray, covariance_m2: np.ndarray) -> dict[str, np.ndarray]:
    """Return positions (N, 3) and covariances (N, 3, 3) as nine columns by name."""
    upper = covariance_columns(COVARIANCE_FIELDS, covariance_m2)
    return named_columns(POSITION_FIELDS, position_m) | upper


def points_from(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and covariances of a table; the inverse of `point_columns`."""
    return columns(table, POSITION_FIELDS), covariances_from(table, COVARIANCE_FIELDS)


def covariance_columns(names: Sequence[str], covariance_m2: np.ndarray) -> dict[str, np.ndarray]:
    """Return the upper triangles of covariances (N, 3, 3), row by row, as six columns by name."""
    return named_columns(names, covariance_m2[:, _UPPER[0], _UPPER[1]])


def covariances_from(table: pa.Table, names: Sequence[str]) -> np.ndarray:
    """Return covariances (N, 3, 3) of a table; the inverse of `covariance_columns`."""
    covariance = np.empty((table.num_rows, 3, 3))
    for name, i, j in zip(names, *_UPPER, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = column(table, name)
    return covariance


def point_fields() -> list[pa.Field]:
    """Return the schema fields of `point_columns`."""
    return float_fields(POSITION_FIELDS + COVARIANCE_FIELDS)
