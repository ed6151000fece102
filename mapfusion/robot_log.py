"""Robot log: the measurements of one robot, and the truth in files beside them.

A log is a folder of Parquet tables, each readable with plain pandas:

- `frames.parquet`: one row a frame, also for frames without observations.
- `observations.parquet`: one row an observation, ordered by frame.
- `odometry_covariance.parquet`: optional; covariance of visual odometry. Without this file, the
  odometry has the motion noise of the filter.
- `truth_poses.parquet`, `truth_points.parquet`: optional; only the evaluation reads them.

All observations of a track show the same point, which has a small offset from the landmark. This
offset differs between tracks. Within a track it is constant, so it does not average out.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.camera import EXACT, CalibrationError, calibration_from
from mapfusion.descriptors import DescriptorKind, as_vectors
from mapfusion.errors import InputError
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSE_FIELDS,
    POSITION_FIELDS,
    column,
    columns,
    covariance_columns,
    covariances_from,
    described,
    float_fields,
    name_in_text,
    named_columns,
    point_columns,
    point_fields,
    points_from,
    read_table,
    require_cells,
    require_one_row_a_frame,
    schema,
    write_table,
)
from mapfusion.geometry.numerics import (
    LARGEST_POSITION_M,
    Float,
    require_finite,
    require_no_twins,
    require_points,
    require_shape,
    with_rows,
)
from mapfusion.tables import (
    APPEARANCE_FIELDS,
    appearance_columns,
    appearance_from,
    appearance_schema,
    read_open_table,
    require_appearance,
    table_path,
)

NO_TRACK = -1
_MAX_NAMED = 5  # logs in one message
# Limit of the heading increment between two frames, as a number. Larger turns are not observable
# modulo 360 degrees. The limit admits a log in degrees, so that a later check can name the wrong
# unit.
LARGEST_TURN = 360.0
TRUTH_TABLES = ("truth_poses", "truth_points")
TRUTH_FILES = tuple(f"{name}.parquet" for name in TRUTH_TABLES)
_ITERATION = described(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ...")
_ODOMETRY_FIELDS = ["odometry_x_m", "odometry_y_m", "odometry_theta_rad"]
_PIXEL_FIELDS = ["u_px", "v_px", "disparity_px"]  # left image; NaN where there are no images

FRAMES = schema(
    "robot_log.frames",
    1,
    [
        _ITERATION,
        described(
            pa.field("time_s", pa.float64()), "time of the frame, increasing from row to row"
        ),
        *(
            described(
                field,
                "motion since the previous row, in the robot frame of that row; row 0 is not used",
            )
            for field in float_fields(_ODOMETRY_FIELDS)
        ),
    ],
)
OBSERVATIONS = schema(
    "robot_log.observations",
    3,  # 1 had no tracks, 2 descriptors of 64 numbers only
    [
        described(_ITERATION, "number of the frame; rows are ordered by frame"),
        *(
            described(field, "position and covariance of the observation, in the robot frame")
            for field in point_fields()
        ),
        *(
            described(
                pa.field(name, pa.float32()),
                "pixel and disparity in the left image, NaN without images",
                np.nan,
            )
            for name in _PIXEL_FIELDS
        ),
        *APPEARANCE_FIELDS,
        described(pa.field("track", pa.int32()), "number of the track, -1 for none", NO_TRACK),
    ],
)
TRUTH_POSES = schema(
    "robot_log.truth_poses",
    1,
    [
        _ITERATION,
        *(
            described(field, "true pose T_world_robot, NaN if unknown")
            for field in float_fields(POSE_FIELDS)
        ),
    ],
)
TRUTH_POINTS = schema(
    "robot_log.truth_points",
    1,
    [
        described(
            field, "true point of the observation in this row, in the world frame; NaN if unknown"
        )
        for field in float_fields(POSITION_FIELDS)
    ],
)


@dataclass(frozen=True)
class Observations:
    """Landmark observations of one frame or of a whole log.

    Attributes:
        position_m: (N, 3) in the robot frame.
        covariance_m2: (N, 3, 3), R_t of eq. 6 in Cartesian coordinates.
        descriptor: (N, D) float32 vectors, NaN for none; or None. Packed bits (N, B) uint8 become
            vectors of bits.
        label: (N,) int32 known identities, or None.
        uvd_px: (N, 3) float32 u, v, disparity in the left image, or None.
        track: (N,) int32 number of the track, NO_TRACK for none; None without tracks. All
            observations of a track show the same point; other observations of the landmark show
            points close to it.
        descriptor_kind: kind of the descriptors; None: that of the numbers (see `as_vectors`).
    """

    position_m: Float
    covariance_m2: Float
    descriptor: np.ndarray | None = None
    label: np.ndarray | None = None
    uvd_px: np.ndarray | None = None
    track: np.ndarray | None = None
    descriptor_kind: DescriptorKind | None = None

    def __post_init__(self) -> None:
        n = len(self.position_m)
        require_shape("position_m", self.position_m, (n, 3))
        require_shape("covariance_m2", self.covariance_m2, (n, 3, 3))
        require_finite("position_m", self.position_m)
        require_finite("covariance_m2", self.covariance_m2)
        optional = {"descriptor": (None,), "label": (), "uvd_px": (3,), "track": ()}
        for name, shape in optional.items():
            if getattr(self, name) is not None:
                require_shape(name, getattr(self, name), (n, *shape))
        if self.descriptor is None:
            object.__setattr__(self, "descriptor_kind", None)
        else:
            descriptor, kind = as_vectors(self.descriptor, self.descriptor_kind)
            object.__setattr__(self, "descriptor", descriptor)
            object.__setattr__(self, "descriptor_kind", kind)

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: slice | np.ndarray) -> "Observations":
        return with_rows(self, rows)


@dataclass(frozen=True)
class RobotLog:
    """Measurements of one robot.

    Attributes:
        robot: name of the robot.
        planar: range-and-bearing data; z is 0 and is not used in gates and weights.
        time_s: (T,) times of the frames.
        odometry: (T, 3) motion since the frame before, in the robot frame; the first row is zero.
        iteration: (N,) frame of each observation, ascending.
        observations: N observations.
        calibration: error of the camera calibration, which all observations share.
    """

    robot: str
    planar: bool
    time_s: Float
    odometry: Float
    iteration: np.ndarray
    observations: Observations
    calibration: CalibrationError = EXACT

    def __post_init__(self) -> None:
        require_shape("odometry", self.odometry, (len(self.time_s), 3))
        require_shape("iteration", self.iteration, (len(self.observations),))
        require_finite("odometry", self.odometry)
        if np.any(np.diff(self.iteration) < 0):
            raise ValueError("iteration: observations must be ordered by iteration")
        if len(self.iteration) and not 0 <= self.iteration[0] <= self.iteration[-1] < len(self):
            raise ValueError(f"iteration: must lie in 0..{len(self) - 1}")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    def frame_starts(self) -> np.ndarray:
        """Return the row (T + 1,) of each frame's first observation."""
        return np.searchsorted(self.iteration, np.arange(len(self) + 1))


@dataclass(frozen=True)
class RobotTruth:
    """Truth of a log: `T_world_robot` (T, 3), `point_world_m` (N, 3); NaN if unknown."""

    T_world_robot: Float
    point_world_m: Float


def write_observations(folder: Path, iteration: np.ndarray, observations: Observations) -> None:
    """Write `observations.parquet` into a log's folder."""
    n = len(observations)
    uvd = observations.uvd_px if observations.uvd_px is not None else np.full((n, 3), np.nan)
    track = np.full(n, NO_TRACK) if observations.track is None else observations.track
    kind = observations.descriptor_kind
    looks = appearance_columns(n, observations.descriptor, observations.label, kind)
    write_table(
        folder / "observations.parquet",
        {
            "iteration": iteration.astype(np.int32),
            **point_columns(observations.position_m, observations.covariance_m2),
            **named_columns(_PIXEL_FIELDS, uvd.astype(np.float32)),
            **looks,
            "track": track.astype(np.int32),
        },
        appearance_schema(OBSERVATIONS, looks),
        None if kind is None else kind.attributes(),
    )


def _observations(folder: Path) -> tuple[np.ndarray, Observations, bool]:
    """Read frame numbers (N,) and observations; True if the file itself marks them as planar."""
    path = table_path(folder, "observations")
    table, attributes = read_open_table(path, OBSERVATIONS)
    iteration = column(table, "iteration")
    require_cells(path, table, ["iteration"], lambda frame: frame >= 0, "frames are 0, 1, 2, ...")
    back = np.flatnonzero(np.diff(iteration) < 0)
    if len(back):
        row = back[0] + 1
        found = f"is {iteration[row]} in row {row}, after {iteration[row - 1]}"
        raise InputError(f"{path}: column iteration: {found}; sort the rows by iteration")
    finite = "give a finite number, or remove the row"
    require_cells(path, table, [*POSITION_FIELDS, *COVARIANCE_FIELDS], np.isfinite, finite)
    no_image = "give a finite number, or NaN for none"
    require_cells(path, table, _PIXEL_FIELDS, lambda px: ~np.isinf(px), no_image)
    numbered = f"tracks are {NO_TRACK} for none, or 0 and more"
    require_cells(path, table, ["track"], lambda track: track >= NO_TRACK, numbered)
    require_appearance(path, table)
    position, covariance = points_from(table)
    uvd, track = columns(table, _PIXEL_FIELDS), column(table, "track")
    descriptor, label, kind = appearance_from(path, table, attributes)
    try:
        observations = Observations(
            position,
            covariance,
            descriptor,
            label,
            None if np.isnan(uvd).all() else uvd,
            None if np.all(track == NO_TRACK) else track,
            kind,
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return iteration, observations, attributes.get("planar") == "true"


def write_frames(
    folder: Path,
    robot: str,
    planar: bool,
    time_s: Float,
    odometry: Float,
    calibration: CalibrationError = EXACT,
) -> None:
    """Write `frames.parquet` into a log's folder."""
    write_table(
        folder / "frames.parquet",
        {
            "iteration": np.arange(len(time_s), dtype=np.int32),
            "time_s": time_s,
            **named_columns(_ODOMETRY_FIELDS, odometry),
        },
        FRAMES,
        {"robot": robot, "planar": str(planar).lower(), **calibration.attributes()},
    )


def write_log(folder: str | Path, log: RobotLog) -> None:
    """Write a whole log (without truth) into `folder`."""
    folder = Path(folder)
    write_frames(folder, log.robot, log.planar, log.time_s, log.odometry, log.calibration)
    write_observations(folder, log.iteration, log.observations)


def read_log(folder: str | Path) -> RobotLog:
    """Read a log; an InputError names the file."""
    folder = Path(folder)
    path = table_path(folder, "frames")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (expected a robot log with frames.parquet)")
    if not path.is_file():
        logs = [each for each in sorted(folder.iterdir()) if table_path(each, "frames").is_file()]
        if logs:
            names = ", ".join(each.name for each in logs[:_MAX_NAMED])
            names += ", ..." if len(logs) > _MAX_NAMED else ""
            found = f"is a folder of {len(logs)} robot logs ({names})" if logs[1:] else "is no log"
            raise InputError(f"{folder}: {found}; name one log, such as {logs[0]}")
        for kind in ("ranges", "points"):
            if table_path(folder, kind).is_file():
                made = f"`mapfusion import {kind} {folder} -o logs` makes a log of it"
                raise InputError(f"{folder}: is a recording, not a robot log; {made}")
    frames, attributes = read_open_table(path, FRAMES)
    _require_numbered(path, frames)
    finite = "give a finite number"
    require_cells(path, frames, ["time_s", *_ODOMETRY_FIELDS], np.isfinite, finite)
    odometry, time_s = columns(frames, _ODOMETRY_FIELDS), column(frames, "time_s")
    still = np.flatnonzero(np.diff(time_s) <= 0)
    if len(still):
        row = still[0] + 1
        found = f"is {time_s[row]:.15g} in row {row}, after {time_s[row - 1]:.15g}"
        remedy = "times must increase from row to row; mend the clock or the order of the rows"
        raise InputError(f"{path}: column time_s: {found}; {remedy}")
    way = f"the motion since the row before is at most {LARGEST_POSITION_M:g} m"
    require_cells(
        path, frames, _ODOMETRY_FIELDS[:2], lambda moved: abs(moved) <= LARGEST_POSITION_M, way
    )
    turn = f"the turn since the row before, in radians, is at most {LARGEST_TURN:g}"
    require_cells(path, frames, _ODOMETRY_FIELDS[2:], lambda by: abs(by) <= LARGEST_TURN, turn)
    iteration, observations, planar = _observations(folder)
    seen = table_path(folder, "observations")
    beyond = np.flatnonzero(iteration >= frames.num_rows)
    if len(beyond):
        found = f"iteration is {iteration[beyond[0]]} in row {beyond[0]}"
        last = f"{path.name} ends with frame {frames.num_rows - 1}"
        raise InputError(f"{seen}: {found}, but {last}; add the frames or remove the rows")
    if "robot" in attributes:
        planar = attributes.get("planar") == "true"
    name = attributes.get("robot", name_in_text(folder.resolve().name))
    odometry[:1] = 0.0  # the first frame has no row before
    calibration = calibration_from(attributes, path)
    try:
        log = RobotLog(name, planar, time_s, odometry, iteration, observations, calibration)
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from error
    try:
        require_points(observations.position_m, observations.covariance_m2, planar)
        label = observations.label
        label = np.zeros(len(iteration)) if label is None else label
        points = (observations.position_m, observations.covariance_m2.reshape(-1, 9))
        require_no_twins("observations", iteration, label, *points)
    except ValueError as error:
        raise InputError(f"{seen}: {error}") from error
    return log


def _require_numbered(path: Path, table: pa.Table) -> None:
    """Raise InputError unless the frames are numbered 0, 1, 2, ..."""
    wrong = np.flatnonzero(column(table, "iteration") != np.arange(table.num_rows))
    if len(wrong):
        row = wrong[0]
        found = f"is {column(table, 'iteration')[row]} in row {row}"
        raise InputError(f"{path}: iteration {found}; there must be 0, 1, 2, ..., one row each")


def write_truth_points(folder: Path, point_world_m: Float) -> None:
    """Write `truth_points.parquet`: (N, 3), one row for each observation."""
    write_table(
        folder / "truth_points.parquet",
        named_columns(POSITION_FIELDS, point_world_m),
        TRUTH_POINTS,
    )


def write_truth_poses(folder: Path, T_world_robot: Float) -> None:
    """Write `truth_poses.parquet`: (T, 3)."""
    write_table(
        folder / "truth_poses.parquet",
        {
            "iteration": np.arange(len(T_world_robot), dtype=np.int32),
            **named_columns(POSE_FIELDS, T_world_robot),
        },
        TRUTH_POSES,
    )


def read_true_poses(folder: Path) -> Float | None:
    """Read the true poses T_world_robot (T, 3) beside a log; None if there are none.

    Raises:
        InputError: the table is damaged or not as documented.
    """
    path = table_path(folder, TRUTH_TABLES[0])
    if not path.is_file():
        return None
    table, _ = read_open_table(path, TRUTH_POSES)
    _require_numbered(path, table)
    return _require_true(path, columns(table, POSE_FIELDS))


def read_true_points(folder: Path) -> Float | None:
    """Read the true points (N, 3) of a log's observations; None if there are none.

    Raises:
        InputError: the table is damaged or not as documented.
    """
    path = table_path(folder, TRUTH_TABLES[1])
    if not path.is_file():
        return None
    table, _ = read_open_table(path, TRUTH_POINTS)
    return _require_true(path, columns(table, POSITION_FIELDS))


def _require_true(path: Path, values: Float) -> Float:
    """Return rows of the truth (N, 3); raise InputError for a row that is known in part."""
    is_known = ~np.isnan(values)
    half = is_known.any(1) & ~is_known.all(1)
    large = (np.abs(values) > LARGEST_POSITION_M).any(1)  # infinity is
    for wrong, what in ((half, "known in part"), (large, "infinite or above 1e7 m")):
        if wrong.any():
            raise InputError(f"{path}: the truth is {what} in row {np.flatnonzero(wrong)[0]}")
    return values


def read_truth(folder: Path) -> RobotTruth:
    """Read poses and points of the truth beside a log. For evaluation only.

    Raises:
        InputError: a table is missing, damaged or not as documented.
    """
    poses, points = read_true_poses(folder), read_true_points(folder)
    for name, values in zip(TRUTH_TABLES, (poses, points), strict=True):
        if values is None:
            raise InputError(f"{table_path(folder, name)}: no such file (expected the truth)")
    assert poses is not None
    assert points is not None
    return RobotTruth(poses, points)


def first_frames(log: RobotLog, n_frames: int) -> RobotLog:
    """Return the log of the first `n_frames` frames."""
    n = int(np.searchsorted(log.iteration, n_frames))
    return replace(
        log,
        time_s=log.time_s[:n_frames],
        odometry=log.odometry[:n_frames],
        iteration=log.iteration[:n],
        observations=log.observations[:n],
    )


FILE = "odometry_covariance.parquet"
_FIELDS = ["cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt"]
ODOMETRY_COVARIANCE = schema(
    "robot_log.odometry_covariance",
    1,
    [
        described(pa.field("iteration", pa.int32()), "number of the frame: 0, 1, 2, ..."),
        *(
            described(field, "covariance of the motion since the previous row: m², m rad, rad²")
            for field in float_fields(_FIELDS)
        ),
    ],
)


def write_odometry_covariance(folder: Path, covariance: Float | None) -> None:
    """Write the covariance (T, 3, 3) of x, y, theta into a log's folder; None removes it."""
    if covariance is None:
        (folder / FILE).unlink(missing_ok=True)
        return
    n = len(covariance)
    require_shape("covariance", covariance, (n, 3, 3))
    iteration = np.arange(n, dtype=np.int32)
    rows = {"iteration": iteration, **covariance_columns(_FIELDS, covariance)}
    write_table(folder / FILE, rows, ODOMETRY_COVARIANCE)


def read_odometry_covariance(folder: Path, n_frames: int | None = None) -> Float | None:
    """Read the covariance (T, 3, 3) of a log's odometry; None if its folder holds none.

    Args:
        folder: folder of the log.
        n_frames: number of frames of the log; None if unknown.

    Raises:
        InputError: the file is damaged or not as documented.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    table, _ = read_table(path, ODOMETRY_COVARIANCE)
    require_one_row_a_frame(path, table, n_frames)
    require_cells(path, table, _FIELDS, np.isfinite, "give finite numbers, or remove the file")
    covariance = covariances_from(table, _FIELDS)
    low, high = np.linalg.eigvalsh(covariance[1:])[:, [0, -1]].T  # the first row has no motion
    wrong = np.flatnonzero(low <= np.finfo(float).eps * high)
    if len(wrong):
        row = wrong[0] + 1
        raise InputError(f"{path}: not positive definite in row {row}; mend it, or remove the file")
    return covariance


# Standard deviation, per axis, of a track's offset from its landmark, for corners.
STRAY_M = 0.002
# The same for the landmarks of the filter, which confuses some close neighbours.
FILTERED_STRAY_M = 0.004
