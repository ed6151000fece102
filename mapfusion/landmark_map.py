"""LandmarkMap: what one robot believes the world's landmarks to be, in its own frame.

One map is one Parquet file, readable with plain pandas, complete in itself: the descriptor (or
label) of the observation that each landmark came from is carried with it.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.arguments import require_finite, require_shape
from mapfusion.errors import InputError
from mapfusion.robot_log import DESCRIPTOR_LENGTH, NO_LABEL
from mapfusion.se2 import Float
from mapfusion.storage import (
    column,
    point_columns,
    point_fields,
    points_from,
    read_table,
    schema,
    write_table,
)

LANDMARKS = schema(
    "landmark_map",
    1,
    [
        *point_fields(),  # in the map's frame
        pa.field("count", pa.int32()),  # observations that went into the landmark
        pa.field("source_observation", pa.int64()),  # row of the log; -1 in a fused map
        pa.field("label", pa.int32()),  # known identity, -1 for none
        pa.field("descriptor", pa.list_(pa.float32(), DESCRIPTOR_LENGTH)),  # NaN for none
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
    """

    position_m: Float
    covariance_m2: Float
    count: np.ndarray
    source_observation: np.ndarray
    descriptor: np.ndarray | None = None
    label: np.ndarray | None = None
    planar: bool = False
    name: str = field(default="map")

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

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: np.ndarray) -> "LandmarkMap":
        return LandmarkMap(
            self.position_m[rows],
            self.covariance_m2[rows],
            self.count[rows],
            self.source_observation[rows],
            None if self.descriptor is None else self.descriptor[rows],
            None if self.label is None else self.label[rows],
            self.planar,
            self.name,
        )


def write_map(path: Path, landmarks: LandmarkMap) -> None:
    """Write one map to one file."""
    n = len(landmarks)
    descriptor = landmarks.descriptor
    if descriptor is None:
        descriptor = np.full((n, DESCRIPTOR_LENGTH), np.nan)
    label = landmarks.label if landmarks.label is not None else np.full(n, NO_LABEL)
    write_table(
        path,
        {
            **point_columns(landmarks.position_m, landmarks.covariance_m2),
            "count": landmarks.count.astype(np.int32),
            "source_observation": landmarks.source_observation.astype(np.int64),
            "label": label.astype(np.int32),
            "descriptor": descriptor.astype(np.float32),
        },
        LANDMARKS,
        {"name": landmarks.name, "planar": str(landmarks.planar).lower()},
    )


def read_map(path: Path) -> LandmarkMap:
    """Read a map; raises InputError that names the file."""
    table, attributes = read_table(path, LANDMARKS)
    position, covariance = points_from(table)
    descriptor = column(table, "descriptor")
    label = column(table, "label")
    try:
        return LandmarkMap(
            position,
            covariance,
            column(table, "count"),
            column(table, "source_observation"),
            None if np.isnan(descriptor).all() else descriptor,
            None if np.all(label == NO_LABEL) else label,
            attributes.get("planar") == "true",
            attributes.get("name", path.stem),
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
