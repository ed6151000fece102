"""Logs of points, or of ranges and bearings, with odometry at times of its own.

A recording is a folder of tables, each NAME.csv or NAME.parquet. Times are seconds on one clock,
angles are in radians, and the robot frame has x ahead and y left.

- `odometry`: `time_s` and either dead-reckoned poses (`x_m`, `y_m`, `theta_rad`, in any frame) or
  velocities (`speed_m_s`, `turn_rate_rad_s`), each of which holds until the next one.
- `points`: `time_s` and a position in the frame of the sensor (`x_m`, `y_m`, `z_m`), with its
  covariance (`cov_xx_m2`, ...) or the setting `sigma_m`. Without `z_m` the points are planar.
- `ranges`: `time_s`, `range_m`, `bearing_rad`, to the left positive; planar.
- Both may hold `label` (a known identity) and `descriptor_0`, `descriptor_1`, ...
- `truth_poses`: `time_s`, `x_m`, `y_m`, `theta_rad`; optional; may have gaps.
- `landmarks`: surveyed points, `label`, `x_m`, `y_m` and `z_m`; optional.

A folder without odometry holds one such folder for each robot. Their landmarks may be in the folder
above.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa

from mapfusion.datasets.log_consistency import check_log
from mapfusion.errors import InputError, TellingWarning
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSE_FIELDS,
    POSITION_FIELDS,
    column,
    columns,
    described,
    float_fields,
    point_fields,
    points_from,
    require_cells,
    schema,
)
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose, rotation, wrap
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import (
    TRUTH_FILES,
    Observations,
    RobotLog,
    write_log,
    write_truth_points,
    write_truth_poses,
)
from mapfusion.tables import (
    APPEARANCE_FIELDS,
    NO_LABEL,
    appearance_from,
    read_open_table,
    require_appearance,
    table_path,
)

PosesAt = Callable[[Float], Float]
MAX_FRAMES = 1_000_000  # eleven days at one frame a second
_LONGEST_HOLD_S = 1.0  # before the first and after the last pose the robot is taken to stand still
# Time between two rows of odometry over that between two measurements. Milliseconds and shorter
# units give more, and then no two rows lie within the measurements.
_LARGEST_STEP = 300.0
_LARGEST_BEARING = 2 * np.pi  # conventions are -pi to pi and 0 to 2 pi; degrees lie beyond
_SHARE_OF_DEGREES = 0.1  # of bearings beyond; fewer are single mistakes
_MAX_LABELS = 3  # in one message
_VELOCITY_FIELDS = ["speed_m_s", "turn_rate_rad_s"]
_POLAR_FIELDS = ["range_m", "bearing_rad"]
_TIME = described(pa.field("time_s", pa.float64()), "time in seconds")


def _unknown(fields: list[pa.Field], description: str) -> list[pa.Field]:
    """Return optional columns, NaN where they are missing."""
    return [described(field, description, np.nan) for field in fields]


ODOMETRY = schema(
    "point_log.odometry",
    1,
    [
        _TIME,
        *_unknown(float_fields(POSE_FIELDS), "dead-reckoned pose in any frame"),
        *_unknown(float_fields(_VELOCITY_FIELDS), "velocity until the next row"),
    ],
)
POINTS = schema(
    "point_log.points",
    1,
    [
        _TIME,
        *(described(field, "point in the sensor frame") for field in point_fields()[:3]),
        *_unknown(point_fields()[3:], "covariance of the point; or the setting sigma_m"),
        *APPEARANCE_FIELDS,
    ],
)
RANGES = schema(
    "point_log.ranges",
    1,
    [
        _TIME,
        *(
            described(field, "range and bearing from the sensor; bearings are positive to the left")
            for field in float_fields(_POLAR_FIELDS)
        ),
        *APPEARANCE_FIELDS,
    ],
)
TRUE_POSES = schema(
    "point_log.truth_poses",
    1,
    [_TIME, *(described(f, "true pose T_world_robot") for f in float_fields(POSE_FIELDS))],
)
LANDMARKS = schema(
    "point_log.landmarks",
    1,
    [
        described(pa.field("label", pa.int32()), "identity of the landmark"),
        *(
            described(field, "surveyed point in the world")
            for field in float_fields(POSITION_FIELDS)
        ),
    ],
)


@dataclass(frozen=True)
class _Frames:
    """Settings of the frames of a log.

    Attributes:
        frame_s: time between frames, whose measurements odometry moves into the robot frame at the
            frame's time; a frame keeps the last measurement of each label. 0: a frame at each time
            of the measurements.
        longest_truth_gap_s: longest gap over which the truth is interpolated.
        sensor_x_m: position of the sensor in the robot frame, ahead.
        sensor_y_m: position of the sensor in the robot frame, to the left.
        sensor_theta_rad: heading of the sensor in the robot frame.
    """

    frame_s: Annotated[float, Range(0, 1e4, "s")] = 0.0
    longest_truth_gap_s: Annotated[float, Range(0, 1e4, "s")] = 1.0
    sensor_x_m: Annotated[float, Range(-100, 100, "m")] = 0.0
    sensor_y_m: Annotated[float, Range(-100, 100, "m")] = 0.0
    sensor_theta_rad: Annotated[float, Range(-_LARGEST_BEARING, _LARGEST_BEARING, "rad")] = 0.0

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class PointsSettings(_Frames):
    """Settings of the importer of point logs.

    Attributes:
        sigma_m: standard deviation of a point along each axis, for tables without covariances; 0
            if it is not stated.
    """

    sigma_m: Annotated[float, Range(0, 100, "m")] = 0.0


@dataclass(frozen=True)
class RangesSettings(_Frames):
    """Settings of the importer of logs of ranges and bearings.

    Attributes:
        range_sigma_m: constant part of the standard deviation of a range.
        range_sigma_ratio: part of the standard deviation that is proportional to the range.
        bearing_sigma_rad: standard deviation of a bearing; 0 if it is not stated.
    """

    range_sigma_m: Annotated[float, Range(0, 100, "m")] = 0.0
    range_sigma_ratio: Annotated[float, Range(0, 1, "1")] = 0.0
    bearing_sigma_rad: Annotated[float, Range(0, np.pi, "rad")] = 0.0


@dataclass(frozen=True)
class Measurements:
    """Measured points of a robot over time, in the robot frame at their own times.

    Attributes:
        time_s: ascending times, shape (N,).
        observations: the points.
        planar: True for points without heights.
    """

    time_s: Float
    observations: Observations
    planar: bool


def import_points(
    folder: Path, destination: Path, settings: PointsSettings | None = None
) -> list[Path]:
    """Write a log for each robot of a recording of points, with the truth if it is recorded.

    Returns:
        Folders of the logs, in the order of the names of the robots.

    Raises:
        InputError: a table is missing, damaged or contradicts another one; nothing is written.
    """
    chosen = settings or PointsSettings()
    return _import_robots(folder, destination, chosen, "points", _read_points)


def import_ranges(
    folder: Path, destination: Path, settings: RangesSettings | None = None
) -> list[Path]:
    """Write a log for each robot of a recording of ranges and bearings; see `import_points`."""
    chosen = settings or RangesSettings()
    return _import_robots(folder, destination, chosen, "ranges", _read_ranges)


def _import_robots(
    folder: Path,
    destination: Path,
    settings: Any,
    kind: str,
    read: Callable[[Path, Any], Measurements],
) -> list[Path]:
    """Write the logs of the robots in a folder; `read` reads the table `kind` of one."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (expected a recording with odometry.csv)")
    folders = (folder, *sorted(folder.iterdir()))
    robots = [each for each in folders if table_path(each, "odometry").is_file()]
    if not robots:
        missing = "no odometry.csv or odometry.parquet, nor in a folder below"
        raise InputError(f"{folder}: {missing}; see `mapfusion docs point_logs`")
    written = []
    for robot in robots[:1] if robots[0] == folder else robots:
        try:
            table, odometry = table_path(robot, kind), table_path(robot, "odometry")
            measured = read(table, settings)
            # Times of the frames: those of the measurements, or equally spaced ones.
            clock_s, frame_s = np.unique(measured.time_s), settings.frame_s
            if frame_s:
                span_s = measured.time_s[-1] - measured.time_s[0]
                if not span_s / frame_s < MAX_FRAMES:
                    limit = (
                        f"more than {MAX_FRAMES} frames of {frame_s:g} s; are its times seconds?"
                    )
                    raise InputError(f"{robot}: measurements over {span_s:g} s are {limit}")
                steps = np.arange(int(np.ceil(span_s / frame_s)) + 1)
                clock_s = measured.time_s[0] + frame_s * steps
            poses_at = _read_odometry(odometry, measured.time_s)
            log = log_on_clock(robot.resolve().name, clock_s, poses_at, measured)
            _require_radians(odometry, log, clock_s, measured)
            _tell_repeated_labels(table, clock_s, measured)
            poses, points = table_path(robot, "truth_poses"), None
            T_world_robot = _read_true_poses(poses, clock_s, settings) if poses.is_file() else None
            surveys = (table_path(each, "landmarks") for each in (robot, folder))
            survey = next((path for path in surveys if path.is_file()), None)
            if survey is not None:
                points = _true_points(survey, log.observations.label)
            written.append((destination / log.robot, log, T_world_robot, points))
        except InputError as error:
            raise InputError(f"{error}; see `mapfusion docs point_logs`") from error
    for path, log, T_world_robot, points in written:
        write_log(path, log)
        for outdated in TRUTH_FILES:  # of an earlier import into the same folder
            (path / outdated).unlink(missing_ok=True)
        if T_world_robot is not None:
            write_truth_poses(path, T_world_robot)
        if points is not None:
            write_truth_points(path, points)
    return [path for path, *_ in written]


def _contradicts_itself(log: RobotLog) -> bool:
    """Return True if the odometry contradicts the motion that the observations show."""
    findings = check_log(log, MotionNoise()).findings
    return any(finding.kind == "odometry" for finding in findings)


def _require_radians(path: Path, log: RobotLog, clock_s: Float, measured: Measurements) -> None:
    """Raise InputError for odometry that agrees with the observations only in degrees.

    Turns of more than half a circle between frames are lost in a log, so the odometry is read
    again.
    """
    if not _contradicts_itself(log):
        return
    in_degrees = _read_odometry(path, measured.time_s, np.pi / 180)
    if _contradicts_itself(log_on_clock(log.robot, clock_s, in_degrees, measured)):
        return
    table, _ = _read_timed(path, ODOMETRY)
    has_poses = not np.isnan(column(table, "theta_rad")).all()
    name, unit = ("theta_rad", "degrees") if has_poses else (_VELOCITY_FIELDS[1], "degrees/s")
    contents = f"holds {unit}: only then the odometry agrees with the observations"
    raise InputError(f"{path}: column {name}: {contents}; multiply it by pi/180")


def _read_timed(path: Path, table_schema: pa.Schema) -> tuple[pa.Table, dict[str, str]]:
    """Read a table with times that do not decrease; raises InputError."""
    table, attributes = read_open_table(path, table_schema)
    require_cells(path, table, ["time_s"], np.isfinite, "give a finite number")
    if not table.num_rows:
        raise InputError(f"{path}: holds no row")
    decreasing = np.flatnonzero(np.diff(column(table, "time_s")) < 0)
    if len(decreasing):
        row = int(decreasing[0]) + 1
        raise InputError(f"{path}: column time_s: runs back in row {row}; sort the rows by time")
    return table, attributes


def _read_points(path: Path, settings: PointsSettings) -> Measurements:
    """Read the table `points` of a robot."""
    table, attributes = _read_timed(path, POINTS)
    require_cells(path, table, POSITION_FIELDS, np.isfinite, "give a finite number, or remove it")
    planar = attributes.get("planar") == "true"
    if np.isnan(column(table, COVARIANCE_FIELDS[0])).all():
        if not settings.sigma_m:
            stated = "give --param sigma_m=..., the standard deviation of a point along each axis"
            raise InputError(f"{path}: has no covariances (cov_xx_m2, ...); {stated}")
        position = columns(table, POSITION_FIELDS)
        axes = np.array([1.0, 1.0, 0.0 if planar else 1.0])
        covariance = np.tile(np.diag(axes * settings.sigma_m**2), (len(position), 1, 1))
    else:
        require_cells(path, table, COVARIANCE_FIELDS, np.isfinite, "give a finite number")
        position, covariance = points_from(table)
    return _measured(path, table, attributes, position, covariance, planar, settings)


def _read_ranges(path: Path, settings: RangesSettings) -> Measurements:
    """Read the table `ranges` of a robot."""
    table, attributes = _read_timed(path, RANGES)
    positive = "ranges are positive, in metres; remove rows without a return"
    require_cells(path, table, ["range_m"], lambda r: np.isfinite(r) & (r > 0), positive)
    finite = "give a finite number, or remove the row"
    require_cells(path, table, ["bearing_rad"], np.isfinite, finite)
    size = np.abs(column(table, "bearing_rad"))
    limit = "bearings are in radians, -pi to pi or 0 to 2 pi"
    if size.max() <= 360 and np.mean(size > _LARGEST_BEARING) > _SHARE_OF_DEGREES:
        limit += "; are they degrees?"
    require_cells(path, table, ["bearing_rad"], lambda b: np.abs(b) <= _LARGEST_BEARING, limit)
    lacking = [] if settings.range_sigma_m or settings.range_sigma_ratio else ["range_sigma_m"]
    lacking += [] if settings.bearing_sigma_rad else ["bearing_sigma_rad"]
    if lacking:
        options = " ".join(f"--param {name}=..." for name in lacking)
        raise InputError(f"{path}: the noise is not stated; give {options} (standard deviations)")
    range_m, bearing_rad = columns(table, _POLAR_FIELDS).T
    range_sigma_m = np.hypot(settings.range_sigma_m, settings.range_sigma_ratio * range_m)
    points = points_of_ranges(range_m, bearing_rad, range_sigma_m, settings.bearing_sigma_rad)
    return _measured(path, table, attributes, *points, True, settings)


def _measured(
    path: Path,
    table: pa.Table,
    attributes: Mapping[str, str],
    position: Float,
    covariance: Float,
    planar: bool,
    settings: _Frames,
) -> Measurements:
    """Return measurements in the robot frame, given those in the sensor frame."""
    require_appearance(path, table)
    R = np.eye(3)
    R[:2, :2] = rotation(np.array(settings.sensor_theta_rad))
    moved = position @ R.T + [settings.sensor_x_m, settings.sensor_y_m, 0.0]
    descriptor, label, kind = appearance_from(path, table, attributes)
    covariance = R @ covariance @ R.T
    observations = Observations(moved, covariance, descriptor, label, descriptor_kind=kind)
    return Measurements(column(table, "time_s"), observations, planar)


def points_of_ranges(
    range_m: Float, bearing_rad: Float, range_sigma_m: Float, bearing_sigma_rad: float
) -> tuple[Float, Float]:
    """Return planar points (N, 3) of ranges and bearings (N,), and their covariances (N, 3, 3).

    The covariance is of first order in the noise.
    """
    n, direction = len(range_m), rotation(bearing_rad)
    position, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    position[:, :2] = range_m[:, None] * direction[:, :, 0]
    along_and_across = np.zeros((n, 2, 2))
    along_and_across[:, 0, 0] = range_sigma_m**2
    along_and_across[:, 1, 1] = (range_m * bearing_sigma_rad) ** 2
    covariance[:, :2, :2] = direction @ along_and_across @ np.swapaxes(direction, 1, 2)
    return position, covariance


def log_on_clock(
    robot: str, clock_s: Float, poses_at: PosesAt, measured: Measurements, **extras: Any
) -> RobotLog:
    """Return a log with a frame at each time of a clock.

    A frame holds the measurements since the frame before, moved into its robot frame by odometry.
    Of the measurements of one label in a frame, the last one is kept. Later measurements than the
    last frame are left out.

    Args:
        robot: name of the robot.
        clock_s: increasing times of the frames, shape (T,).
        poses_at: function that returns dead-reckoned poses (N, 3) at times (N,).
        measured: measurements of the robot.
        extras: further arguments of `RobotLog`.
    """
    frame, seen = np.searchsorted(clock_s, measured.time_s), measured.observations
    is_used = (frame < len(clock_s)) & ~_seen_again(frame, seen.label)
    frame, seen, time_s = frame[is_used], seen[is_used], measured.time_s[is_used]

    T_start_frame = poses_at(clock_s)
    T_frame_measured = between(T_start_frame[frame], poses_at(time_s))
    R = np.tile(np.eye(3), (len(frame), 1, 1))
    R[:, :2, :2] = rotation(T_frame_measured[:, 2])
    position = np.einsum("nij,nj->ni", R, seen.position_m)
    position[:, :2] += T_frame_measured[:, :2]
    covariance = R @ seen.covariance_m2 @ np.swapaxes(R, 1, 2)

    increments = np.zeros((len(clock_s), 3))
    increments[1:] = between(T_start_frame[:-1], T_start_frame[1:])
    appearance = seen.descriptor, seen.label
    observations = Observations(
        position, covariance, *appearance, descriptor_kind=seen.descriptor_kind
    )
    times = clock_s - clock_s[0]
    return RobotLog(robot, measured.planar, times, increments, frame, observations, **extras)


def _seen_again(frame: np.ndarray, label: np.ndarray | None) -> np.ndarray:
    """Return True for rows (N,) whose label a later row of the same frame has, too."""
    is_repeated = np.zeros(len(frame), dtype=bool)
    if label is not None:
        pairs = np.stack([frame, label], -1)[::-1]
        is_repeated[:] = label != NO_LABEL
        is_repeated[len(frame) - 1 - np.unique(pairs, axis=0, return_index=True)[1]] = False
    return is_repeated


def _tell_repeated_labels(path: Path, clock_s: Float, measured: Measurements) -> None:
    """Warn of rows that `log_on_clock` leaves out because a later row repeats their label."""
    label = measured.observations.label
    rows = np.flatnonzero(_seen_again(np.searchsorted(clock_s, measured.time_s), label))
    if label is None or not len(rows):
        return
    labels = np.unique(label[rows]).tolist()
    ellipsis = ", ..." if len(labels) > _MAX_LABELS else ""
    labels_text = (
        f"label{'s' if len(labels) > 1 else ''} {', '.join(map(str, labels[:_MAX_LABELS]))}"
    )
    message = f"{len(rows)} of {len(label)} rows are left out "
    message += f"({labels_text}{ellipsis}; first: row {rows[0]})"
    reason = "a frame keeps the last row of each label"
    text = f"{path}: {message}: {reason}; if they show several landmarks, give each its own label"
    warnings.warn(text, TellingWarning, stacklevel=4)


def _read_odometry(path: Path, measured_s: Float, radians: float = 1.0) -> PosesAt:
    """Read the odometry of a robot and return its poses as a function of time.

    Args:
        path: of the table.
        measured_s: times of the measurements, which tell times and turn rates in other units.
        radians: unit of its angles, in radians.
    """
    table, _ = _read_timed(path, ODOMETRY)
    time_s = column(table, "time_s")
    poses, velocities = (columns(table, names) for names in (POSE_FIELDS, _VELOCITY_FIELDS))
    is_given = [not np.isnan(each).all() for each in (poses, velocities)]
    if sum(is_given) != 1:
        problem = "has both poses and velocities" if all(is_given) else "has no poses or velocities"
        either = f"{', '.join(POSE_FIELDS)}, or {', '.join(_VELOCITY_FIELDS)}"
        raise InputError(f"{path}: {problem}; give either {either}")
    names, values = (POSE_FIELDS, poses) if is_given[0] else (_VELOCITY_FIELDS, velocities)
    if absent := [
        name
        for name, values_of_column in zip(names, values.T, strict=True)
        if np.isnan(values_of_column).all()
    ]:
        raise InputError(f"{path}: has no column {absent[0]}; odometry needs {', '.join(names)}")
    require_cells(path, table, names, np.isfinite, "give a finite number")
    values[:, -1] *= radians
    repeated = np.flatnonzero(np.diff(time_s) <= 0)
    if len(repeated):
        raise InputError(f"{path}: column time_s: repeats in row {int(repeated[0]) + 1}")

    if len(moments_s := np.unique(measured_s)) > 1:
        step_s = float(np.median(np.diff(moments_s)))
        row_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
        within = np.count_nonzero((time_s >= moments_s[0]) & (time_s <= moments_s[-1]))
        if within < 2 < len(time_s) and row_s > _LARGEST_STEP * step_s:
            problem = f"rows are {row_s:.3g} s apart, and measurements {step_s:.3g} s"
            raise InputError(f"{path}: column time_s: {problem}; are its times in seconds?")
        turn = step_s * float(np.median(np.abs(velocities[:, 1]))) if is_given[1] else 0.0
        if turn > np.pi:
            problem = f"the robot turns by {turn:.3g} rad between two measurements (median); "
            problem += "are all times in seconds? if it holds degrees/s, multiply it by pi/180"
            raise InputError(f"{path}: column {_VELOCITY_FIELDS[1]}: {problem}")

    def poses_at(wanted_s: Float) -> Float:
        beyond = np.abs(wanted_s - np.clip(wanted_s, time_s[0], time_s[-1])) > _LONGEST_HOLD_S
        if beyond.any():
            spans = f"odometry of {time_s[0]:.15g} to {time_s[-1]:.15g} s has no pose at"
            moment = f"{wanted_s[beyond][0]:.15g} s, where something is measured"
            raise InputError(f"{path}: {spans} {moment}; is it another recording's, or clock's?")
        held_s = np.clip(wanted_s, time_s[0], time_s[-1])
        if is_given[1]:
            return dead_reckoning(np.column_stack([time_s, velocities]), held_s)
        return interpolate_poses(held_s, np.column_stack([time_s, poses]), np.inf)

    return poses_at


def dead_reckoning(odometry: Float, time_s: Float) -> Float:
    """Return dead-reckoned poses, shape (N, 3), at times of shape (N,).

    Each velocity (time_s, speed, turn rate) holds until the next one, so the robot moves along
    arcs. It stands still before the first velocity.
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
    """Return motions, shape (N, 3), at constant velocities."""
    angle = turn_rad_s * duration_s
    # sinc is exact through zero: chord = length sin(a/2) / (a/2), along half the angle.
    chord = speed_m_s * duration_s * np.sinc(angle / (2 * np.pi))
    return np.stack([chord * np.cos(angle / 2), chord * np.sin(angle / 2), angle], -1)


def interpolate_poses(wanted_s: Float, timed: Float, longest_gap_s: float) -> Float:
    """Return poses, shape (T, 3), at wanted times; NaN in longer gaps and outside.

    Args:
        wanted_s: times, shape (T,).
        timed: rows of time_s, x, y, theta in the order of time, shape (N, 4).
        longest_gap_s: longest gap over which poses are interpolated.
    """
    if len(timed) == 1:
        return np.where((wanted_s == timed[0, 0])[:, None], timed[0, 1:], np.nan)
    row = np.clip(np.searchsorted(timed[:, 0], wanted_s, side="right") - 1, 0, len(timed) - 2)
    before, after = timed[row], timed[row + 1]
    gap_s = after[:, 0] - before[:, 0]
    share = (wanted_s - before[:, 0]) / np.where(gap_s > 0, gap_s, 1.0)
    pose = before[:, 1:] + share[:, None] * (after[:, 1:] - before[:, 1:])
    pose[:, 2] = wrap(before[:, 3] + share * wrap(after[:, 3] - before[:, 3]))
    is_known = (share >= 0) & (share <= 1) & (gap_s <= longest_gap_s)
    return np.where(is_known[:, None], pose, np.nan)


def _read_true_poses(path: Path, clock_s: Float, settings: _Frames) -> Float:
    """Return the true poses (T, 3) at the times of the frames; NaN where unknown."""
    table, _ = _read_timed(path, TRUE_POSES)
    require_cells(path, table, POSE_FIELDS, np.isfinite, "give a finite number, or remove the row")
    timed = np.column_stack([column(table, "time_s"), columns(table, POSE_FIELDS)])
    if timed[-1, 0] < clock_s[0] or timed[0, 0] > clock_s[-1]:
        spans = f"{timed[0, 0]:.3f} to {timed[-1, 0]:.3f} s, measurements are of"
        last = f"{clock_s[0]:.3f} to {clock_s[-1]:.3f} s; no time is in both"
        raise InputError(f"{path}: the truth is of {spans} {last}")
    return interpolate_poses(clock_s, timed, settings.longest_truth_gap_s)


def _true_points(path: Path, label: np.ndarray | None) -> Float:
    """Return the surveyed points of labels (N,), shape (N, 3); NaN where unknown."""
    table, _ = read_open_table(path, LANDMARKS)
    if label is None:
        raise InputError(f"{path}: names landmarks by label, but the measurements have no labels")
    require_cells(path, table, POSITION_FIELDS, np.isfinite, "give a finite number")
    labels, point_m = column(table, "label"), columns(table, POSITION_FIELDS)
    twice = np.flatnonzero(np.bincount(labels - labels.min(initial=0)) > 1)
    if len(twice):
        raise InputError(f"{path}: has label {int(twice[0] + labels.min())} twice")
    order = np.argsort(labels)
    index = np.clip(np.searchsorted(labels[order], label), 0, len(labels) - 1)
    has_truth = labels[order][index] == label
    return np.where(has_truth[:, None], point_m[order][index], np.nan)
