"""Attitude of a robot's body relative to the level map frame, for each frame.

The robot frame of logs and maps is level: x in the heading of the body, z up, its origin on the
floor that the map begins on. A body that pitches, rolls or climbs sees points in axes of its own;
its attitude turns and lifts them. What came to its error while a landmark stays in view is in the
covariances of a frame's points; what is older all have alike, and is added to the landmarks
(`attitude_drift.py`). A file beside the log keeps it; a log without one is of a level body.

Nobody tells how the body stood to begin with, and links between frames add up their errors. A tilt
that is wrong stays so for a while, and what was seen meanwhile lies on a plane that is tilted as a
whole. Within a frame and from one to the next that is no noise, and more sightings do not average
it out. So the landmarks' heights are moved by what a filter calls considered errors (Schmidt 1966,
"Application of state-space methods to navigation problems"): the estimate stays as it is, its
covariance has them.

In the plane a wrong tilt moves what is seen by its height above the floor alone, metres where
levers are tens of them, and the robot's path with it: that is left out.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.files import (
    columns,
    float_fields,
    named_columns,
    read_parquet,
    require_kind,
    require_one_row_a_frame,
    schema,
    text_attributes,
    write_table,
)
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se3 import tilt
from mapfusion.parameters import require_finite, require_shape
from mapfusion.robot_log import Observations
from mapfusion.tables import described

FILE = "attitude.parquet"
_ANGLES = ["roll_rad", "pitch_rad"]
_FIELDS = [*_ANGLES, "height_m"]
_SIGMAS = ["sigma_roll_rad", "sigma_pitch_rad", "sigma_height_m"]
_CARRIED = ["carried_tilt", "carried_height"]
_ABOUT = [
    "about the heading, the right side down",
    "about the axis to the left, looking down",
    "of the robot's origin above the floor that the map begins on",
]
_OF_FRAMES = [
    described(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ..."),
    *(described(f, text) for f, text in zip(float_fields(_FIELDS), _ABOUT, strict=True)),
    *(described(f, "standard deviation of the same") for f in float_fields(_SIGMAS)),
]
_ABOUT_CARRIED = "share of the error of the row before that is left in this one's, 0 to 1"
ATTITUDE = schema(
    "robot_log.attitude",
    2,
    [*_OF_FRAMES, *(described(f, _ABOUT_CARRIED) for f in float_fields(_CARRIED))],
)
# Of the version before: each frame's error for itself.
_ATTITUDE_1 = schema("robot_log.attitude", 1, _OF_FRAMES)


@dataclass(frozen=True)
class Attitude:
    """Attitudes of T frames (T, 3): roll, pitch in radians, height in metres.

    Attributes:
        value: roll about the axis ahead (right side down), pitch about the axis to the left
            (looking down), height of the robot's origin above the floor that the map begins on.
        sigma: standard deviations of their errors.
        carried: (T, 2) share of the error of the frame before that is left in each frame's, of roll
            and pitch and of the height: 0 where each frame is measured for itself, 1 where nothing
            but motions since the frame before tell.
    """

    value: Float
    sigma: Float
    carried: Float

    def __post_init__(self) -> None:
        for name, n in (("value", 3), ("sigma", 3), ("carried", 2)):
            require_shape(name, getattr(self, name), (len(self.value), n))
            require_finite(name, getattr(self, name))
        if np.any(np.abs(self.value[:, :2]) >= np.pi / 2):
            raise ValueError("value: a body that stands on end or on its head is not level")
        if np.any(self.sigma < 0):
            raise ValueError("sigma: is below 0")
        if np.any((self.carried < 0) | (self.carried > 1)):
            raise ValueError("carried: is not between 0 and 1")

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.value)


def transform_observations(observed: Observations, R: Float, t: Float) -> Observations:
    """The same observations in another frame: turned by R (3, 3), then shifted by t (3,)."""
    covariance = R @ observed.covariance_m2 @ R.T
    covariance = (covariance + covariance.swapaxes(1, 2)) / 2  # as rounding left it
    position = observed.position_m @ R.T + t
    return replace(observed, position_m=position, covariance_m2=covariance)


def level_observations(observed: Observations, value: Float, sigma: Float) -> Observations:
    """One frame's observations in the level frame.

    Args:
        observed: in the body's frame.
        value: (3,) roll, pitch and height, as of `Attitude`.
        sigma: (3,) of what is not alike in the errors of frames that see the same, which the
            covariances then include (first order).
    """
    roll, pitch, height_m = value
    made = transform_observations(observed, tilt(roll, pitch), np.array([0.0, 0.0, height_m]))
    arm = made.position_m - [0.0, 0.0, height_m]
    # a roll turns about the pitched axis ahead, a pitch about the axis to the left
    by_roll = np.cross(tilt(0.0, pitch)[:, 0], arm)
    by_pitch = np.cross([0.0, 1.0, 0.0], arm)
    upwards = np.broadcast_to([0.0, 0.0, 1.0], arm.shape)
    jacobian = np.stack([by_roll, by_pitch, upwards], -1)
    spread = np.einsum("nij,j,nkj->nik", jacobian, sigma**2, jacobian)
    return replace(made, covariance_m2=made.covariance_m2 + spread)


def write_attitude(folder: Path, attitude: Attitude | None) -> None:
    """Write `attitude.parquet` into a log's folder; None removes what is there."""
    if attitude is None:
        (folder / FILE).unlink(missing_ok=True)
        return
    rows = {"iteration": np.arange(len(attitude), dtype=np.int32)}
    values = named_columns(_FIELDS, attitude.value) | named_columns(_SIGMAS, attitude.sigma)
    values |= named_columns(_CARRIED, attitude.carried)
    write_table(folder / FILE, rows | values, ATTITUDE)


def read_attitude(folder: Path, n_frames: int | None = None) -> Attitude | None:
    """Read the attitude of a log; None if its folder holds none, as for level robots.

    Args:
        folder: of the log.
        n_frames: of the log; None if it is not known.

    Raises:
        InputError: the file is damaged, or not as documented.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    table = read_parquet(path, "robot_log.attitude table")
    attributes = text_attributes(path, table)
    earlier = attributes.get("schema_version") == "1"
    require_kind(path, table, attributes, _ATTITUDE_1 if earlier else ATTITUDE)
    require_one_row_a_frame(path, table, n_frames)
    try:
        carried = np.zeros((table.num_rows, 2)) if earlier else columns(table, _CARRIED)
        return Attitude(columns(table, _FIELDS), columns(table, _SIGMAS), carried)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


_MOST_SOURCES = 64  # of new errors along a log; frames between two of them share one
_SIZE = 3  # of an error: tilts about the map's axes x and y, and a height


def attitude_height_errors(
    attitude: Attitude, path: Float, frame: np.ndarray, landmark: np.ndarray, point_m: Float
) -> Float:
    """How far one sigma of each shared error lifts landmarks: (R, L), in metres.

    Args:
        attitude: of T frames or more.
        path: (T, 3) of the robot in its map.
        frame: (N,) of each sighting.
        landmark: (N,) what it is of: 0 to L - 1, each at least once.
        point_m: (L, 2) or (L, 3) where these are.
    """
    n = len(path)
    first = np.unique(np.linspace(1, n, min(_MOST_SOURCES, n), dtype=np.int64))
    starts = np.concatenate([[0], first[first < n]])  # how the body stood at first is one alone
    new = np.add.reduceat(_new_variances(attitude, path), starts)
    order = np.argsort(frame, kind="stable")
    bounds = np.searchsorted(frame[order], np.arange(n + 1))
    moved = np.zeros((len(point_m), _SIZE * len(starts)))
    error, source = np.zeros((_SIZE, _SIZE * len(starts))), 0
    for k in range(n):
        if k:
            error = _carried(attitude, path, k) @ error
        if source < len(starts) and k == starts[source]:
            own = slice(_SIZE * source, _SIZE * source + _SIZE)
            error[:, own] += np.diag(np.sqrt(new[source]))
            source += 1
        rows = landmark[order[bounds[k] : bounds[k + 1]]]
        x, y = (point_m[rows, :2] - path[k, :2]).T
        np.add.at(moved, rows, np.column_stack([y, -x, np.ones(len(rows))]) @ error)
    return (moved / np.bincount(landmark, minlength=len(point_m))[:, None]).T


def _carried(attitude: Attitude, path: Float, k: int) -> Float:
    """(3, 3) what the error of frame k - 1 is in frame k: a tilted robot climbs as it goes."""
    tilt, height = attitude.carried[k]
    dx, dy = path[k, :2] - path[k - 1, :2]
    return np.array([[tilt, 0.0, 0.0], [0.0, tilt, 0.0], [height * dy, -height * dx, height]])


def _new_variances(attitude: Attitude, path: Float) -> Float:
    """(T, 3) of the error that comes with each frame, so that all together are as is stated."""
    stated = np.column_stack([np.mean(attitude.sigma[:, :2] ** 2, axis=1)] * 2)
    stated = np.column_stack([stated, attitude.sigma[:, 2] ** 2])
    new, P = np.zeros((len(path), _SIZE)), np.zeros((_SIZE, _SIZE))
    for k in range(len(path)):
        if k:
            F = _carried(attitude, path, k)
            P = F @ P @ F.T
        new[k] = np.maximum(stated[k] - np.diag(P), 0.0)
        P += np.diag(new[k])
    return new
