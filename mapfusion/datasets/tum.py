"""TUM trajectory files and interpolation of timed poses.

A line holds one pose: time in seconds, position in metres, orientation as a quaternion with the
real part last (Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems").
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapfusion.datasets.text_files import NS, POSES, read_rows, read_time_series
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import require_finite, require_shape

_SAME_TIME_NS = 1_000  # resolution of printed times: a pose this close is not interpolated
# Files of these names beside the pictures of a recording are read automatically.
ODOMETRY_FILE, TRUTH_FILE = "odometry.tum", "truth.tum"
_COLUMNS = "# timestamp_s tx_m ty_m tz_m qx qy qz qw"


@dataclass(frozen=True)
class TimedPoses:
    """Poses of one body in one frame.

    Attributes:
        time_ns: increasing times, shape (N,), int64.
        T: poses, shape (N, 4, 4).
    """

    time_ns: np.ndarray
    T: Float

    def __post_init__(self) -> None:
        require_shape("T", self.T, (len(self.time_ns), 4, 4))
        require_finite("T", self.T)
        if np.any(np.diff(self.time_ns) <= 0):
            raise ValueError("time_ns: must increase")

    def moved(self, T_body_other: Float) -> "TimedPoses":
        """Return the poses of another body that is fixed to this one."""
        return TimedPoses(self.time_ns, self.T @ T_body_other)

    def at(self, time_ns: np.ndarray, longest_gap_s: float) -> Float:
        """Return poses at other times, shape (T, 4, 4).

        A pose within a microsecond is returned as it is. Other poses are interpolated: positions
        linearly, rotations at constant angular velocity. Poses are NaN before the first time, after
        the last time and in gaps longer than `longest_gap_s`.
        """
        found = np.full((len(time_ns), 4, 4), np.nan)
        if not len(self.time_ns):
            return found
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, max(len(self.time_ns) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.time_ns) - 1)
        own = np.where(
            np.abs(self.time_ns[before] - time_ns) < np.abs(self.time_ns[after] - time_ns),
            before,
            after,
        )
        same = np.abs(self.time_ns[own] - time_ns) <= _SAME_TIME_NS
        found[same] = self.T[own[same]]
        gap_ns = self.time_ns[after] - self.time_ns[before]
        inside = (self.time_ns[before] <= time_ns) & (time_ns <= self.time_ns[after])
        rest = np.flatnonzero(~same & inside & (gap_ns <= 1e9 * longest_gap_s))
        if len(rest):
            from scipy.spatial.transform import Rotation

            share = (time_ns - self.time_ns[before])[rest] / gap_ns[rest]
            first, second = self.T[before[rest]], self.T[after[rest]]
            between = np.array(first)
            between[:, :3, 3] += share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
            turn = Rotation.from_matrix(first[:, :3, :3].swapaxes(1, 2) @ second[:, :3, :3])
            part = Rotation.from_rotvec(share[:, None] * turn.as_rotvec())
            between[:, :3, :3] = first[:, :3, :3] @ part.as_matrix()
            found[rest] = between
        return found


def tum_text(time_s: Float, T_frame_robot: Float, about: str) -> str:
    """Return poses (T, 3) or (T, 4, 4) at times (T,) in the TUM format.

    Unknown poses (NaN) are left out. Reading the text restores every number exactly.

    Args:
        time_s: times, shape (T,).
        T_frame_robot: planar poses, shape (T, 3), or poses in space, shape (T, 4, 4).
        about: comment in the first line.
    """
    if T_frame_robot.ndim == 3:
        require_shape("T_frame_robot", T_frame_robot, (len(time_s), 4, 4))
        known = np.isfinite(T_frame_robot).all(axis=(1, 2))
        T = T_frame_robot[known]
        values = np.column_stack([time_s[known], T[:, :3, 3], se3.quaternions(T)])
        lines = [" ".join(map(str, row)) for row in values.tolist()]
    else:
        require_shape("T_frame_robot", T_frame_robot, (len(time_s), 3))
        known = np.isfinite(T_frame_robot).all(axis=1)
        lines = []
        for when, (x, y, theta) in zip(time_s[known].tolist(), T_frame_robot[known], strict=True):
            qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
            lines.append(f"{when} {float(x)} {float(y)} 0 0 0 {qz} {qw}")
    return "\n".join([f"# {about}", _COLUMNS, *lines, ""])


def read_tum(path: Path) -> TimedPoses:
    """Read a trajectory of the robot (x ahead, y left, z up) in any frame.

    Raises:
        InputError: the file is missing, damaged or of another format; the message names the line.
    """
    what, columns = "a trajectory in the TUM format", "time x y z qx qy qz qw"
    time_ns, values = read_time_series(path, what, columns, NS, formats=POSES)
    if not len(values):
        raise InputError(f"{path}: holds no pose")
    if not np.all(np.linalg.norm(values[:, 3:], axis=1) > 0):
        raise InputError(f"{path}: holds a quaternion of length 0")
    return TimedPoses(time_ns, se3.from_quaternions(values[:, :3], values[:, 3:]))


def read_odometry(path: Path) -> TimedPoses:
    """Read a dead-reckoned trajectory of a robot on a floor.

    Raises:
        InputError: as `read_tum`, or the robot is upside down; the message names the line.
    """
    poses = read_tum(path)
    fallen = np.flatnonzero(poses.T[:, 2, 2] <= 0)
    if len(fallen):
        lines = [line for line, _ in read_rows(path, "a trajectory in the TUM format")]
        line = lines[int(fallen[0])]
        remedy = "is the quaternion x y z w?"
        raise InputError(f"{path}, line {line}: the robot stands on its head; {remedy}")
    return poses
