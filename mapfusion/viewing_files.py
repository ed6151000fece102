"""Viewing evidence on disk: `NAME.viewing.parquet` and `NAME.frames.parquet` beside a map.

The first has one row a landmark, in the order of the map, the second one row a frame of the log
that the map was made of; its attributes hold the field of view.
"""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.open_tables import told
from mapfusion.storage import (
    POSE_FIELDS,
    Write,
    column,
    columns,
    float_fields,
    named_columns,
    read_table,
    schema,
    table_write,
)
from mapfusion.viewing import BEARINGS, RANGES, FieldOfView, Viewing

VIEWING = schema(
    "landmark_viewing",
    1,
    [
        told(pa.field("direction_rad", pa.float64()), "mean, from the robot to it, in map frame"),
        told(pa.field("distance_m", pa.float64()), "mean, from the robot to it, in the plane"),
        told(pa.field("n_views", pa.int32()), "sightings behind both"),
    ],
)
VIEWED_FRAMES = schema(
    "viewed_frames",
    1,
    [
        told(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ..."),
        *(told(field, "of the robot, in the map's frame") for field in float_fields(POSE_FIELDS)),
        told(
            pa.field("reach_m", pa.list_(pa.float32(), BEARINGS)),
            "range of the farthest landmark in each part of the field of view, least bearing first;"
            " 0 for none",
        ),
    ],
)
_OF_LANDMARKS = ("direction_rad", "distance_m", "n_views")
_FIELD = "field_of_view"


def viewing_paths(map_path: Path) -> tuple[Path, Path]:
    """Where the viewing evidence of a map's file lies: of its landmarks, and of its frames."""
    return map_path.with_suffix(".viewing.parquet"), map_path.with_suffix(".frames.parquet")


def viewing_writes(map_path: Path, viewing: Viewing | None) -> dict[Path, Write]:
    """Return what is to be written beside a map's file; of None what lay there is removed."""
    of_landmarks, of_frames = viewing_paths(map_path)
    if viewing is None:
        return {of_landmarks: None, of_frames: None}
    rows = {"iteration": np.arange(len(viewing.pose), dtype=np.int32)}
    rows |= named_columns(POSE_FIELDS, viewing.pose) | {"reach_m": viewing.reach_m}
    field = {name: values.tolist() for name, values in vars(viewing.field).items()}
    views = {name: getattr(viewing, name) for name in _OF_LANDMARKS}
    return {
        of_landmarks: table_write(views, VIEWING),
        of_frames: table_write(rows, VIEWED_FRAMES, {_FIELD: json.dumps(field)}),
    }


def read_viewing(map_path: Path, n_landmarks: int) -> Viewing | None:
    """The viewing evidence beside a map's file; None where there is none.

    Raises:
        InputError: it is damaged, of another version or of another map, or one of the two files is
            missing.
    """
    of_landmarks, of_frames = paths = viewing_paths(map_path)
    there = [path.is_file() for path in paths]
    if not any(there):
        return None
    if not all(there):
        lacking, other = (paths[k] for k in (there.index(False), there.index(True)))
        raise InputError(f"{lacking}: no such file, but {other.name} is there; add it or remove it")
    landmarks, _ = read_table(of_landmarks, VIEWING)
    if landmarks.num_rows != n_landmarks:
        own = f"of {landmarks.num_rows} landmarks, {map_path.name} has {n_landmarks}"
        raise InputError(f"{of_landmarks}: {own}; remove it, or give the map that it belongs to")
    frames, attributes = read_table(of_frames, VIEWED_FRAMES)
    try:
        field = _field_from(attributes.get(_FIELD, ""))
    except (ValueError, TypeError, AttributeError) as error:
        expected = f"expected bearing_rad (2), range_m (2), height_m ({RANGES} x 2)"
        raise InputError(f"{of_frames}: {_FIELD}: {expected} ({error})") from error
    try:
        return Viewing(
            pose=columns(frames, POSE_FIELDS),
            reach_m=column(frames, "reach_m"),
            field=field,
            **{name: column(landmarks, name) for name in _OF_LANDMARKS},
        )
    except ValueError as error:
        raise InputError(f"{of_landmarks}: {error}") from error


def _field_from(text: str) -> FieldOfView:
    found = {name: np.array(values, dtype=np.float64) for name, values in json.loads(text).items()}
    return FieldOfView(**found)
