"""TUM trajectory files, and interpolation of timed poses.

One pose a line: time in seconds, position in metres, orientation as a quaternion with its real part
last (Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems").
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapfusion.datasets.text_files import NS, POSES, read_rows, read_time_series
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import require_finite, require_shape

_SAME_TIME_NS = 1_000  # a pose this near in time is the frame's own: what clocks are printed with


@dataclass(frozen=True)
class TimedPoses:
    """Poses of one body in one frame.

    Attributes:
        time_ns: (N,) int64, increasing.
        T: (N, 4, 4).
    """

    time_ns: np.ndarray
    T: Float

    def __post_init__(self) -> None:
        require_shape("T", self.T, (len(self.time_ns), 4, 4))
        require_finite("T", self.T)
        if np.any(np.diff(self.time_ns) <= 0):
            raise ValueError("time_ns: must increase")

    def moved(self, T_body_other: Float) -> "TimedPoses":
        """The poses of another body that is fixed to this one."""
        return TimedPoses(self.time_ns, self.T @ T_body_other)

    def at(self, time_ns: np.ndarray, longest_gap_s: float) -> Float:
        """Poses (T, 4, 4) at other times: the nearest within a microsecond, else between two.

        Between two the position is interpolated straight and the rotation at constant speed. NaN
        before the first, after the last and in gaps longer than `longest_gap_s`.
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
            share = (time_ns - self.time_ns[before])[rest] / gap_ns[rest]
            found[rest] = _between(self.T[before[rest]], self.T[after[rest]], share)
        return found


def _between(first: Float, second: Float, share: Float) -> Float:
    """Poses (N, 4, 4) at shares (N,) of the way from one to another."""
    from scipy.spatial.transform import Rotation

    made = np.array(first)
    made[:, :3, 3] += share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    turn = Rotation.from_matrix(first[:, :3, :3].swapaxes(1, 2) @ second[:, :3, :3])
    part = Rotation.from_rotvec(share[:, None] * turn.as_rotvec())
    made[:, :3, :3] = first[:, :3, :3] @ part.as_matrix()
    return made


# What lies under these names beside the pictures of a recording is read without being asked for.
ODOMETRY_FILE, TRUTH_FILE = "odometry.tum", "truth.tum"
_COLUMNS = "# timestamp_s tx_m ty_m tz_m qx qy qz qw"


def tum_text(time_s: Float, T_frame_robot: Float, about: str) -> str:
    """Poses (T, 3) in the plane or (T, 4, 4) at times (T,); unknown ones (NaN) are left out.

    Every number is written so that it is read back exactly.
    """
    in_space = T_frame_robot.ndim == 3
    require_shape("T_frame_robot", T_frame_robot, (len(time_s), *((4, 4) if in_space else (3,))))
    lines = (_lines_in_space if in_space else _lines)(time_s, T_frame_robot)
    return "\n".join([f"# {about}", _COLUMNS, *lines, ""])


def _lines(time_s: Float, T_frame_robot: Float) -> Iterator[str]:
    known = np.isfinite(T_frame_robot).all(axis=1)
    for when, (x, y, theta) in zip(time_s[known].tolist(), T_frame_robot[known], strict=True):
        qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
        yield f"{when} {float(x)} {float(y)} 0 0 0 {qz} {qw}"


def _lines_in_space(time_s: Float, T_frame_robot: Float) -> Iterator[str]:
    known = np.isfinite(T_frame_robot).all(axis=(1, 2))
    T = T_frame_robot[known]
    values = np.column_stack([time_s[known], T[:, :3, 3], se3.quaternions(T)])
    yield from (" ".join(map(str, row)) for row in values.tolist())


def read_tum(path: Path) -> TimedPoses:
    """A trajectory of the robot (x ahead, y left, z up) in whatever frame.

    Raises:
        InputError: the file is missing, damaged or foreign; names the line.
    """
    what, columns = "a trajectory in the TUM format", "time x y z qx qy qz qw"
    time_ns, values = read_time_series(path, what, columns, NS, formats=POSES)
    if not len(values):
        raise InputError(f"{path}: holds no pose")
    if not np.all(np.linalg.norm(values[:, 3:], axis=1) > 0):
        raise InputError(f"{path}: holds a quaternion of length 0")
    return TimedPoses(time_ns, se3.from_quaternions(values[:, :3], values[:, 3:]))


def read_odometry(path: Path) -> TimedPoses:
    """A trajectory by dead reckoning, of a robot that stands on a floor.

    Raises:
        InputError: as `read_tum`, or a pose stands on end or on its head; names the line.
    """
    poses = read_tum(path)
    fallen = np.flatnonzero(poses.T[:, 2, 2] <= 0)
    if len(fallen):
        lines = [line for line, _ in read_rows(path, "a trajectory in the TUM format")]
        line = lines[int(fallen[0])]
        remedy = "is the quaternion x y z w?"
        raise InputError(f"{path}, line {line}: the robot stands on its head; {remedy}")
    return poses
