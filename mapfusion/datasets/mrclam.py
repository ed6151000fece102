"""UTIAS MRCLAM recordings as robot logs.

Leung, Halpern, Barfoot, Liu (2011), "The UTIAS multi-robot cooperative localization and mapping
dataset". The robots identify each landmark by a barcode and measure its range and bearing. Each
text file holds one table; lines that start with # are comments:

- `Barcodes.dat`: subject, barcode.
- `Landmark_Groundtruth.dat`: subject, x_m, y_m, two standard deviations; optional.
- `RobotN_Odometry.dat`: time_s, forward velocity (m/s), angular velocity (rad/s).
- `RobotN_Measurement.dat`: time_s, barcode, range_m, bearing_rad.
- `RobotN_Groundtruth.dat`: time_s, x_m, y_m, theta_rad; optional; may have gaps.

True poses and true points are written if the recording has them. Subjects 1 to 5 are the robots;
the others are landmarks.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapfusion.camera import CalibrationError
from mapfusion.datasets.point_logs import (
    MAX_FRAMES,
    Measurements,
    dead_reckoning,
    interpolate_poses,
    log_on_clock,
    points_of_ranges,
)
from mapfusion.datasets.text_files import parse_numbers, read_rows, require_columns
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import (
    TRUTH_FILES,
    Observations,
    RobotLog,
    write_log,
    write_truth_points,
    write_truth_poses,
)

_LAST_ROBOT_SUBJECT = 5
_CAMERA = "MRCLAM"  # all robots share one camera model, calibration and print of barcodes
_MAY_BE_ZERO = ("range_sigma_ratio", "range_scale_sigma")


@dataclass(frozen=True)
class MrclamSettings:
    """Settings of the MRCLAM importer.

    The noise is about twice the measured noise of dataset 7. Errors of consecutive measurements of
    a barcode are correlated, but the filter treats them as independent.

    Attributes:
        frame_s: time between frames, on one clock for all robots. A frame keeps the last
            measurement of each landmark. The cameras measured four times a second with correlated
            errors, so the filter would be overconfident if it used all measurements.
        range_sigma_m: constant part of the standard deviation of a range.
        range_sigma_ratio: part of the standard deviation that is proportional to the range. The
            range is measured by the size of the barcode in the image, which shrinks with distance.
        bearing_sigma_rad: standard deviation of a bearing.
        range_scale_sigma: standard deviation of the relative scale error that all ranges of all
            robots share, such as barcode edges that are detected half a pixel too far outside.
            Odometry does not reveal this error because its own scale is calibrated by the ranges.
        longest_truth_gap_s: longest gap over which the truth is interpolated.
    """

    frame_s: float = 1.0
    range_sigma_m: float = 0.15
    range_sigma_ratio: float = 0.08
    bearing_sigma_rad: float = 0.05
    range_scale_sigma: float = 0.01
    longest_truth_gap_s: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = value > 0 or (value == 0 and name in _MAY_BE_ZERO)
            if not (np.isfinite(value) and positive):
                raise ValueError(f"{name}: is {value}, must be finite and positive")

    def range_sigma(self, range_m: Float) -> Float:
        """Return the standard deviations of ranges, shape (N,)."""
        return np.hypot(self.range_sigma_m, self.range_sigma_ratio * range_m)


def import_mrclam(
    folder: Path, destination: Path, settings: MrclamSettings | None = None
) -> list[Path]:
    """Write one log for each robot of a recording, with the truth if it is recorded.

    Returns:
        Folders of the logs, `destination/robotN`, in the order of the robots.

    Raises:
        InputError: a file is missing, damaged or of another format; the message names file and
            line. Nothing is written in this case.
    """
    settings = settings or MrclamSettings()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (expected an MRCLAM recording)")
    matches = [re.fullmatch(r"Robot(\d+)_Odometry\.dat", path.name) for path in folder.iterdir()]
    robot_numbers = sorted(int(match[1]) for match in matches if match)
    if not robot_numbers:
        raise InputError(f"{folder}: no RobotN_Odometry.dat (expected an MRCLAM recording)")

    # Read every file before the first log is written.
    subject_of_barcode = _read_barcodes(folder / "Barcodes.dat")
    landmark_file = folder / "Landmark_Groundtruth.dat"
    landmarks: dict[int, Float] | None = None
    if landmark_file.exists():
        rows, _ = _read_table(landmark_file, "subject x y sigma_x sigma_y")
        landmarks = {int(row[0]): np.array([row[1], row[2], 0.0]) for row in rows}
    recordings = [
        (
            f"robot{n}",
            _read_time_series(folder / f"Robot{n}_Odometry.dat", "time speed turn_rate"),
            _read_measurements(folder / f"Robot{n}_Measurement.dat", subject_of_barcode, landmarks),
            _read_time_series(path, "time x y theta")
            if (path := folder / f"Robot{n}_Groundtruth.dat").exists()
            else None,
        )
        for n in robot_numbers
    ]

    # All robots share one clock.
    first_s = min(odometry[0, 0] for _, odometry, _, _ in recordings)
    last_s = max(odometry[-1, 0] for _, odometry, _, _ in recordings)
    duration_s = last_s - first_s
    if not duration_s / settings.frame_s < MAX_FRAMES:
        limit = f"more than {MAX_FRAMES} frames of {settings.frame_s:g} s"
        raise InputError(
            f"{folder}: odometry over {duration_s:g} s is {limit}; are its times seconds?"
        )
    n_frames = int(np.ceil(duration_s / settings.frame_s)) + 1
    clock_s = first_s + settings.frame_s * np.arange(n_frames)
    for robot, _, _, truth in recordings:
        if truth is not None and (truth[-1, 0] < first_s or truth[0, 0] > last_s):
            spans = f"{truth[0, 0]:.3f} to {truth[-1, 0]:.3f} s, odometry of {first_s:.3f} to"
            path = folder / f"{robot.capitalize()}_Groundtruth.dat"
            raise InputError(f"{path}: the truth is of {spans} {last_s:.3f} s; no time is in both")

    written = []
    for robot, odometry, measurements, truth in recordings:
        path = destination / robot
        log = _make_log(robot, odometry, measurements, clock_s, settings)
        write_log(path, log)
        for outdated in TRUTH_FILES:  # of an earlier import into the same folder
            (path / outdated).unlink(missing_ok=True)
        if truth is not None:
            gap_s = settings.longest_truth_gap_s
            write_truth_poses(path, interpolate_poses(clock_s, truth, gap_s))
        if landmarks is not None:
            assert log.observations.label is not None
            points = np.array([landmarks[int(subject)] for subject in log.observations.label])
            write_truth_points(path, points.reshape(-1, 3))
        written.append(path)
    return written


def _make_log(
    robot: str, odometry: Float, measurements: Float, clock_s: Float, settings: MrclamSettings
) -> RobotLog:
    """Make a log with one frame per tick of the clock.

    A frame holds the measurements since the frame before, moved into its robot frame by odometry.
    """
    time_s, subject, range_m, bearing_rad = measurements.T
    sigma_m = settings.range_sigma(range_m)
    points = points_of_ranges(range_m, bearing_rad, sigma_m, settings.bearing_sigma_rad)
    observations = Observations(*points, label=subject.astype(np.int32))
    calibration = CalibrationError(scale=settings.range_scale_sigma, camera=_CAMERA)
    return log_on_clock(
        robot,
        clock_s,
        lambda wanted_s: dead_reckoning(odometry, wanted_s),
        Measurements(time_s, observations, planar=True),
        calibration=calibration,
    )


def _read_barcodes(path: Path) -> dict[int, int]:
    """Return the subject of each barcode."""
    table, lines = _read_table(path, "subject barcode")
    subject_of: dict[int, int] = {}
    for (subject, barcode), line in zip(table, lines, strict=True):
        if subject % 1 or barcode % 1:
            raise InputError(f"{path}, line {line}: not whole numbers (subject, barcode)")
        first_subject = subject_of.setdefault(int(barcode), int(subject))
        if first_subject != subject:
            raise InputError(
                f"{path}, line {line}: barcode {int(barcode)} is subject {first_subject}'s"
            )
    return subject_of


def _read_measurements(
    path: Path, subject_of_barcode: dict[int, int], landmarks: dict[int, Float] | None
) -> Float:
    """Return measurements of landmarks, shape (N, 4): time_s, subject, range_m, bearing_rad.

    Robots and unknown (misread) barcodes are left out, and landmarks without a true position if
    `landmarks` is given.
    """
    table, lines = _read_table(path, "time barcode range bearing")
    invalid = np.flatnonzero(table[:, 2] <= 0)
    if len(invalid):
        row = invalid[0]
        raise InputError(
            f"{path}, line {lines[row]}: range is {table[row, 2]:g} m, must be positive"
        )
    table[:, 1] = [subject_of_barcode.get(int(barcode), -1) for barcode in table[:, 1]]
    is_landmark = table[:, 1] > _LAST_ROBOT_SUBJECT
    if landmarks is not None:
        is_landmark &= np.isin(table[:, 1], list(landmarks))
    table = table[is_landmark]
    return table[np.argsort(table[:, 0], kind="stable")]


def _read_time_series(path: Path, columns: str) -> Float:
    """Read a table and sort it by time; at least two rows are required."""
    table, _ = _read_table(path, columns)
    if len(table) < 2:
        raise InputError(f"{path}: has {len(table)} rows, expected at least 2")
    return table[np.argsort(table[:, 0], kind="stable")]


def _read_table(path: Path, columns: str) -> tuple[Float, list[int]]:
    """Return the numbers of a text file, shape (N, n), and the line number of each row."""
    rows, lines = [], []
    for line, words in read_rows(path, "part of an MRCLAM recording"):
        require_columns(path, line, words, columns)
        rows.append(parse_numbers(path, line, words))
        lines.append(line)
    return np.array(rows).reshape(len(rows), len(columns.split())), lines
