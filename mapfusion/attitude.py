"""Attitude of the robot's body relative to the level map frame, for each frame of a log.

The robot frame of logs and maps is level: x along the heading of the body, z up, the origin on the
floor where the map begins. A body that pitches, rolls or climbs observes points in its own axes;
its attitude transforms them into the level frame. The covariances of a frame's points contain the
attitude error that accumulates while a landmark is in view. The older part of the error is common
to all points of a frame and is added to the landmarks (`attitude_height_errors`). The attitude is
stored in a file beside the log; a log without this file is from a level body.

The initial attitude is unknown, and the errors of relative motions accumulate. A wrong tilt lasts
for a while and tilts all points observed during that time together. This error is not independent
noise, so further observations do not average it out. The heights of the landmarks therefore have
considered errors (Schmidt 1966, "Application of state-space methods to navigation problems"): the
estimate is unchanged, its covariance includes the errors.

In the plane, a wrong tilt moves a point by its height above the floor only, which is much less than
its distance. This effect is neglected.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.files import (
    columns,
    described,
    float_fields,
    named_columns,
    read_parquet,
    require_kind,
    require_one_row_a_frame,
    schema,
    text_attributes,
    write_table,
)
from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se3 import tilt
from mapfusion.robot_log import Observations

FILE = "attitude.parquet"
_ANGLES = ["roll_rad", "pitch_rad"]
_FIELDS = [*_ANGLES, "height_m"]
_SIGMAS = ["sigma_roll_rad", "sigma_pitch_rad", "sigma_height_m"]
_CARRIED = ["carried_tilt", "carried_height"]
_ABOUT = [
    "rotation about the forward axis, positive with the right side down",
    "rotation about the left axis, positive with the nose down",
    "height of the robot's origin above the floor where the map begins",
]
_OF_FRAMES = [
    described(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ..."),
    *(described(f, text) for f, text in zip(float_fields(_FIELDS), _ABOUT, strict=True)),
    *(
        described(f, f"standard deviation of {value}")
        for f, value in zip(float_fields(_SIGMAS), _FIELDS, strict=True)
    ),
]
_ABOUT_CARRIED = "share of the previous row's error that remains in this row, 0 to 1"
ATTITUDE = schema(
    "robot_log.attitude",
    2,
    [*_OF_FRAMES, *(described(f, _ABOUT_CARRIED) for f in float_fields(_CARRIED))],
)
# Schema version 1: the errors of frames are independent.
_ATTITUDE_1 = schema("robot_log.attitude", 1, _OF_FRAMES)


@dataclass(frozen=True)
class Attitude:
    """Attitudes of T frames.

    Attributes:
        value: (T, 3) roll about the forward axis (right side down) and pitch about the left axis
            (nose down) in radians, and height in metres of the robot's origin above the floor
            where the map begins.
        sigma: (T, 3) standard deviations of the errors of `value`.
        carried: (T, 2) share of the previous frame's error that remains in each frame, for the
            tilt and for the height: 0 for independent measurements, 1 for dead reckoning.
    """

    value: Float
    sigma: Float
    carried: Float

    def __post_init__(self) -> None:
        for name, n in (("value", 3), ("sigma", 3), ("carried", 2)):
            require_shape(name, getattr(self, name), (len(self.value), n))
            require_finite(name, getattr(self, name))
        if np.any(np.abs(self.value[:, :2]) >= np.pi / 2):
            raise ValueError("value: roll and pitch must be between -90 and 90 degrees")
        if np.any(self.sigma < 0):
            raise ValueError("sigma: is below 0")
        if np.any((self.carried < 0) | (self.carried > 1)):
            raise ValueError("carried: is not between 0 and 1")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.value)


def transform_observations(observed: Observations, R: Float, t: Float) -> Observations:
    """Transform observations into another frame by a rotation R (3, 3) and a shift t (3,)."""
    covariance = R @ observed.covariance_m2 @ R.T
    covariance = (covariance + covariance.swapaxes(1, 2)) / 2  # symmetric despite rounding
    position = observed.position_m @ R.T + t
    return replace(observed, position_m=position, covariance_m2=covariance)


def level_observations(observed: Observations, value: Float, sigma: Float) -> Observations:
    """Transform one frame's observations from the body frame into the level frame.

    Args:
        observed: observations in the body frame.
        value: (3,) roll, pitch and height, as in `Attitude`.
        sigma: (3,) standard deviations of the independent part of the error, which the returned
            covariances include (first order).
    """
    roll, pitch, height_m = value
    level = transform_observations(observed, tilt(roll, pitch), np.array([0.0, 0.0, height_m]))
    arm = level.position_m - [0.0, 0.0, height_m]
    # a roll rotates about the pitched forward axis, a pitch about the left axis
    by_roll = np.cross(tilt(0.0, pitch)[:, 0], arm)
    by_pitch = np.cross([0.0, 1.0, 0.0], arm)
    upwards = np.broadcast_to([0.0, 0.0, 1.0], arm.shape)
    jacobian = np.stack([by_roll, by_pitch, upwards], -1)
    spread = np.einsum("nij,j,nkj->nik", jacobian, sigma**2, jacobian)
    return replace(level, covariance_m2=level.covariance_m2 + spread)


def write_attitude(folder: Path, attitude: Attitude | None) -> None:
    """Write `attitude.parquet` into a log's folder; None removes the file."""
    if attitude is None:
        (folder / FILE).unlink(missing_ok=True)
        return
    rows = {"iteration": np.arange(len(attitude), dtype=np.int32)}
    values = named_columns(_FIELDS, attitude.value) | named_columns(_SIGMAS, attitude.sigma)
    values |= named_columns(_CARRIED, attitude.carried)
    write_table(folder / FILE, rows | values, ATTITUDE)


def read_attitude(folder: Path, n_frames: int | None = None) -> Attitude | None:
    """Read the attitude of a log; None if its folder has no attitude file (a level robot).

    Args:
        folder: folder of the log.
        n_frames: number of frames of the log; None if unknown.

    Raises:
        InputError: the file is damaged or not as documented.
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


# Number of independent sources of new errors along a log; the frames between two sources share one.
_MAX_SOURCES = 64
_SIZE = 3  # components of an error: tilts about the map's axes x and y, and a height


def attitude_height_errors(
    attitude: Attitude, path: Float, frame: np.ndarray, landmark: np.ndarray, point_m: Float
) -> Float:
    """Return the height error (R, L) in metres of each landmark per sigma of R shared errors.

    Args:
        attitude: attitudes of at least T frames.
        path: (T, 3) path of the robot in its map.
        frame: (N,) frame of each observation.
        landmark: (N,) landmark of each observation, 0 to L - 1, each at least once.
        point_m: (L, 2) or (L, 3) positions of the landmarks.
    """
    # The stated variances (T, 3) contain the error carried over from the frame before. The rest is
    # new in each frame.
    n = len(path)
    stated = np.column_stack([np.mean(attitude.sigma[:, :2] ** 2, axis=1)] * 2)
    stated = np.column_stack([stated, attitude.sigma[:, 2] ** 2])
    new, P = np.zeros((n, _SIZE)), np.zeros((_SIZE, _SIZE))
    for k in range(n):
        if k:
            F = _transition(attitude, path, k)
            P = F @ P @ F.T
        new[k] = np.maximum(stated[k] - np.diag(P), 0.0)
        P += np.diag(new[k])

    # Sources of new errors; the initial attitude is a source of its own.
    first = np.unique(np.linspace(1, n, min(_MAX_SOURCES, n), dtype=np.int64))
    starts = np.concatenate([[0], first[first < n]])
    variance = np.add.reduceat(new, starts)

    # Propagate the error of each source along the path, and average over a landmark's observations.
    order = np.argsort(frame, kind="stable")
    bounds = np.searchsorted(frame[order], np.arange(n + 1))
    lifted = np.zeros((len(point_m), _SIZE * len(starts)))
    error, source = np.zeros((_SIZE, _SIZE * len(starts))), 0
    for k in range(n):
        if k:
            error = _transition(attitude, path, k) @ error
        if source < len(starts) and k == starts[source]:
            own = slice(_SIZE * source, _SIZE * source + _SIZE)
            error[:, own] += np.diag(np.sqrt(variance[source]))
            source += 1
        rows = landmark[order[bounds[k] : bounds[k + 1]]]
        x, y = (point_m[rows, :2] - path[k, :2]).T
        np.add.at(lifted, rows, np.column_stack([y, -x, np.ones(len(rows))]) @ error)
    return (lifted / np.bincount(landmark, minlength=len(point_m))[:, None]).T


def _transition(attitude: Attitude, path: Float, k: int) -> Float:
    """Return the transition matrix (3, 3) of the error from frame k - 1 to frame k.

    A robot with a tilt error gains a height error as it moves.
    """
    tilt, height = attitude.carried[k]
    dx, dy = path[k, :2] - path[k - 1, :2]
    return np.array([[tilt, 0.0, 0.0], [0.0, tilt, 0.0], [height * dy, -height * dx, height]])
