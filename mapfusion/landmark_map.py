"""Landmark map of one robot in its own frame, and its files.

One row a landmark, in the order of the map. What is the landmark's own is stored as it is. What the
shared variables do to it is stored in single precision, a ten-millionth of its size.

One map is one Parquet file, readable with plain pandas, complete in itself: the descriptor (or
label) of the observation that each landmark came from is carried with it. What the landmarks'
errors have in common, and from where they were seen, lies in files beside it, where it is known.
"""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError, TellingWarning
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSITION_FIELDS,
    Write,
    column,
    covariance_columns,
    covariances_from,
    float_fields,
    name_in_text,
    point_columns,
    point_fields,
    points_from,
    read_parquet,
    require_cells,
    require_kind,
    schema,
    table_write,
    text_attributes,
    write_together,
)
from mapfusion.geometry.camera import EXACT, CalibrationError, calibration_from
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import require_finite, require_no_twins, require_points, require_shape
from mapfusion.robot_log import with_rows
from mapfusion.tables import (
    APPEARANCE_FIELDS,
    DESCRIPTOR_LENGTH,
    HEIGHT,
    appearance_columns,
    appearance_from,
    csv_bytes,
    described,
    is_csv,
    read_open_table,
    require_appearance,
)
from mapfusion.viewing import Viewing, read_viewing, viewing_writes

_OWN_FIELDS = [f"own_{name}" for name in COVARIANCE_FIELDS]
# Of marginal covariances, as a share of their trace: what single precision may change, with room.
_SAME = 1e-4
_KIND = "joint_covariance"


def joint_schema(rank: int) -> pa.Schema:
    """Schema of the file, for R shared variables."""
    cell = pa.list_(pa.float32(), 3 * rank)
    own = (described(field, "what is the landmark's own") for field in float_fields(_OWN_FIELDS))
    moved = "how far one sigma of each of R shared variables moves it: x, y, z of the first, ..."
    return schema(_KIND, 1, [*own, described(pa.field("common_m", cell), moved)])


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


LANDMARKS = schema(
    "landmark_map",
    1,
    [
        *(described(field, "in the map's frame") for field in point_fields()),
        described(pa.field("count", pa.int32()), "observations that went into the landmark", 1),
        described(
            pa.field("source_observation", pa.int64()),
            "row of the log that it came from, -1 for none",
            -1,
        ),
        *APPEARANCE_FIELDS,
    ],
)


@dataclass(frozen=True)
class LandmarkMap:
    """N landmarks of one map.

    Attributes:
        position_m: (N, 3).
        covariance_m2: (N, 3, 3).
        count: (N,) int32 observations each landmark was made of.
        source_observation: (N,) int64 row in the robot's log of the observation it came from.
        descriptor: (N, 64) float32, or None.
        label: (N,) int32, or None.
        planar: z is 0 and carries no information (2 degrees of freedom).
        name: whose map it is.
        joint: what the landmarks' errors have in common, or None; its marginals are covariance_m2.
        viewing: from where they were seen and what the robot looked through, or None.
        calibration: of the camera that saw them, what all share by it; neither covariance has it.
    """

    position_m: Float
    covariance_m2: Float
    count: np.ndarray
    source_observation: np.ndarray
    descriptor: np.ndarray | None = None
    label: np.ndarray | None = None
    planar: bool = False
    name: str = "map"
    joint: JointCovariance | None = None
    viewing: Viewing | None = None
    calibration: CalibrationError = EXACT

    def __post_init__(self) -> None:
        n = len(self.position_m)
        require_shape("position_m", self.position_m, (n, 3))
        require_shape("covariance_m2", self.covariance_m2, (n, 3, 3))
        require_shape("count", self.count, (n,))
        require_shape("source_observation", self.source_observation, (n,))
        require_finite("position_m", self.position_m)
        require_finite("covariance_m2", self.covariance_m2)
        if self.descriptor is not None:
            require_shape("descriptor", self.descriptor, (n, DESCRIPTOR_LENGTH))
        if self.label is not None:
            require_shape("label", self.label, (n,))
        if self.joint is not None and len(self.joint) != n:
            raise ValueError(f"joint: of {len(self.joint)} landmarks, the map has {n}")
        if self.viewing is not None and len(self.viewing) != n:
            raise ValueError(f"viewing: of {len(self.viewing)} landmarks, the map has {n}")

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: np.ndarray) -> "LandmarkMap":
        joint = None if self.joint is None else self.joint[rows]
        viewing = None if self.viewing is None else self.viewing[rows]
        bare = with_rows(replace(self, joint=None, viewing=None), rows)
        return replace(bare, joint=joint, viewing=viewing)


MAP_ENDINGS = (".parquet", ".csv")  # that maps are written with


def write_map(path: Path, landmarks: LandmarkMap) -> None:
    """Write a map to a file, Parquet or CSV by its ending, and replace what was there.

    What a Parquet map has of a joint covariance and viewing evidence lies beside it. A CSV map is
    one file, without these and without metadata: what it leaves out is told by a TellingWarning.

    Raises:
        InputError: the ending is another.
        OSError: a file cannot be written; then what was there stays as it was.
    """
    write_together(map_writes(path, landmarks))


def map_writes(path: Path, landmarks: LandmarkMap) -> dict[Path, Write]:
    """Return what `write_map` is to write or remove, by file."""
    if path.suffix.lower() not in MAP_ENDINGS:
        raise InputError(f"{path}: maps are written as {' or '.join(MAP_ENDINGS)}")
    columns = {
        **point_columns(landmarks.position_m, landmarks.covariance_m2),
        "count": landmarks.count.astype(np.int32),
        "source_observation": landmarks.source_observation.astype(np.int64),
        **appearance_columns(len(landmarks), landmarks.descriptor, landmarks.label),
    }
    if is_csv(path):
        _tell_left_out(path, landmarks)
        absent = {"label"} if landmarks.label is None else set()
        absent |= {"descriptor"} if landmarks.descriptor is None else set()
        absent |= set(HEIGHT) if landmarks.planar else set()
        kept = {name: values for name, values in columns.items() if name not in absent}
        text = csv_bytes(kept)
        return {path: lambda temporary: temporary.write_bytes(text)}
    attributes = {"name": landmarks.name, "planar": str(landmarks.planar).lower()}
    attributes |= landmarks.calibration.attributes()
    return {
        path: table_write(columns, LANDMARKS, attributes),
        **joint_writes(path, landmarks.joint),
        **viewing_writes(path, landmarks.viewing),
    }


def _tell_left_out(path: Path, landmarks: LandmarkMap) -> None:
    """Warn of what a CSV map cannot hold of a map."""
    parts = {
        "joint covariance": landmarks.joint is not None,
        "viewing evidence": landmarks.viewing is not None,
        "calibration error": landmarks.calibration != EXACT,
    }
    if lost := [name for name, there in parts.items() if there]:
        text = f"{path}: CSV cannot hold the map's {' and '.join(lost)}; .parquet keeps all"
        warnings.warn(text, TellingWarning, stacklevel=4)


def read_map(path: Path, alone: bool = False) -> LandmarkMap:
    """Read a map; raises InputError naming the file.

    Of a Parquet map what lies beside it is read, too, unless it is asked for `alone`. A CSV map
    stands alone: what lies beside it belongs to the Parquet map of its name.
    """
    table, attributes = read_open_table(path, LANDMARKS)
    finite = "give a finite number, or remove the row"
    require_cells(path, table, [*POSITION_FIELDS, *COVARIANCE_FIELDS], np.isfinite, finite)
    counted = "a landmark has at least one observation"
    require_cells(path, table, ["count"], lambda count: count >= 1, counted)
    of_log = "give -1 for none, or a row of the log: 0 and more"
    require_cells(path, table, ["source_observation"], lambda row: row >= -1, of_log)
    require_appearance(path, table)
    position, covariance = points_from(table)
    planar = attributes.get("planar") == "true"
    try:
        found = LandmarkMap(
            position,
            covariance,
            column(table, "count"),
            column(table, "source_observation"),
            *appearance_from(table),
            planar,
            attributes.get("name", name_in_text(path.stem)),
            calibration=calibration_from(attributes, path),
        )
        require_points(position, covariance, planar)
        require_no_twins("landmarks", position, covariance.reshape(-1, 9))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if alone or is_csv(path):
        return found
    viewing = read_viewing(path, len(found))
    return replace(found, joint=read_joint(path, covariance), viewing=viewing)
