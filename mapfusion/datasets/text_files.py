"""Text files of recordings: tables with times, and trajectories in the TUM format.

Errors name file and line. A line of a TUM trajectory holds one pose: time in seconds, position in
metres, orientation as a quaternion with the real part last (Sturm et al. 2012, "A benchmark for the
evaluation of RGB-D SLAM systems").
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se2 import rotation_about_z

NS = 1_000_000_000  # nanoseconds in a second
_LATEST_NS = 2**62  # the year 2116, from 1970; the sum of two times fits 64 bits
_MAX_VALUE = 1e12  # of any number
# Pose formats by their number of columns, which are often confused.
POSES = {8: "TUM's poses have 8", 12: "KITTI's poses have 12", 17: "EuRoC's true states have 17"}
_SEPARATORS = {",": "commas", ";": "semicolons", None: "spaces"}


def read_rows(
    path: Path, what: str, separator: str | None = None
) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and words of each line that is neither empty nor a comment (#).

    Args:
        path: text file.
        what: contents of the file, for messages.
        separator: separator of the words; None for white space.

    Raises:
        InputError: the file is missing or no text file.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file ({what})") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable text file ({what})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = [word.strip() for word in line.split(separator)]
        if any(words) and not words[0].startswith("#"):
            yield number, words


def require_columns(
    path: Path,
    line: int,
    words: list[str],
    columns: str,
    formats: Mapping[int, str] | None = None,
    more: bool = False,
) -> None:
    """Raise InputError if a line has a wrong number of columns.

    Args:
        path: text file, for messages.
        line: line number, for messages.
        words: all words of the line.
        columns: names of the columns, separated by spaces.
        formats: hints at other formats by their number of columns.
        more: further columns may follow.
    """
    n, wanted = len(words), len(columns.split())
    if n == wanted or (more and n > wanted):
        return
    hint = f"; {formats[n]}" if formats and n in formats else ""
    for separator, separator_name in _SEPARATORS.items():
        parts = " ".join(words).split(separator)
        if n < wanted <= len(parts) and (more or len(parts) == wanted):
            hint = f"; its columns are separated by {separator_name}"
    or_more = " or more" if more else ""
    raise InputError(
        f"{path}, line {line}: has {n} columns, expected {wanted}{or_more} ({columns}){hint}"
    )


def parse_numbers(path: Path, line: int, words: list[str]) -> list[float]:
    """Parse the numbers of a line; raise InputError for other words or huge numbers."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{path}, line {line}: not a number in {' '.join(words)!r}") from None
    if not all(abs(number) <= _MAX_VALUE for number in numbers):  # NaN is not
        raise InputError(f"{path}, line {line}: not finite, or above {_MAX_VALUE:g}")
    return numbers


def parse_time_ns(path: Path, line: int, word: str, unit_ns: int) -> int:
    """Parse a time in units of `unit_ns` nanoseconds; return nanoseconds or raise InputError."""
    try:
        exact = Decimal(word) * unit_ns
        time_ns = int(exact.to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise InputError(f"{path}, line {line}: {word!r} is no time") from None
    if abs(time_ns) > _LATEST_NS:
        raise InputError(f"{path}, line {line}: {word} is beyond all clocks; another unit?")
    if unit_ns == 1 and exact != time_ns:
        reason = "must be a whole number of nanoseconds; is it in seconds or another unit?"
        raise InputError(f"{path}, line {line}: time {word} {reason}")
    return time_ns


def require_increasing(path: Path, lines: list[int], time_ns: np.ndarray) -> None:
    """Raise InputError for the first line whose time does not increase."""
    not_increasing = np.flatnonzero(np.diff(time_ns) <= 0)
    if len(not_increasing):
        k = int(not_increasing[0]) + 1
        step_s = (int(time_ns[k]) - int(time_ns[k - 1])) / NS
        problem = "repeats the time before" if step_s == 0 else f"runs back by {-step_s:g} s"
        unit = "; are they rounded, or in another unit?" if step_s == 0 else ""
        raise InputError(f"{path}, line {lines[k]}: {problem}; times must increase{unit}")


def read_time_series(
    path: Path,
    what: str,
    columns: str,
    unit_ns: int,
    separator: str | None = None,
    formats: Mapping[int, str] | None = None,
    more: bool = False,
) -> tuple[np.ndarray, Float]:
    """Read a table of times and numbers; the times must increase.

    Args:
        path: text file.
        what: contents of the file, for messages.
        columns: names of the columns, separated by spaces; the first one is the time.
        unit_ns: unit of the time in nanoseconds.
        separator: separator of the columns; None for white space.
        formats: hints at other formats by their number of columns.
        more: further columns may follow, which are ignored.

    Returns:
        Times in ns, shape (N,), int64, and the other columns, shape (N, n).

    Raises:
        InputError: the file is missing or damaged; the message names file and line.
    """
    wanted = len(columns.split())
    lines, times, values = [], [], []
    for line, words in read_rows(path, what, separator):
        require_columns(path, line, words, columns, formats, more)
        lines.append(line)
        times.append(parse_time_ns(path, line, words[0], unit_ns))
        values.append(parse_numbers(path, line, words[1:wanted]))
    time_ns = np.array(times, dtype=np.int64)
    require_increasing(path, lines, time_ns)
    return time_ns, np.array(values, dtype=np.float64).reshape(len(lines), wanted - 1)


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
        poses = np.full((len(time_ns), 4, 4), np.nan)
        if not len(self.time_ns):
            return poses
        index_after = np.clip(
            np.searchsorted(self.time_ns, time_ns), 1, max(len(self.time_ns) - 1, 1)
        )
        index_before = index_after - 1
        index_after = np.minimum(index_after, len(self.time_ns) - 1)
        nearest = np.where(
            np.abs(self.time_ns[index_before] - time_ns)
            < np.abs(self.time_ns[index_after] - time_ns),
            index_before,
            index_after,
        )
        is_same_time = np.abs(self.time_ns[nearest] - time_ns) <= _SAME_TIME_NS
        poses[is_same_time] = self.T[nearest[is_same_time]]
        gap_ns = self.time_ns[index_after] - self.time_ns[index_before]
        inside = (self.time_ns[index_before] <= time_ns) & (time_ns <= self.time_ns[index_after])
        interpolated = np.flatnonzero(~is_same_time & inside & (gap_ns <= 1e9 * longest_gap_s))
        if len(interpolated):
            from scipy.spatial.transform import Rotation

            fraction = (time_ns - self.time_ns[index_before])[interpolated] / gap_ns[interpolated]
            first, second = self.T[index_before[interpolated]], self.T[index_after[interpolated]]
            between = np.array(first)
            between[:, :3, 3] += fraction[:, None] * (second[:, :3, 3] - first[:, :3, 3])
            turn = Rotation.from_matrix(first[:, :3, :3].swapaxes(1, 2) @ second[:, :3, :3])
            part = Rotation.from_rotvec(fraction[:, None] * turn.as_rotvec())
            between[:, :3, :3] = first[:, :3, :3] @ part.as_matrix()
            poses[interpolated] = between
        return poses


def tum_text(time_s: Float, T_frame_robot: Float, comment: str) -> str:
    """Return poses (T, 3) or (T, 4, 4) at times (T,) in the TUM format.

    Unknown poses (NaN) are left out. Reading the text restores every number exactly.

    Args:
        time_s: times, shape (T,).
        T_frame_robot: planar poses, shape (T, 3), or poses in space, shape (T, 4, 4).
        comment: comment in the first line.
    """
    if T_frame_robot.ndim == 3:
        require_shape("T_frame_robot", T_frame_robot, (len(time_s), 4, 4))
        is_known = np.isfinite(T_frame_robot).all(axis=(1, 2))
        T = T_frame_robot[is_known]
        values = np.column_stack([time_s[is_known], T[:, :3, 3], se3.quaternions(T)])
        lines = [" ".join(map(str, row)) for row in values.tolist()]
    else:
        require_shape("T_frame_robot", T_frame_robot, (len(time_s), 3))
        is_known = np.isfinite(T_frame_robot).all(axis=1)
        lines = []
        for pose_time_s, (x, y, theta) in zip(
            time_s[is_known].tolist(), T_frame_robot[is_known], strict=True
        ):
            qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
            lines.append(f"{pose_time_s} {float(x)} {float(y)} 0 0 0 {qz} {qw}")
    return "\n".join([f"# {comment}", _COLUMNS, *lines, ""])


# Standard deviations that are added in each direction of a pose in space (m or rad). A planar pose
# has no errors of height, roll and pitch, and the first pose of a path has none at all, but a
# scorer inverts the covariances.
_LEAST_SIGMA = 1e-4
_IN_PLAN = [0, 1, 5]  # x, y and yaw among the six directions of a pose in space


def tum_covariance_text(time_s: Float, T_frame_robot: Float, covariance: Float) -> str:
    """Return covariances of planar poses as a sidecar of a TUM file, in the layout of smfeval.

    Each line has a time and the lower triangle of the covariance of a perturbation T Exp(xi) in the
    frame of the robot; xi has the translation first.

    Args:
        time_s: times, shape (T,).
        T_frame_robot: poses, shape (T, 3).
        covariance: covariances of x, y and theta in the frame of the path, shape (T, 3, 3).
    """
    require_shape("covariance", covariance, (len(time_s), 3, 3))
    to_robot = np.swapaxes(rotation_about_z(T_frame_robot[:, 2]), 1, 2)
    in_space = np.tile(_LEAST_SIGMA**2 * np.eye(6), (len(time_s), 1, 1))
    block = np.ix_(range(len(time_s)), _IN_PLAN, _IN_PLAN)
    in_space[block] += to_robot @ covariance @ np.swapaxes(to_robot, 1, 2)
    rows = np.column_stack([time_s, in_space[:, *np.tril_indices(6)]])
    head = ["#%TANGENT_CONVENTION right_perturbation", "#%TANGENT_ORDER translation_rotation"]
    return "\n".join([*head, *(" ".join(map(str, row)) for row in rows.tolist()), ""])


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


def read_odometry_beside(folder: Path) -> TimedPoses | None:
    """Read `odometry.tum` in the folder of a recording; None if there is none."""
    path = folder / ODOMETRY_FILE
    return read_odometry(path) if path.exists() else None


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
