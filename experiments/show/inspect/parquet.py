"""Tables: kind, version, columns with units and ranges, first rows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from experiments.judge import tables
from experiments.run.stages import features, slam
from mapfusion import landmark_map, robot_log
from mapfusion.errors import InputError
from mapfusion.storage import read_table
from sim import trajectory

N_FIRST_ROWS = 5
_MAX_NAMES_LENGTH = 30  # characters; more names are counted
_KIND, _VERSION, _PREFIX = b"mapfusion.kind", b"mapfusion.schema_version", "mapfusion."
_SCHEMAS = (
    *tables.ALL.values(),
    landmark_map.LANDMARKS,
    robot_log.FRAMES,
    robot_log.OBSERVATIONS,
    robot_log.TRUTH_POSES,
    robot_log.TRUTH_POINTS,
    slam.SNAPSHOTS,
    slam.ASSOCIATIONS,
    slam.POSES,
    slam.CLOUDS,
    features.FEATURES,
    features.TRUTH,
    trajectory.TRAJECTORY,
)
KNOWN = {each.metadata[_KIND].decode(): each for each in _SCHEMAS}
_UNITS = {"m": "m", "m2": "m²", "rad": "rad", "s": "s", "ms": "ms", "px": "px"}
# the upper triangle of an alignment's covariance names its axes instead
_NAMED_UNITS = {f"cov_{a}{b}": "m²" for a, b in ("xx", "xy", "yy")}
_NAMED_UNITS |= {"cov_xt": "m rad", "cov_yt": "m rad", "cov_tt": "rad²"}


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        name: with its unit at the end, where it has one.
        type: as Arrow calls it.
        unit: from the name; empty for none.
        low: least value, or empty where there is none to tell.
        high: largest value; for text, how many different ones there are.
        n_missing: NaN or null.
    """

    name: str
    type: str
    unit: str
    low: str
    high: str
    n_missing: int


@dataclass(frozen=True)
class Table:
    """What a Parquet file of ours holds."""

    kind: str
    version: str
    n_rows: int
    columns: tuple[Column, ...]
    attributes: dict[str, str]
    first_rows: tuple[dict[str, Any], ...]
    known: bool


def unit_of(name: str) -> str:
    """The unit that a column's name ends in."""
    return _NAMED_UNITS.get(name, _UNITS.get(name.rpartition("_")[2], "") if "_" in name else "")


def inspect_table(path: Path) -> Table:
    """Read a table whole and describe it.

    Raises:
        InputError: damaged, not ours, or not as its kind and version should be.
    """
    try:
        metadata = pq.read_schema(path).metadata or {}
    except (pa.ArrowInvalid, pa.ArrowTypeError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: damaged or not a Parquet file ({reason})") from error
    if _KIND not in metadata:
        raise InputError(
            f"{path}: a Parquet file, but none of mapfusion's (no mapfusion.kind in its metadata)"
        )
    kind = metadata[_KIND].decode()
    known = kind in KNOWN
    if known:
        table, _ = read_table(path, KNOWN[kind])  # checks version and columns
    else:  # of a sweep, a plug-in or a newer program: it describes itself
        table = _read(path)
    found = table.schema.metadata or metadata
    attributes = {
        name.decode().removeprefix(_PREFIX): value.decode()
        for name, value in found.items()
        if name.decode().startswith(_PREFIX) and name not in (_KIND, _VERSION)
    }
    return Table(
        kind,
        metadata.get(_VERSION, b"none").decode(),
        table.num_rows,
        tuple(_column(table, name) for name in table.column_names),
        attributes,
        tuple(table.slice(0, N_FIRST_ROWS).to_pylist()),
        known,
    )


def _read(path: Path) -> pa.Table:
    try:
        # by the file alone: folders named KEY=VALUE above it are no columns
        return pq.ParquetFile(path).read()
    except (pa.ArrowInvalid, pa.ArrowTypeError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: damaged ({reason})") from error


def _column(table: pa.Table, name: str) -> Column:
    kind = table.schema.field(name).type
    low, high, n_missing = "", "", table.column(name).null_count
    if pa.types.is_floating(kind) or pa.types.is_integer(kind):
        values = table.column(name).to_numpy().astype(np.float64)
        known = values[np.isfinite(values)]
        n_missing = len(values) - len(known)
        if len(known):
            low, high = f"{known.min():.6g}", f"{known.max():.6g}"
    elif pa.types.is_boolean(kind):
        high = f"{int(np.sum(table.column(name).to_numpy().astype(bool)))} true"
    elif pa.types.is_string(kind):
        high = _distinct(table.column(name).unique().to_pylist())
    return Column(name, _type_name(kind), unit_of(name), low, high, n_missing)


def _type_name(kind: pa.DataType) -> str:
    if pa.types.is_fixed_size_list(kind):
        return f"{kind.list_size} x {kind.value_type}"
    return str(kind)


def _distinct(found: list[str | None]) -> str:
    names = [str(name) for name in found]
    return (
        ", ".join(names) if sum(map(len, names)) < _MAX_NAMES_LENGTH else f"{len(names)} different"
    )
