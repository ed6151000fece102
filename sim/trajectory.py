"""Trajectory: where robots truly were and what their wheel encoders read, as arrays and a file.

Any other source of poses may stand in for the driver: a Parquet table with one row per robot and
iteration, ordered by robot, then iteration, readable and writable with plain pandas.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.arguments import require_finite, require_shape
from mapfusion.errors import InputError
from mapfusion.se2 import Float
from mapfusion.storage import (
    POSE_FIELDS,
    column,
    columns,
    float_fields,
    named_columns,
    read_table,
    schema,
    write_table,
)

_WHEEL_FIELDS = ["left_wheel_rad", "right_wheel_rad"]
TRAJECTORY = schema(
    "trajectory",
    1,
    [
        pa.field("robot", pa.string()),
        pa.field("iteration", pa.int32()),
        pa.field("time_s", pa.float64()),
        *float_fields(POSE_FIELDS),  # T_world_robot
        *float_fields(_WHEEL_FIELDS),  # encoders since the start, mean of the wheels of a side
    ],
)


@dataclass(frozen=True)
class Trajectory:
    """R robots at T moments.

    Attributes:
        robots: R names.
        time_s: (T,) since the start, increasing.
        T_world_robot: (R, T, 3) true poses.
        wheel_rad: (R, T, 2) left and right encoder angles since the start.
    """

    robots: tuple[str, ...]
    time_s: Float
    T_world_robot: Float
    wheel_rad: Float

    def __post_init__(self) -> None:
        n_robots, n_frames = len(self.robots), len(self.time_s)
        require_shape("T_world_robot", self.T_world_robot, (n_robots, n_frames, 3))
        require_shape("wheel_rad", self.wheel_rad, (n_robots, n_frames, 2))
        for name in ("time_s", "T_world_robot", "wheel_rad"):
            require_finite(name, getattr(self, name))
        if len(set(self.robots)) != n_robots:
            raise ValueError(f"robots: a name occurs twice in {', '.join(self.robots)}")
        if np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s: must increase")

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.time_s)

    def index(self, robot: str) -> int:
        """Row of a robot; raises InputError that lists the known names."""
        if robot not in self.robots:
            raise InputError(f"robot {robot}: unknown, there are {', '.join(self.robots)}")
        return self.robots.index(robot)


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory to one file."""
    n_robots, n_frames = len(trajectory.robots), len(trajectory)
    write_table(
        path,
        {
            "robot": np.repeat(np.array(trajectory.robots, dtype=object), n_frames),
            "iteration": np.tile(np.arange(n_frames, dtype=np.int32), n_robots),
            "time_s": np.tile(trajectory.time_s, n_robots),
            **named_columns(POSE_FIELDS, trajectory.T_world_robot.reshape(-1, 3)),
            **named_columns(_WHEEL_FIELDS, trajectory.wheel_rad.reshape(-1, 2)),
        },
        TRAJECTORY,
    )


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory; raises InputError that names the file."""
    table, _ = read_table(path, TRAJECTORY)
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
    try:
        return Trajectory(
            robots,
            time_s[:n_frames],
            columns(table, POSE_FIELDS).reshape(len(robots), n_frames, 3),
            columns(table, _WHEEL_FIELDS).reshape(len(robots), n_frames, 2),
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
