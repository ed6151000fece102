"""RobotLog: all that one robot has measured, and, apart from it, the truth about that.

A log is a folder of Parquet tables (each readable with plain pandas):

- `frames.parquet`: one row an iteration, also those that saw nothing.
- `observations.parquet`: one row an observation, ordered by iteration.
- `truth_poses.parquet`, `truth_points.parquet`: optional; only the evaluation opens them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.arguments import require_finite, require_shape
from mapfusion.errors import InputError
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

DESCRIPTOR_LENGTH = 64
NO_LABEL = -1

FRAMES = schema(
    "robot_log.frames",
    1,
    [
        pa.field("iteration", pa.int32()),
        pa.field("time_s", pa.float64()),
        # motion since the row before, in the robot frame of the row before
        pa.field("odometry_x_m", pa.float64()),
        pa.field("odometry_y_m", pa.float64()),
        pa.field("odometry_theta_rad", pa.float64()),
    ],
)
OBSERVATIONS = schema(
    "robot_log.observations",
    1,
    [
        pa.field("iteration", pa.int32()),
        *point_fields(),  # in the robot frame
        pa.field("u_px", pa.float32()),  # left image; NaN where there are no images
        pa.field("v_px", pa.float32()),
        pa.field("disparity_px", pa.float32()),
        pa.field("label", pa.int32()),  # known identity, -1 for none
        pa.field("descriptor", pa.list_(pa.float32(), DESCRIPTOR_LENGTH)),  # NaN for none
    ],
)
TRUTH_POSES = schema(
    "robot_log.truth_poses",
    1,
    [
        pa.field("iteration", pa.int32()),
        pa.field("x_m", pa.float64()),  # T_world_robot; NaN where unknown
        pa.field("y_m", pa.float64()),
        pa.field("theta_rad", pa.float64()),
    ],
)
TRUTH_POINTS = schema(
    "robot_log.truth_points",
    1,
    [
        # row i is the point of the world that observation i shows; NaN where unknown
        pa.field("x_m", pa.float64()),
        pa.field("y_m", pa.float64()),
        pa.field("z_m", pa.float64()),
    ],
)


@dataclass(frozen=True)
class Observations:
    """Landmark sightings, of one frame or of a whole log.

    Attributes:
        position_m: (N, 3) in the robot frame.
        covariance_m2: (N, 3, 3), R_t of eq. 6 in Cartesian coordinates.
        descriptor: (N, 64) float32, or None.
        label: (N,) int32 known identities, or None.
        uvd_px: (N, 3) float32 u, v, disparity in the left image, or None.
    """

    position_m: Float
    covariance_m2: Float
    descriptor: np.ndarray | None = None
    label: np.ndarray | None = None
    uvd_px: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.position_m)
        require_shape("position_m", self.position_m, (n, 3))
        require_shape("covariance_m2", self.covariance_m2, (n, 3, 3))
        require_finite("position_m", self.position_m)
        require_finite("covariance_m2", self.covariance_m2)
        if self.descriptor is not None:
            require_shape("descriptor", self.descriptor, (n, DESCRIPTOR_LENGTH))
        if self.label is not None:
            require_shape("label", self.label, (n,))
        if self.uvd_px is not None:
            require_shape("uvd_px", self.uvd_px, (n, 3))

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: slice | np.ndarray) -> "Observations":
        return Observations(
            self.position_m[rows],
            self.covariance_m2[rows],
            None if self.descriptor is None else self.descriptor[rows],
            None if self.label is None else self.label[rows],
            None if self.uvd_px is None else self.uvd_px[rows],
        )


@dataclass(frozen=True)
class RobotLog:
    """One robot's measurements.

    Attributes:
        robot: its name.
        planar: range-and-bearing data; z is 0 and stays out of gates and weights.
        time_s: (T,).
        odometry: (T, 3) motion since the frame before, in the robot frame; the first row is zero.
        iteration: (N,) non-decreasing, the frame each observation belongs to.
        observations: N of them.
    """

    robot: str
    planar: bool
    time_s: Float
    odometry: Float
    iteration: np.ndarray
    observations: Observations

    def __post_init__(self) -> None:
        require_shape("odometry", self.odometry, (len(self.time_s), 3))
        require_shape("iteration", self.iteration, (len(self.observations),))
        require_finite("odometry", self.odometry)
        if np.any(np.diff(self.iteration) < 0):
            raise ValueError("iteration: observations must be ordered by iteration")
        if len(self.iteration) and not 0 <= self.iteration[0] <= self.iteration[-1] < len(self):
            raise ValueError(f"iteration: must lie in 0..{len(self) - 1}")

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.time_s)

    def frame_starts(self) -> np.ndarray:
        """(T + 1,) row of each frame's first observation."""
        return np.searchsorted(self.iteration, np.arange(len(self) + 1))


@dataclass(frozen=True)
class RobotTruth:
    """The truth about a log: `T_world_robot` (T, 3), `point_world_m` (N, 3); NaN where unknown."""

    T_world_robot: Float
    point_world_m: Float


def write_observations(folder: Path, iteration: np.ndarray, observations: Observations) -> None:
    """Write `observations.parquet` into a log's folder."""
    n = len(observations)
    uvd = observations.uvd_px if observations.uvd_px is not None else np.full((n, 3), np.nan)
    descriptor = observations.descriptor
    if descriptor is None:
        descriptor = np.full((n, DESCRIPTOR_LENGTH), np.nan)
    label = observations.label if observations.label is not None else np.full(n, NO_LABEL)
    write_table(
        folder / "observations.parquet",
        {
            "iteration": iteration.astype(np.int32),
            **point_columns(observations.position_m, observations.covariance_m2),
            "u_px": uvd[:, 0].astype(np.float32),
            "v_px": uvd[:, 1].astype(np.float32),
            "disparity_px": uvd[:, 2].astype(np.float32),
            "label": label.astype(np.int32),
            "descriptor": descriptor.astype(np.float32),
        },
        OBSERVATIONS,
    )


def read_observations(folder: Path) -> tuple[np.ndarray, Observations]:
    """Iterations (N,) and observations of a log's folder; raises InputError."""
    path = folder / "observations.parquet"
    table, _ = read_table(path, OBSERVATIONS)
    position, covariance = points_from(table)
    uvd = np.stack([column(table, name) for name in ("u_px", "v_px", "disparity_px")], -1)
    descriptor = column(table, "descriptor")
    label = column(table, "label")
    try:
        observations = Observations(
            position,
            covariance,
            None if np.isnan(descriptor).all() else descriptor,
            None if np.all(label == NO_LABEL) else label,
            None if np.isnan(uvd).all() else uvd,
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return column(table, "iteration"), observations


def write_frames(folder: Path, robot: str, planar: bool, time_s: Float, odometry: Float) -> None:
    """Write `frames.parquet` into a log's folder."""
    write_table(
        folder / "frames.parquet",
        {
            "iteration": np.arange(len(time_s), dtype=np.int32),
            "time_s": time_s,
            "odometry_x_m": odometry[:, 0],
            "odometry_y_m": odometry[:, 1],
            "odometry_theta_rad": odometry[:, 2],
        },
        FRAMES,
        {"robot": robot, "planar": str(planar).lower()},
    )


def write_log(folder: Path, log: RobotLog) -> None:
    """Write a whole log (without truth) into `folder`."""
    write_frames(folder, log.robot, log.planar, log.time_s, log.odometry)
    write_observations(folder, log.iteration, log.observations)


def read_log(folder: Path) -> RobotLog:
    """Read a log; raises InputError that names the file."""
    path = folder / "frames.parquet"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (expected a robot log with frames.parquet)")
    frames, attributes = read_table(path, FRAMES)
    iteration, observations = read_observations(folder)
    odometry_names = ("odometry_x_m", "odometry_y_m", "odometry_theta_rad")
    try:
        return RobotLog(
            robot=attributes.get("robot", folder.name),
            planar=attributes.get("planar") == "true",
            time_s=column(frames, "time_s"),
            odometry=np.stack([column(frames, name) for name in odometry_names], -1),
            iteration=iteration,
            observations=observations,
        )
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from error


def write_truth_points(folder: Path, point_world_m: Float) -> None:
    """Write `truth_points.parquet`: (N, 3), row i belongs to observation i."""
    write_table(
        folder / "truth_points.parquet",
        {name: point_world_m[:, i] for i, name in enumerate(("x_m", "y_m", "z_m"))},
        TRUTH_POINTS,
    )


def write_truth_poses(folder: Path, T_world_robot: Float) -> None:
    """Write `truth_poses.parquet`: (T, 3)."""
    write_table(
        folder / "truth_poses.parquet",
        {
            "iteration": np.arange(len(T_world_robot), dtype=np.int32),
            **{n: T_world_robot[:, i] for i, n in enumerate(("x_m", "y_m", "theta_rad"))},
        },
        TRUTH_POSES,
    )


def read_truth(folder: Path) -> RobotTruth:
    """Read the truth beside a log; raises InputError. For evaluation only."""
    poses, _ = read_table(folder / "truth_poses.parquet", TRUTH_POSES)
    points, _ = read_table(folder / "truth_points.parquet", TRUTH_POINTS)
    return RobotTruth(
        np.stack([column(poses, name) for name in ("x_m", "y_m", "theta_rad")], -1),
        np.stack([column(points, name) for name in ("x_m", "y_m", "z_m")], -1),
    )
