"""Files on disk: written whole, with an explicit schema, a kind and a version.

A file of ours holds `mapfusion.sha256` and 64 hexadecimal digits: the SHA-256 of the whole file
with these digits as zeros. Where it stands is up to the format, always where other readers pass it
by: between the pages and the footer of Parquet (so that a table which another program reads and
writes again keeps no stale one), as the first field of JSON, behind the end of PNG, BMP and NPY, in
the first line of OBJ.
"""

import errno
import hashlib
import json
import os
import platform
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mapfusion.errors import DamagedFileError, InputError, UnsealedWarning

SEAL = "mapfusion.sha256"
NO_DIGEST = "0" * 64
LINE = f"{SEAL} {NO_DIGEST}\n".encode()  # an empty seal, for formats that pass over bytes or lines
_SEAL = re.compile(re.escape(SEAL.encode()) + rb'[": ]+(?=(.{64}))', re.DOTALL)
_PARQUET_TAIL = 8  # bytes: the length of the footer, and the magic number
_told: list[Path] = []  # the file that was said to carry no digest, once a process


def seal(data: bytes) -> bytes:
    """Fill in the digest of a file's bytes, which hold an empty seal."""
    return b"".join(sealed_pieces(data))


def sealed_pieces(data: bytes) -> tuple[memoryview, bytes, memoryview]:
    """The same as what comes before the digest, the digest, and what comes after."""
    empty, view = NO_DIGEST.encode(), memoryview(data)
    at = next(at for at in _digests(data) if view[at : at + len(empty)] == empty)
    return view[:at], hashlib.sha256(data).hexdigest().encode(), view[at + len(empty) :]


def _digests(data: bytes) -> Iterator[int]:
    """Where digests begin, from the last to the first: tables and pictures have theirs at the end.

    To look for a text from the end is also much faster than what a pattern's search is.
    """
    name, end = SEAL.encode(), len(data)
    while (end := data.rfind(name, 0, end)) >= 0:
        if match := _SEAL.match(data, end):
            yield match.start(1)


def is_intact(data: bytes) -> bool | None:
    """Whether a file's bytes are those that were sealed; None where they carry no seal.

    One seal that fits is enough: a text in a table may look like one.
    """
    found = None
    for at in _digests(data):
        digest = hashlib.sha256(memoryview(data)[:at])
        digest.update(NO_DIGEST.encode())
        digest.update(memoryview(data)[at + len(NO_DIGEST) :])
        if digest.hexdigest().encode() == data[at : at + len(NO_DIGEST)]:
            return True
        found = False
    return found


def carries_seal(data: bytes) -> bool:
    """Whether a file's bytes carry a seal, fitting or not."""
    return next(_digests(data), None) is not None


def read_sealed(path: Path, what: str, only_ours: bool = False) -> bytes:
    """A file's bytes, checked before anybody looks at them.

    Args:
        path: of the file.
        what: is expected there, for messages.
        only_ours: no other program writes such files: one without digest is damaged.

    Raises:
        DamagedFileError: it is missing, or not as it was written.
    """
    if not path.is_file():
        raise DamagedFileError(path, f"no such file (expected a {what})")
    data = path.read_bytes()
    intact = is_intact(data)
    if intact is False or (intact is None and only_ours):
        by_hand = f"or changed by other means: then take {SEAL} out of it"
        raise DamagedFileError(path, f"damaged, it does not fit its digest ({by_hand})")
    return data


def tell_unsealed(path: Path, data: bytes) -> None:
    """Warn, once a process, that a file which could be read is of unknown soundness."""
    if not _told and not carries_seal(data):
        _told.append(path)
        why = "made by another program or an earlier version, so damage to it may go unseen"
        text = f"{path}: carries no digest ({why}); said of the first such file alone"
        warnings.warn(text, UnsealedWarning, stacklevel=2)


def say_again() -> None:
    """Let `tell_unsealed` warn once more: a new command begins."""
    _told.clear()


def parquet_with_seal(data: bytes | memoryview) -> bytes:
    """A Parquet file with an empty seal in front of its footer, which points at nothing behind."""
    view = memoryview(data)
    footer = _PARQUET_TAIL + int.from_bytes(view[-_PARQUET_TAIL:][:4], "little")
    return b"".join((view[:-footer], LINE, view[-footer:]))


_KIND = b"mapfusion.kind"
_VERSION = b"mapfusion.schema_version"
_PREFIX = "mapfusion."
# What Arrow raises on bytes that it cannot read, some of it from Python code that it calls.
UNREADABLE = (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError)
PART = ".part"
_WRITER = re.compile(rf"\.{re.escape(platform.node())}-(?P<pid>\d+)\.[^.]+\.part$")


# Fills a file of this path; None stands for a file that is to be removed.
Write = Callable[[Path], object] | None


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: nobody sees half a file.

    The temporary name ends in `.part`, so that no pattern like `*.parquet` finds it, also where a
    killed process left it behind; see `remove_abandoned`. An OSError names `path`.
    """
    write_together({path: write})


def write_together(writes: Mapping[Path, Write]) -> None:
    """Write files that belong together as `write_whole` does, and remove those of None.

    All are filled before the first is renamed or removed: if one of them cannot be written, what
    was there stays as it was.
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
        # a full disk is told without a name, or with one that nobody knows
        if isinstance(error, OSError) and error.filename in (None, name):
            reason = error.strerror or str(error)
            raise OSError(error.errno or errno.EIO, reason, str(path)) from error
        raise
    return temporary


def temporary_prefix(name: str) -> str:
    """How temporary files, or folders, of this process begin; they end in `.part`."""
    return f".{name}.{platform.node()}-{os.getpid()}."


def write_sealed(path: Path, data: bytes) -> None:
    """Fill in the empty seal that a file's bytes hold, and write them whole."""
    write_whole(path, sealed_write(data))


def sealed_write(data: bytes) -> Callable[[Path], object]:
    """Return what writes a file's bytes with the empty seal in them filled in."""
    pieces = sealed_pieces(data)

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            file.writelines(pieces)

    return write


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, its digest as first field."""
    write_sealed(path, json.dumps({SEAL: NO_DIGEST, **content}, indent=1).encode())


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A JSON object without its digest; `what` it is, for messages.

    Raises:
        DamagedFileError: the file is missing or damaged, or holds something else.
    """
    data = read_sealed(path, what)
    try:
        found = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(path, f"no JSON object ({error}), expected a {what}") from error
    if not isinstance(found, dict):
        held = "null" if found is None else f"a {type(found).__name__}"
        raise DamagedFileError(path, f"no JSON object (it holds {held}), expected a {what}")
    tell_unsealed(path, data)
    name, value = next(iter(found.items()), ("", ""))
    if name != SEAL and re.fullmatch("[0-9a-f]{64}", str(value)):
        raise DamagedFileError(path, f"damaged, its first field {name!r} should be {SEAL}")
    found.pop(SEAL, None)
    return found


def require_version(path: Path, content: Mapping[str, Any], known: int) -> None:
    """Raise InputError for a JSON object whose `schema_version` is above the known one.

    Objects of earlier versions may have none.
    """
    version = content.get("schema_version", known)
    if type(version) is not int or not 1 <= version <= known:
        reads = f"this program reads up to {known}; use the version of mapfusion that wrote it"
        raise InputError(f"{path}: schema_version is {version!r}, {reads}")


def remove_abandoned(folder: Path) -> None:
    """Remove what processes that were killed left below a folder, named by `temporary_prefix`.

    What is of other machines, and of processes that live, stays.
    """
    for path in list(folder.rglob(f".*{PART}")):
        writer = _WRITER.search(path.name)
        if not writer or _lives(int(writer["pid"])):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def name_in_text(name: str) -> str:
    """Return a file's name as text that every file can hold.

    A locale without UTF-8 leaves Python the bytes of a name in place of its characters: they are
    read as UTF-8. What is none is replaced.
    """
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


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
    write_whole(path, table_write(columns, table_schema, attributes))


def table_write(
    columns: Mapping[Any, Any],
    table_schema: pa.Schema,
    attributes: Mapping[str, str] | None = None,
) -> Callable[[Path], object]:
    """Return what writes a table, with arguments as `write_table` has them."""
    metadata = dict(table_schema.metadata)
    metadata |= {f"{_PREFIX}{k}".encode(): v.encode() for k, v in (attributes or {}).items()}
    arrays = [_to_arrow(columns[field.name], field.type) for field in table_schema]
    own = pa.schema([field.remove_metadata() for field in table_schema], metadata=metadata)
    table = pa.Table.from_arrays(arrays, schema=own)
    buffer = pa.BufferOutputStream()
    # measured values and pixels hardly repeat: a dictionary of them takes as long as all the rest
    repeats = [field.name for field in table_schema if not _is_measured(field.type)]
    # what packs them smaller takes far longer to pack and to unpack, and nothing packs pixels
    packed = {
        _leaf(field): "none" if pa.types.is_fixed_size_binary(field.type) else "lz4"
        for field in table_schema
    }
    options = {"compression": packed, "use_dictionary": repeats}
    pq.write_table(table, buffer, **options, write_page_checksum=True)
    return sealed_write(parquet_with_seal(memoryview(buffer.getvalue())))


def _leaf(field: pa.Field) -> str:
    """What Parquet calls the column that holds a field's values."""
    is_list = pa.types.is_fixed_size_list(field.type)
    return f"{field.name}.list.element" if is_list else field.name


def _is_measured(kind: pa.DataType) -> bool:
    if pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return pa.types.is_floating(kind) or pa.types.is_fixed_size_binary(kind)


def _to_arrow(values: Any, kind: pa.DataType) -> pa.Array:
    if pa.types.is_fixed_size_list(kind):
        matrix = np.ascontiguousarray(values).reshape(-1, kind.list_size)
        return pa.FixedSizeListArray.from_arrays(
            pa.array(matrix.ravel(), kind.value_type), kind.list_size
        )
    if pa.types.is_fixed_size_binary(kind):
        matrix = np.ascontiguousarray(values, np.uint8)
        return pa.Array.from_buffers(kind, len(matrix), [None, pa.py_buffer(matrix)])
    return pa.array(values, kind)


def read_parquet(path: Path, what: str, columns: Sequence[str] | None = None) -> pa.Table:
    """Any Parquet table, all its columns or some, its bytes checked; `what` it is, for messages.

    Raises:
        DamagedFileError: the file is missing or damaged.
    """
    data = read_sealed(path, what)
    try:
        # Arrow's `read_table` looks at a file as at a data set, which takes longer than to read it
        # and the checksums of its pages say again what a seal that fits has said of all its bytes
        by_page = not carries_seal(data)
        file = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=by_page)
        names = None if columns is None else list(columns)
        table = file.read(names, use_threads=False)
        table = table if names is None else table.select(names)
    except (*UNREADABLE, KeyError) as error:  # the latter of a column that is not there
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DamagedFileError(path, f"damaged or not a Parquet file ({reason})") from error
    tell_unsealed(path, data)
    return table


def read_table(path: Path, table_schema: pa.Schema) -> tuple[pa.Table, dict[str, str]]:
    """Read a table written by `write_table`.

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
    """What `write_table` stored beside the columns, kind and version among it."""
    try:
        texts = {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()}
    except UnicodeDecodeError as error:
        raise DamagedFileError(path, f"its metadata is no UTF-8 text ({error})") from error
    return {k.removeprefix(_PREFIX): v for k, v in texts.items() if k.startswith(_PREFIX)}


def column(table: pa.Table, name: str) -> np.ndarray:
    """One column as an array: (N,), or (N, k) for fixed-size lists, and for k bytes each."""
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
    """Raise InputError that names file, column and row of the first cell that is not right.

    Args:
        path: of the table, for the message.
        table: with one number a cell in these columns.
        names: of the columns.
        is_right: from the values (N,) of a column to (N,) bool.
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
    upper = covariance_columns(COVARIANCE_FIELDS, covariance_m2)
    return named_columns(POSITION_FIELDS, position_m) | upper


def points_from(table: pa.Table) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of `point_columns`."""
    return columns(table, POSITION_FIELDS), covariances_from(table, COVARIANCE_FIELDS)


def covariance_columns(names: Sequence[str], covariance_m2: np.ndarray) -> dict[str, np.ndarray]:
    """Covariances (N, 3, 3) as six flat columns of these names, the upper halves row by row."""
    return named_columns(names, covariance_m2[:, _UPPER[0], _UPPER[1]])


def covariances_from(table: pa.Table, names: Sequence[str]) -> np.ndarray:
    """The inverse of `covariance_columns`."""
    covariance = np.empty((table.num_rows, 3, 3))
    for name, i, j in zip(names, *_UPPER, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = column(table, name)
    return covariance


def point_fields() -> list[pa.Field]:
    """Schema fields of `point_columns`."""
    return float_fields(POSITION_FIELDS + COVARIANCE_FIELDS)
