"""UTIAS MRCLAM recordings as robot logs.

Leung, Halpern, Barfoot, Liu (2011), "The UTIAS multi-robot cooperative localization and mapping
dataset": robots that know each landmark by a barcode and measure its range and bearing. Text files,
a table each, lines that start with # are comments:

- `Barcodes.dat`: subject, barcode.
- `Landmark_Groundtruth.dat`: subject, x_m, y_m, two standard deviations.
- `RobotN_Odometry.dat`: time_s, forward velocity (m/s), angular velocity (rad/s).
- `RobotN_Measurement.dat`: time_s, barcode, range_m, bearing_rad.
- `RobotN_Groundtruth.dat`: time_s, x_m, y_m, theta_rad; it has gaps.

Subjects 1 to 5 are the robots themselves; the others are landmarks.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapfusion.errors import InputError
from mapfusion.robot_log import (
    Observations,
    RobotLog,
    write_log,
    write_truth_points,
    write_truth_poses,
)
from mapfusion.se2 import Float, between, compose, rotation, wrap

_LAST_ROBOT_SUBJECT = 5


@dataclass(frozen=True)
class MrclamSettings:
    """How a recording becomes logs.

    Attributes:
        frame_s: time from frame to frame, on one clock for all robots. The cameras gave a picture
            about every 0.23 s; a shorter frame holds a landmark at most once.
        range_sigma_m: standard deviation of a range.
        bearing_sigma_rad: standard deviation of a bearing.
        longest_truth_gap_s: the truth is interpolated over gaps up to this, unknown in longer ones.
    """

    frame_s: float = 0.2
    range_sigma_m: float = 0.25
    bearing_sigma_rad: float = 0.08
    longest_truth_gap_s: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: is {value}, must be finite and positive")


def import_mrclam(
    folder: Path, destination: Path, settings: MrclamSettings | None = None
) -> list[Path]:
    """Write one log, with its truth, for each robot of a recording.

    Args:
        folder: the unpacked recording.
        destination: where the logs go, each a folder `robotN`.
        settings: frame rate and noise.

    Returns:
        The logs' folders, by robot.

    Raises:
        InputError: a file is missing, damaged or foreign; names file and line.
    """
    settings = settings or MrclamSettings()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (expected an MRCLAM recording)")
    subject_of_barcode = _barcodes(folder / "Barcodes.dat")
    landmarks = _landmarks(folder / "Landmark_Groundtruth.dat")
    numbers = _robots(folder)
    odometry = {n: _timed(folder / f"Robot{n}_Odometry.dat", 3) for n in numbers}
    first_s = min(table[0, 0] for table in odometry.values())
    last_s = max(table[-1, 0] for table in odometry.values())
    clock_s = first_s + settings.frame_s * np.arange(
        int(np.ceil((last_s - first_s) / settings.frame_s)) + 1
    )
    written = []
    for n in numbers:
        sighted = _sightings(folder / f"Robot{n}_Measurement.dat", subject_of_barcode, landmarks)
        log = _log(f"robot{n}", odometry[n], sighted, clock_s, settings)
        truth = _timed(folder / f"Robot{n}_Groundtruth.dat", 4)
        path = destination / log.robot
        write_log(path, log)
        write_truth_poses(path, _truth_at(clock_s, truth, settings.longest_truth_gap_s))
        assert log.observations.label is not None
        points = np.array([landmarks[int(subject)] for subject in log.observations.label])
        write_truth_points(path, points.reshape(-1, 3))
        written.append(path)
    return written


def _log(
    robot: str, odometry: Float, sighted: Float, clock_s: Float, settings: MrclamSettings
) -> RobotLog:
    """Frames on the clock; each sighting goes to the next frame, moved there with the odometry."""
    T_start_frame = _dead_reckoned(odometry, clock_s)
    frame = np.searchsorted(clock_s, sighted[:, 0])
    inside = frame < len(clock_s)
    sighted, frame = sighted[inside], frame[inside]
    position, covariance = _cartesian(
        sighted[:, 2], sighted[:, 3], settings.range_sigma_m, settings.bearing_sigma_rad
    )
    T_frame_sighting = between(T_start_frame[frame], _dead_reckoned(odometry, sighted[:, 0]))
    turn = rotation(T_frame_sighting[:, 2])
    position[:, :2] = np.einsum("nij,nj->ni", turn, position[:, :2]) + T_frame_sighting[:, :2]
    covariance[:, :2, :2] = turn @ covariance[:, :2, :2] @ np.swapaxes(turn, 1, 2)
    increments = np.zeros((len(clock_s), 3))
    increments[1:] = between(T_start_frame[:-1], T_start_frame[1:])
    return RobotLog(
        robot=robot,
        planar=True,
        time_s=clock_s - clock_s[0],
        odometry=increments,
        iteration=frame,
        observations=Observations(position, covariance, label=sighted[:, 1].astype(np.int32)),
    )


def _cartesian(
    range_m: Float, bearing_rad: Float, range_sigma_m: float, bearing_sigma_rad: float
) -> tuple[Float, Float]:
    """Points (N, 3) of the robot frame and covariances (N, 3, 3), to first order in the noise."""
    direction = rotation(bearing_rad)
    position = np.zeros((len(range_m), 3))
    position[:, :2] = range_m[:, None] * direction[:, :, 0]
    along_and_across = np.zeros((len(range_m), 2, 2))
    along_and_across[:, 0, 0] = range_sigma_m**2
    along_and_across[:, 1, 1] = (range_m * bearing_sigma_rad) ** 2
    covariance = np.zeros((len(range_m), 3, 3))
    covariance[:, :2, :2] = direction @ along_and_across @ np.swapaxes(direction, 1, 2)
    return position, covariance


def _dead_reckoned(odometry: Float, time_s: Float) -> Float:
    """Poses (N, 3) at times (N,): each velocity holds until the next one, along an arc.

    Before the first velocity the robot stands.
    """
    duration = np.diff(odometry[:, 0])
    steps = _arc(odometry[:-1, 1], odometry[:-1, 2], duration)
    nodes = np.zeros((len(odometry), 3))
    # A chain of poses is a sum once each step is turned by the heading before it.
    nodes[1:, 2] = np.cumsum(steps[:, 2])
    turned = np.einsum("nij,nj->ni", rotation(nodes[:-1, 2]), steps[:, :2])
    nodes[1:, :2] = np.cumsum(turned, axis=0)
    row = np.searchsorted(odometry[:, 0], time_s, side="right") - 1
    begun = row >= 0
    row = np.maximum(row, 0)
    since_s = np.where(begun, time_s - odometry[row, 0], 0.0)
    return compose(nodes[row], _arc(odometry[row, 1], odometry[row, 2], since_s))


def _arc(speed_m_s: Float, turn_rad_s: Float, duration_s: Float) -> Float:
    """Motion (N, 3) at constant velocities."""
    angle = turn_rad_s * duration_s
    # sinc is exact through zero: chord = length sin(a/2) / (a/2), along half the angle.
    chord = speed_m_s * duration_s * np.sinc(angle / (2 * np.pi))
    return np.stack([chord * np.cos(angle / 2), chord * np.sin(angle / 2), angle], -1)


def _truth_at(clock_s: Float, truth: Float, longest_gap_s: float) -> Float:
    """True poses (T, 3) on the clock, NaN where the truth has a longer gap or has ended."""
    row = np.clip(np.searchsorted(truth[:, 0], clock_s, side="right") - 1, 0, len(truth) - 2)
    before, after = truth[row], truth[row + 1]
    gap_s = after[:, 0] - before[:, 0]
    share = (clock_s - before[:, 0]) / np.where(gap_s > 0, gap_s, 1.0)
    pose = before[:, 1:] + share[:, None] * (after[:, 1:] - before[:, 1:])
    pose[:, 2] = wrap(before[:, 3] + share * wrap(after[:, 3] - before[:, 3]))
    known = (share >= 0) & (share <= 1) & (gap_s <= longest_gap_s)
    return np.where(known[:, None], pose, np.nan)


def _robots(folder: Path) -> list[int]:
    found = [re.fullmatch(r"Robot(\d+)_Odometry\.dat", path.name) for path in folder.iterdir()]
    numbers = sorted(int(match[1]) for match in found if match)
    if not numbers:
        raise InputError(f"{folder}: no RobotN_Odometry.dat (expected an MRCLAM recording)")
    return numbers


def _barcodes(path: Path) -> dict[int, int]:
    return {int(barcode): int(subject) for subject, barcode in _table(path, 2)}


def _landmarks(path: Path) -> dict[int, Float]:
    return {int(row[0]): np.array([row[1], row[2], 0.0]) for row in _table(path, 5)}


def _sightings(
    path: Path, subject_of_barcode: dict[int, int], landmarks: dict[int, Float]
) -> Float:
    """Rows (N, 4) time_s, subject, range_m, bearing_rad of landmarks; other robots are left out."""
    table = _timed(path, 4)
    subject = np.array([subject_of_barcode.get(int(barcode), -1) for barcode in table[:, 1]])
    table[:, 1] = subject
    return table[(subject > _LAST_ROBOT_SUBJECT) & np.isin(subject, list(landmarks))]


def _timed(path: Path, n_columns: int) -> Float:
    """A table in the order of its times; needs two rows."""
    table = _table(path, n_columns)
    if len(table) < 2:
        raise InputError(f"{path}: has {len(table)} rows, expected at least 2")
    return table[np.argsort(table[:, 0], kind="stable")]


def _table(path: Path, n_columns: int) -> Float:
    """Numbers (N, n_columns) of a text file."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file (part of an MRCLAM recording)") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable text file") from error
    rows = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != n_columns:
            raise InputError(
                f"{path}, line {number}: has {len(words)} columns, expected {n_columns}"
            )
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise InputError(f"{path}, line {number}: not a number in {line.strip()!r}") from error
        if not np.all(np.isfinite(row)):
            raise InputError(f"{path}, line {number}: not a finite number in {line.strip()!r}")
        rows.append(row)
    return np.array(rows).reshape(-1, n_columns)
