"""UTIAS MRCLAM recordings as robot logs.

Leung, Halpern, Barfoot, Liu (2011), "The UTIAS multi-robot cooperative localization and mapping
dataset": robots that know each landmark by a barcode and measure its range and bearing. Text files,
a table each, lines that start with # are comments:

- `Barcodes.dat`: subject, barcode.
- `Landmark_Groundtruth.dat`: subject, x_m, y_m, two standard deviations; optional.
- `RobotN_Odometry.dat`: time_s, forward velocity (m/s), angular velocity (rad/s).
- `RobotN_Measurement.dat`: time_s, barcode, range_m, bearing_rad.
- `RobotN_Groundtruth.dat`: time_s, x_m, y_m, theta_rad; optional; it has gaps.

A log has the truth that the recording has: true poses, true points, both or none. Subjects 1 to 5
are the robots themselves; the others are landmarks.
"""

import re
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from mapfusion.errors import InputError
from mapfusion.geometry.camera import CalibrationError
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose, rotation, wrap
from mapfusion.robot_log import (
    TRUTH_FILES,
    Observations,
    RobotLog,
    write_log,
    write_truth_points,
    write_truth_poses,
)

_LAST_ROBOT_SUBJECT = 5
_LARGEST = 1e12  # any number: times since 1970 are 1e9 s
_CAMERA = "MRCLAM"  # one make of robot and camera, calibrated once, before one print of barcodes
_MAY_BE_NONE = ("range_sigma_ratio", "range_scale_sigma")
_MOST_FRAMES = 1_000_000  # eleven days of one a second


@dataclass(frozen=True)
class MrclamSettings:
    """How a recording becomes logs.

    The noise is about twice that of dataset 7 against its truth: errors come from the view of a
    barcode and stay while the view lasts, and the filter takes each for news.

    Attributes:
        frame_s: time from frame to frame, on one clock for all robots. A frame keeps the last
            sighting of each landmark. The cameras gave four a second, whose errors were alike:
            using them all makes the filter sure of its first errors.
        range_sigma_m: standard deviation of a range, the part that is always there.
        range_sigma_ratio: the part that grows with the range: it is measured by the size of the
            barcode in the picture, which shrinks.
        bearing_sigma_rad: standard deviation of a bearing.
        range_scale_sigma: of what all ranges of all robots are off by alike, as a share: a
            barcode's edges that are found half a pixel outside it make fifty pixels fifty-one.
            Odometry does not tell, since its own scale is taken from the ranges.
        longest_truth_gap_s: the truth is interpolated over gaps up to this, unknown in longer ones.
    """

    frame_s: float = 1.0
    range_sigma_m: float = 0.15
    range_sigma_ratio: float = 0.08
    bearing_sigma_rad: float = 0.05
    range_scale_sigma: float = 0.01
    longest_truth_gap_s: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = value > 0 or (value == 0 and name in _MAY_BE_NONE)
            if not (np.isfinite(value) and positive):
                raise ValueError(f"{name}: is {value}, must be finite and positive")

    def range_sigma(self, range_m: Float) -> Float:
        """Standard deviation of ranges (N,)."""
        return np.hypot(self.range_sigma_m, self.range_sigma_ratio * range_m)


def import_mrclam(
    folder: Path, destination: Path, settings: MrclamSettings | None = None
) -> list[Path]:
    """Write one log, with its truth where that is recorded, for each robot of a recording.

    Logs go to folders `robotN` of `destination`; they are returned by robot.

    Raises:
        InputError: a file is missing, damaged or foreign; names file and line. Nothing is written
            then.
    """
    settings = settings or MrclamSettings()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (expected an MRCLAM recording)")
    numbers = _robots(folder)
    subject_of_barcode = _barcodes(folder / "Barcodes.dat")
    surveyed = folder / "Landmark_Groundtruth.dat"
    landmarks = _landmarks(surveyed) if surveyed.exists() else None
    recordings = [
        (
            f"robot{n}",
            _timed(folder / f"Robot{n}_Odometry.dat", 3),
            _sightings(folder / f"Robot{n}_Measurement.dat", subject_of_barcode, landmarks),
            _timed(path, 4) if (path := folder / f"Robot{n}_Groundtruth.dat").exists() else None,
        )
        for n in numbers
    ]
    first_s = min(odometry[0, 0] for _, odometry, _, _ in recordings)
    last_s = max(odometry[-1, 0] for _, odometry, _, _ in recordings)
    n_frames = _n_frames(folder, last_s - first_s, settings.frame_s)
    clock_s = first_s + settings.frame_s * np.arange(n_frames)
    for robot, _, _, truth in recordings:
        if truth is not None and (truth[-1, 0] < first_s or truth[0, 0] > last_s):
            spans = f"{truth[0, 0]:.3f} to {truth[-1, 0]:.3f} s, odometry of {first_s:.3f} to"
            path = folder / f"{robot.capitalize()}_Groundtruth.dat"
            raise InputError(f"{path}: the truth is of {spans} {last_s:.3f} s; no time is in both")
    written = []
    for robot, odometry, sighted, truth in recordings:
        path = destination / robot
        log = _log(robot, odometry, sighted, clock_s, settings)
        write_log(path, log)
        for outdated in TRUTH_FILES:  # of an import into the same folder
            (path / outdated).unlink(missing_ok=True)
        if truth is not None:
            write_truth_poses(path, _truth_at(clock_s, truth, settings.longest_truth_gap_s))
        if landmarks is not None:
            assert log.observations.label is not None
            points = np.array([landmarks[int(subject)] for subject in log.observations.label])
            write_truth_points(path, points.reshape(-1, 3))
        written.append(path)
    return written


def _log(
    robot: str, odometry: Float, sighted: Float, clock_s: Float, settings: MrclamSettings
) -> RobotLog:
    """Frames on the clock, with the sightings since the frame before, moved with the odometry."""
    T_start_frame = _dead_reckoned(odometry, clock_s)
    frame = np.searchsorted(clock_s, sighted[:, 0])
    kept = _last_of_each(frame, sighted[:, 1]) & (frame < len(clock_s))
    sighted, frame = sighted[kept], frame[kept]
    position, covariance = _cartesian(sighted[:, 2], sighted[:, 3], settings)
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
        calibration=CalibrationError(scale=settings.range_scale_sigma, camera=_CAMERA),
    )


def _last_of_each(frame: np.ndarray, subject: Float) -> np.ndarray:
    """(N,) whether a sighting is the last one of its subject in its frame."""
    pairs = np.stack([frame, subject], -1)[::-1]
    last = np.zeros(len(frame), dtype=bool)
    last[len(frame) - 1 - np.unique(pairs, axis=0, return_index=True)[1]] = True
    return last


def _cartesian(range_m: Float, bearing_rad: Float, settings: MrclamSettings) -> tuple[Float, Float]:
    """Points (N, 3) of the robot frame and covariances (N, 3, 3), to first order in the noise."""
    direction = rotation(bearing_rad)
    position = np.zeros((len(range_m), 3))
    position[:, :2] = range_m[:, None] * direction[:, :, 0]
    along_and_across = np.zeros((len(range_m), 2, 2))
    along_and_across[:, 0, 0] = settings.range_sigma(range_m) ** 2
    along_and_across[:, 1, 1] = (range_m * settings.bearing_sigma_rad) ** 2
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


def _n_frames(folder: Path, duration_s: float, frame_s: float) -> int:
    """How many frames the clock of all robots has."""
    if not duration_s / frame_s < _MOST_FRAMES:
        wrong = (
            f"odometry over {duration_s:g} s is more than {_MOST_FRAMES} frames of {frame_s:g} s"
        )
        raise InputError(f"{folder}: {wrong}; are its times seconds?")
    return int(np.ceil(duration_s / frame_s)) + 1


def _robots(folder: Path) -> list[int]:
    found = [re.fullmatch(r"Robot(\d+)_Odometry\.dat", path.name) for path in folder.iterdir()]
    numbers = sorted(int(match[1]) for match in found if match)
    if not numbers:
        raise InputError(f"{folder}: no RobotN_Odometry.dat (expected an MRCLAM recording)")
    return numbers


def _barcodes(path: Path) -> dict[int, int]:
    """Subject of each barcode."""
    table, lines = _table(path, 2)
    subject_of: dict[int, int] = {}
    for (subject, barcode), line in zip(table, lines, strict=True):
        if subject % 1 or barcode % 1:
            raise InputError(f"{path}, line {line}: not whole numbers (subject, barcode)")
        known = subject_of.setdefault(int(barcode), int(subject))
        if known != subject:
            raise InputError(f"{path}, line {line}: barcode {int(barcode)} is subject {known}'s")
    return subject_of


def _landmarks(path: Path) -> dict[int, Float]:
    """True position (3,) of each landmark's subject."""
    table, _ = _table(path, 5)
    return {int(row[0]): np.array([row[1], row[2], 0.0]) for row in table}


def _sightings(
    path: Path, subject_of_barcode: dict[int, int], landmarks: dict[int, Float] | None
) -> Float:
    """Rows (N, 4) time_s, subject, range_m, bearing_rad of landmarks.

    Robots are left out, and barcodes that the recording does not know (misread ones); where
    landmarks were surveyed, those that were not, too.
    """
    table, lines = _table(path, 4)
    wrong = np.flatnonzero(table[:, 2] <= 0)
    if len(wrong):
        row = wrong[0]
        raise InputError(
            f"{path}, line {lines[row]}: range is {table[row, 2]:g} m, must be positive"
        )
    table[:, 1] = [subject_of_barcode.get(int(barcode), -1) for barcode in table[:, 1]]
    kept = table[:, 1] > _LAST_ROBOT_SUBJECT
    if landmarks is not None:
        kept &= np.isin(table[:, 1], list(landmarks))
    return _by_time(table[kept])


def _timed(path: Path, n_columns: int) -> Float:
    """A table in the order of its times; a motion needs two rows."""
    table, _ = _table(path, n_columns)
    if len(table) < 2:
        raise InputError(f"{path}: has {len(table)} rows, expected at least 2")
    return _by_time(table)


def _by_time(table: Float) -> Float:
    return table[np.argsort(table[:, 0], kind="stable")]


def _table(path: Path, n_columns: int) -> tuple[Float, list[int]]:
    """Numbers (N, n_columns) of a text file, and the line of each row."""
    try:
        text = path.read_text(encoding="ascii")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file (part of an MRCLAM recording)") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable text file") from error
    rows, lines = [], []
    for number, line in enumerate(text.splitlines(), start=1):
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
        if not all(map(isfinite, row)):
            raise InputError(f"{path}, line {number}: not a finite number in {line.strip()!r}")
        if max(map(abs, row)) > _LARGEST:
            raise InputError(f"{path}, line {number}: larger than {_LARGEST:g}: {line.strip()!r}")
        rows.append(row)
        lines.append(number)
    return np.array(rows).reshape(-1, n_columns), lines
