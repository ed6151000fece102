"""Trajectories in the TUM format, as evo and others read and write them.

One pose a line: time in seconds, position in metres, orientation as a quaternion with its real part
last (Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems").
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapfusion import se3
from mapfusion.arguments import require_shape
from mapfusion.errors import InputError
from mapfusion.recordings.text_tables import NS, POSES, rows_of, timed_numbers
from mapfusion.recordings.timed_poses import TimedPoses
from mapfusion.se2 import Float

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
    time_ns, values = timed_numbers(path, what, columns, NS, formats=POSES)
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
        lines = [line for line, _ in rows_of(path, "a trajectory in the TUM format")]
        line = lines[int(fallen[0])]
        remedy = "is the quaternion x y z w?"
        raise InputError(f"{path}, line {line}: the robot stands on its head; {remedy}")
    return poses
