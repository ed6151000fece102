"""A map's joint covariance on disk: a file beside the map, `NAME.joint.parquet` of `NAME.parquet`.

One row a landmark, in the order of the map. What is the landmark's own is stored as it is. What the
shared variables do to it is stored in single precision, a ten-millionth of its size.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.joint_covariance import JointCovariance
from mapfusion.open_tables import told
from mapfusion.se2 import Float
from mapfusion.storage import (
    COVARIANCE_FIELDS,
    Write,
    column,
    covariance_columns,
    covariances_from,
    float_fields,
    read_parquet,
    require_kind,
    schema,
    table_write,
    text_attributes,
)

_OWN_FIELDS = [f"own_{name}" for name in COVARIANCE_FIELDS]
# Of marginal covariances, as a share of their trace: what single precision may change, with room.
_SAME = 1e-4
_KIND = "joint_covariance"


def joint_schema(rank: int) -> pa.Schema:
    """Schema of the file, for R shared variables."""
    cell = pa.list_(pa.float32(), 3 * rank)
    own = (told(field, "what is the landmark's own") for field in float_fields(_OWN_FIELDS))
    moved = "how far one sigma of each of R shared variables moves it: x, y, z of the first, ..."
    return schema(_KIND, 1, [*own, told(pa.field("common_m", cell), moved)])


def _joint_columns(joint: JointCovariance, rank: int) -> dict[str, np.ndarray]:
    """The columns of `joint_schema(rank)`; variables beyond those there are move nothing."""
    common = np.zeros((len(joint), rank, 3), dtype=np.float32)
    common[:, : joint.rank] = joint.common_m
    own = covariance_columns(_OWN_FIELDS, joint.own_m2)
    return own | {"common_m": common.reshape(-1, 3 * rank)}


def _joint_from(table: pa.Table) -> JointCovariance:
    """The inverse of `_joint_columns`."""
    common = column(table, "common_m").astype(np.float64)
    common = common.reshape(len(common), common.shape[1] // 3, 3)
    return JointCovariance(covariances_from(table, _OWN_FIELDS), common)


def joint_path(map_path: Path) -> Path:
    """Where the joint covariance of a map's file lies."""
    return map_path.with_suffix(".joint.parquet")


def joint_writes(map_path: Path, joint: JointCovariance | None) -> dict[Path, Write]:
    """Return what is to be written beside a map's file; of None what lay there is removed."""
    path = joint_path(map_path)
    if joint is None:
        return {path: None}
    rank = max(joint.rank, 1)  # a cell of no numbers is none
    return {path: table_write(_joint_columns(joint, rank), joint_schema(rank))}


def read_joint(map_path: Path, covariance_m2: Float) -> JointCovariance | None:
    """The joint covariance beside a map's file; None where there is none.

    Args:
        map_path: file of the map.
        covariance_m2: (N, 3, 3) of its landmarks.

    Raises:
        InputError: it is damaged, of another version, or of another map.
    """
    path = joint_path(map_path)
    if not path.is_file():
        return None
    table = read_parquet(path, f"{_KIND} table")
    require_kind(path, table, text_attributes(path, table), joint_schema(_rank(table)))
    try:
        joint = _joint_from(table)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if len(joint) != len(covariance_m2):
        own = f"of {len(joint)} landmarks, {map_path.name} has {len(covariance_m2)}"
        raise InputError(f"{path}: {own}; remove it, or give the map that it belongs to")
    off = np.abs(joint.marginal_m2 - covariance_m2).max(axis=(1, 2), initial=0.0)
    wrong = np.flatnonzero(off > _SAME * np.trace(covariance_m2, axis1=1, axis2=2))
    if len(wrong):
        other = f"another covariance than {map_path.name} in row {wrong[0]}"
        raise InputError(f"{path}: {other}; remove it, or give the map that it belongs to")
    return joint


def _rank(table: pa.Table) -> int:
    """R of a table; 1 of one that is none."""
    known = "common_m" in table.column_names
    kind = table.schema.field("common_m").type if known else pa.null()
    return kind.list_size // 3 if pa.types.is_fixed_size_list(kind) else 1
