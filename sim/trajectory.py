"""Trajectory: true poses, wheel angles and tilts of the robots, as arrays and as a file.

The file is a Parquet table with one row per robot and iteration, ordered by robot, then iteration.
Any source of poses can write such a table in place of the driver. A model of body sway adds roll
and pitch, and a noise model measures them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.files import (
    POSE_FIELDS,
    column,
    columns,
    float_fields,
    named_columns,
    read_parquet,
    require_kind,
    schema,
    text_attributes,
    write_table,
)
from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se3 import in_space
from mapfusion.parameters import Range, require_in_range

TRAJECTORY_FILE = "trajectory.parquet"  # in the folder of a drive
_WHEEL_FIELDS = ["left_wheel_rad", "right_wheel_rad"]
_TILT_FIELDS = ["roll_rad", "pitch_rad"]
_LEVEL_FIELDS = [
    pa.field("robot", pa.string()),
    pa.field("iteration", pa.int32()),
    pa.field("time_s", pa.float64()),
    *float_fields(POSE_FIELDS),  # T_world_robot
    *float_fields(_WHEEL_FIELDS),  # encoder angles since the start, mean over the wheels of a side
]
_VERSION_1 = schema("trajectory", 1, _LEVEL_FIELDS)  # level bodies
TRAJECTORY = schema("trajectory", 2, [*_LEVEL_FIELDS, *float_fields(_TILT_FIELDS)])


@dataclass(frozen=True)
class Trajectory:
    """Motion of R robots at T times.

    Attributes:
        robots: R names.
        time_s: time since the start, increasing, shape (T,).
        T_world_robot: true poses, shape (R, T, 3).
        wheel_rad: left and right encoder angles since the start, shape (R, T, 2).
        tilt_rad: roll (right side down) and pitch (front down) of the bodies, shape (R, T, 2);
            None for level bodies.
    """

    robots: tuple[str, ...]
    time_s: Float
    T_world_robot: Float
    wheel_rad: Float
    tilt_rad: Float | None = None

    def __post_init__(self) -> None:
        n_robots, n_frames = len(self.robots), len(self.time_s)
        if self.tilt_rad is not None:
            require_shape("tilt_rad", self.tilt_rad, (n_robots, n_frames, 2))
            require_finite("tilt_rad", self.tilt_rad)
        require_shape("T_world_robot", self.T_world_robot, (n_robots, n_frames, 3))
        require_shape("wheel_rad", self.wheel_rad, (n_robots, n_frames, 2))
        for name in ("time_s", "T_world_robot", "wheel_rad"):
            require_finite(name, getattr(self, name))
        if len(set(self.robots)) != n_robots:
            raise ValueError(f"robots: a name occurs twice in {', '.join(self.robots)}")
        if np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s: must increase")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    def index(self, robot: str) -> int:
        """Return the row of a robot; raises InputError that lists the known names."""
        if robot not in self.robots:
            raise InputError(f"robot {robot}: unknown, there are {', '.join(self.robots)}")
        return self.robots.index(robot)

    def bodies(self, iteration: int) -> Float:
        """Return the body poses of all robots: shape (R, 3) if level, else (R, 4, 4)."""
        poses = self.T_world_robot[:, iteration]
        return poses if self.tilt_rad is None else in_space(poses, self.tilt_rad[:, iteration])


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory to one file."""
    n_robots, n_frames = len(trajectory.robots), len(trajectory)
    level = np.zeros((n_robots, n_frames, 2))
    tilt_rad = level if trajectory.tilt_rad is None else trajectory.tilt_rad
    write_table(
        path,
        {
            "robot": np.repeat(np.array(trajectory.robots, dtype=object), n_frames),
            "iteration": np.tile(np.arange(n_frames, dtype=np.int32), n_robots),
            "time_s": np.tile(trajectory.time_s, n_robots),
            **named_columns(POSE_FIELDS, trajectory.T_world_robot.reshape(-1, 3)),
            **named_columns(_WHEEL_FIELDS, trajectory.wheel_rad.reshape(-1, 2)),
            **named_columns(_TILT_FIELDS, tilt_rad.reshape(-1, 2)),
        },
        TRAJECTORY,
    )


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory; raises InputError that names the file."""
    table = read_parquet(path, "trajectory table")
    attributes = text_attributes(path, table)
    if attributes.get("schema_version") == "1":  # of level bodies
        require_kind(path, table, attributes, _VERSION_1)
        for name in _TILT_FIELDS:
            table = table.append_column(name, pa.array(np.zeros(table.num_rows)))
    else:
        require_kind(path, table, attributes, TRAJECTORY)
    names = column(table, "robot")
    robots = tuple(dict.fromkeys(names.tolist()))
    if not robots:
        raise InputError(f"{path}: holds no rows")
    n_frames = len(names) // len(robots)
    iteration = np.tile(np.arange(n_frames), len(robots))
    time_s = column(table, "time_s")
    complete = (
        len(iteration) == len(names)
        and np.array_equal(column(table, "iteration"), iteration)
        and np.array_equal(names, np.repeat(np.array(robots, dtype=object), n_frames))
        and np.array_equal(time_s, np.tile(time_s[:n_frames], len(robots)))
    )
    if not complete:
        raise InputError(
            f"{path}: rows must be ordered by robot, then iteration 0, 1, 2, ..., "
            "at the same times for all robots"
        )
    tilt_rad = columns(table, _TILT_FIELDS).reshape(len(robots), n_frames, 2)
    try:
        return Trajectory(
            robots,
            time_s[:n_frames],
            columns(table, POSE_FIELDS).reshape(len(robots), n_frames, 3),
            columns(table, _WHEEL_FIELDS).reshape(len(robots), n_frames, 2),
            tilt_rad if tilt_rad.any() else None,
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


_IMU_TILT_RAD = 0.0052  # 0.3 degrees: inclinometer of a small IMU on a moving robot


@dataclass(frozen=True)
class BodySway:
    """Roll and pitch of a body on its suspension, about its origin on the floor.

    Both are Ornstein-Uhlenbeck processes.

    Attributes:
        sigma_rad: standard deviation of each angle; 0 for a rigid body.
        correlation_s: time after which the autocorrelation is 1/e.
    """

    sigma_rad: Annotated[float, Range(0, 0.15, "rad")] = 0.0
    correlation_s: Annotated[float, Range(1e-3, 3600, "s")] = 0.5

    def __post_init__(self) -> None:
        require_in_range(self)

    def tilts(self, time_s: Float, rng: np.random.Generator) -> Float:
        """Draw roll and pitch (T, 2) at times (T,)."""
        drawn = rng.standard_normal((len(time_s), 2))
        decays = np.exp(-np.diff(time_s) / self.correlation_s)
        tilt = np.array(drawn)
        for k, decay in enumerate(decays.tolist(), start=1):
            tilt[k] = decay * tilt[k - 1] + np.sqrt(1 - decay**2) * drawn[k]
        return self.sigma_rad * tilt


@dataclass(frozen=True)
class AttitudeNoise:
    """Measurement noise of roll and pitch of a robot whose body sways.

    Attributes:
        measured: True if the robot measures its attitude; else it assumes a level body.
        sigma_rad: standard deviation of each angle, independent between frames.
    """

    measured: bool = True
    sigma_rad: Annotated[float, Range(0, 1, "rad")] = _IMU_TILT_RAD

    def __post_init__(self) -> None:
        require_in_range(self)

    def applied(self, tilt_rad: Float, rng: np.random.Generator) -> Float:
        """Return measured roll and pitch, shape (T, 2)."""
        return tilt_rad + self.sigma_rad * rng.standard_normal(tilt_rad.shape)
