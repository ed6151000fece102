"""Viewing evidence of a map: poses that observed its landmarks, and free lines of sight.

The evidence decides whether the robot must have seen a landmark of another map: the landmark was in
the field of view of several frames, and no nearer object hid it.

Two files beside the map store the evidence. `NAME.viewing.parquet` has one row a landmark, in the
order of the map. `NAME.frames.parquet` has one row a frame of the log, and the field of view in its
attributes.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.files import (
    POSE_FIELDS,
    Write,
    column,
    columns,
    described,
    float_fields,
    named_columns,
    read_table,
    schema,
    table_write,
)
from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se2 import wrap

BEARINGS = 16  # sectors of the field of view
RANGES = 8  # range steps up to the greatest range
# Share of observations cut off at either end of bearings, ranges and heights. Outliers lie there,
# and a field of view that is slightly too small never contains a point that was out of view.
_OUTLIER_SHARE = 0.005
_MIN_SIGHTINGS = 20  # observations in a range step for which quantiles of the height are computed


@dataclass(frozen=True)
class FieldOfView:
    """Field of view in the robot frame.

    Attributes:
        bearing_rad: (2,) smallest and greatest bearing.
        range_m: (2,) smallest and greatest range in the plane.
        height_m: (RANGES, 2) smallest and greatest height in equal range steps from 0 to the
            greatest range. The smallest is above the greatest in a step with too few observations.
    """

    bearing_rad: Float
    range_m: Float
    height_m: Float

    def __post_init__(self) -> None:
        require_shape("bearing_rad", self.bearing_rad, (2,))
        require_shape("range_m", self.range_m, (2,))
        require_shape("height_m", self.height_m, (RANGES, 2))

    @classmethod
    def of(cls, bearing_rad: Float, range_m: Float, height_m: Float) -> "FieldOfView":
        """Return the field of view of observations (n,); an empty one without observations."""
        heights = np.tile([1.0, 0.0], (RANGES, 1))
        if not len(range_m):
            return cls(np.zeros(2), np.zeros(2), heights)
        nearest, farthest = _ends(range_m)
        # Outliers beyond the greatest range are in step RANGES, which has no height limits.
        step = np.minimum(np.floor(range_m / max(farthest, 1e-9) * RANGES), RANGES).astype(np.int8)
        by_step = height_m[np.argsort(step, kind="stable")]
        starts = np.concatenate([[0], np.cumsum(np.bincount(step, minlength=RANGES))])
        for k in range(RANGES):
            own = by_step[starts[k] : starts[k + 1]]
            if len(own) >= _MIN_SIGHTINGS:
                heights[k] = _ends(own)
        return cls(_ends(bearing_rad), np.array([nearest, farthest]), heights)


@dataclass(frozen=True)
class Viewing:
    """Viewing evidence of a map with N landmarks, from T frames.

    Attributes:
        direction_rad: (N,) mean direction from the robot to the landmark, in the map frame.
        distance_m: (N,) mean distance from the robot to the landmark, in the plane.
        n_views: (N,) int32 number of observations in these means; for 0 the means are undefined.
        pose: (T, 3) poses of the robot in the map frame.
        reach_m: (T, BEARINGS) float32 range of the farthest landmark observed in each sector of the
            field of view, 0 for none. No nearer landmark in this sector was hidden.
        field: the field of view.
    """

    direction_rad: Float
    distance_m: Float
    n_views: np.ndarray
    pose: Float
    reach_m: np.ndarray
    field: FieldOfView

    def __post_init__(self) -> None:
        n, t = len(self.direction_rad), len(self.pose)
        require_shape("distance_m", self.distance_m, (n,))
        require_shape("n_views", self.n_views, (n,))
        require_shape("pose", self.pose, (t, 3))
        require_shape("reach_m", self.reach_m, (t, BEARINGS))
        for name in ("direction_rad", "distance_m", "pose", "reach_m"):
            require_finite(name, getattr(self, name))

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.direction_rad)

    def __getitem__(self, rows: np.ndarray | slice) -> "Viewing":
        """Return the evidence for some of the landmarks, with all frames."""
        names = ("direction_rad", "distance_m", "n_views")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def joined(self, other: "Viewing", turn_rad: float) -> "Viewing":
        """Append the landmarks of another map, rotated by `turn_rad`; keep these frames."""
        turned = replace(other, direction_rad=wrap(other.direction_rad + turn_rad))
        names = ("direction_rad", "distance_m", "n_views")
        both = {n: np.concatenate([getattr(self, n), getattr(turned, n)]) for n in names}
        return replace(self, **both)


class LogSightings(NamedTuple):
    """Polar coordinates of n observations of a log.

    Attributes:
        frame: (n,) frame numbers, ascending.
        bearing_rad, range_m, height_m: (n,) in the robot frame; the range is in the plane.
    """

    frame: np.ndarray
    bearing_rad: Float
    range_m: Float
    height_m: Float

    @classmethod
    def of(cls, frame: np.ndarray, position_m: Float) -> "LogSightings":
        """Return the coordinates of observations (n,) at positions (n, 3) in the robot frame."""
        x, y, z = position_m.T
        return cls(frame, np.arctan2(y, x), np.hypot(x, y), z.copy())

    def viewing(self, landmark: np.ndarray, path: Float, source_observation: np.ndarray) -> Viewing:
        """Return the viewing evidence of a map; for the arguments see `viewing_of_log`."""
        n_seen = min(int(np.searchsorted(self.frame, len(path))), len(landmark))
        bearing, range_m, height = (part[:n_seen] for part in self[1:])
        field = FieldOfView.of(bearing, range_m, height)
        n = len(source_observation)
        owner, row_of = landmark[:n_seen], np.full(len(self.frame) + 1, -1, dtype=np.int64)
        row_of[source_observation] = np.arange(n)
        row = np.where(owner >= 0, row_of[owner], -1)
        used = np.flatnonzero(row >= 0)
        row, frame, bearing, range_m = row[used], self.frame[used], bearing[used], range_m[used]
        count = np.bincount(row, minlength=n)
        direction = bearing + path[frame, 2]
        cos, sin, distance = (
            np.bincount(row, values, n).astype(np.float64)
            for values in (np.cos(direction), np.sin(direction), range_m)
        )
        reach = np.zeros(len(path) * BEARINGS, dtype=np.float32)
        at = frame.astype(np.int64) * BEARINGS + bearing_bin(bearing, field)
        np.maximum.at(reach, at, range_m.astype(np.float32))
        mean_m, n_views = distance / np.maximum(count, 1), count.astype(np.int32)
        reach = reach.reshape(len(path), BEARINGS)
        return Viewing(np.arctan2(sin, cos), mean_m, n_views, path, reach, field)


def viewing_of_log(
    frame: np.ndarray,
    position_m: Float,
    landmark: np.ndarray,
    path: Float,
    source_observation: np.ndarray,
) -> Viewing:
    """Return the viewing evidence of a map that was built from a log.

    Args:
        frame: (K,) frame of each observation of a log with at least T frames.
        position_m: (K, 3) positions of the observations in the robot frame.
        landmark: (n,) landmark of each of the log's first observations, as the row of the
            observation that created the landmark; negative for none.
        path: (T, 3) poses of the first T frames in the map frame.
        source_observation: (N,) row of the observation that created each landmark of the map.
    """
    n_seen = int(np.searchsorted(frame, len(path)))
    sightings = LogSightings.of(frame[:n_seen], position_m[:n_seen])
    return sightings.viewing(landmark, path, source_observation)


def bearing_bin(bearing_rad: Float, field: FieldOfView) -> np.ndarray:
    """Return the sector of bearings (n,); bearings outside the field of view get the nearest."""
    low, high = field.bearing_rad
    part = np.floor((bearing_rad - low) / max(high - low, 1e-9) * BEARINGS)
    return np.clip(part, 0, BEARINGS - 1).astype(np.int64)


def _ends(values: Float) -> Float:
    """Return the quantiles (2,) of values (n,) that cut off outliers at both ends; n >= 1.

    The result equals that of `np.quantile`, which is several times slower than a sort.
    """
    ranked = np.sort(values)
    position = np.array([_OUTLIER_SHARE, 1 - _OUTLIER_SHARE]) * (len(ranked) - 1)
    below = position.astype(np.int64)
    low, high = ranked[below], ranked[np.minimum(below + 1, len(ranked) - 1)]
    share = position - below
    # interpolate from the nearer value, as `np.quantile` does
    return np.where(share < 0.5, low + (high - low) * share, high - (high - low) * (1 - share))


VIEWING = schema(
    "landmark_viewing",
    1,
    [
        described(
            pa.field("direction_rad", pa.float64()),
            "mean direction from the robot to the landmark, in the map frame",
        ),
        described(
            pa.field("distance_m", pa.float64()),
            "mean distance from the robot to the landmark, in the plane",
        ),
        described(pa.field("n_views", pa.int32()), "number of observations in both means"),
    ],
)
VIEWED_FRAMES = schema(
    "viewed_frames",
    1,
    [
        described(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ..."),
        *(
            described(field, "pose of the robot in the map frame")
            for field in float_fields(POSE_FIELDS)
        ),
        described(
            pa.field("reach_m", pa.list_(pa.float32(), BEARINGS)),
            "range of the farthest landmark in each sector of the field of view, smallest bearing"
            " first; 0 for none",
        ),
    ],
)
_OF_LANDMARKS = ("direction_rad", "distance_m", "n_views")
_FIELD = "field_of_view"


def viewing_paths(map_path: Path) -> tuple[Path, Path]:
    """Return the paths of a map's viewing evidence: of its landmarks, and of its frames."""
    return map_path.with_suffix(".viewing.parquet"), map_path.with_suffix(".frames.parquet")


def viewing_writes(map_path: Path, viewing: Viewing | None) -> dict[Path, Write]:
    """Return the writes of the files beside a map's file; None removes these files."""
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
    """Read the viewing evidence beside a map's file; None if there is none.

    Raises:
        InputError: a file is damaged, has another version or belongs to another map, or one of the
            two files is missing.
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
        content = json.loads(attributes.get(_FIELD, ""))
        field = FieldOfView(**{k: np.array(v, dtype=np.float64) for k, v in content.items()})
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
