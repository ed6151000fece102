"""LandmarkMap: what one robot believes the world's landmarks to be, in its own frame.

One map is one Parquet file, readable with plain pandas, complete in itself: the descriptor (or
label) of the observation that each landmark came from is carried with it. What the landmarks'
errors have in common, and from where they were seen, lies in files beside it, where it is known.
"""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.arguments import (
    require_finite,
    require_no_twins,
    require_points,
    require_shape,
)
from mapfusion.calibration_error import EXACT, CalibrationError, calibration_from
from mapfusion.errors import InputError, TellingWarning
from mapfusion.joint_covariance import JointCovariance
from mapfusion.joint_files import joint_writes, read_joint
from mapfusion.looks import (
    DESCRIPTOR_LENGTH,
    LOOK_FIELDS,
    look_columns,
    looks_from,
    require_looks,
)
from mapfusion.open_tables import HEIGHT, csv_bytes, is_csv, read_open_table, told
from mapfusion.robot_log import with_rows
from mapfusion.se2 import Float
from mapfusion.storage import (
    COVARIANCE_FIELDS,
    POSITION_FIELDS,
    Write,
    column,
    name_in_text,
    point_columns,
    point_fields,
    points_from,
    require_cells,
    schema,
    table_write,
    write_together,
)
from mapfusion.viewing import Viewing
from mapfusion.viewing_files import read_viewing, viewing_writes

LANDMARKS = schema(
    "landmark_map",
    1,
    [
        *(told(field, "in the map's frame") for field in point_fields()),
        told(pa.field("count", pa.int32()), "observations that went into the landmark", 1),
        told(
            pa.field("source_observation", pa.int64()),
            "row of the log that it came from, -1 for none",
            -1,
        ),
        *LOOK_FIELDS,
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
        **look_columns(len(landmarks), landmarks.descriptor, landmarks.label),
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
    require_looks(path, table)
    position, covariance = points_from(table)
    planar = attributes.get("planar") == "true"
    try:
        found = LandmarkMap(
            position,
            covariance,
            column(table, "count"),
            column(table, "source_observation"),
            *looks_from(table),
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
