"""KITTI layouts of stereo recordings: odometry benchmark and raw data.

Geiger, Lenz, Urtasun (2012), "Are we ready for autonomous driving? The KITTI vision benchmark
suite". A sequence is a folder:

- `image_0`, `image_1` (grey) or `image_2`, `image_3` (colour): rectified pictures 000000.png, ...
- `calib.txt`: `P0:` to `P3:`, projection matrices (3, 4), row by row, of the cameras 0 to 3.
- `times.txt`: seconds since the beginning, one a line.
- the true poses of the left camera (3, 4), one a line: `poses/NN.txt` beside the folder `sequences`
  that holds sequence NN, or `poses.txt` in the sequence; optional.
- `odometry.tum`: dead reckoning of the robot; an extension of this package, optional.

Geiger, Lenz, Stiller, Urtasun (2013), "Vision meets robotics: the KITTI dataset". A drive is a
folder `DATE_drive_NNNN_sync` in the folder of its day, which holds the calibration:

- `image_00`, `image_01` (grey) or `image_02`, `image_03` (colour): `data/0000000000.png`, ... and
  `timestamps.txt`, one date and time a line. Pictures of one number were taken together.
- `calib_cam_to_cam.txt`: `S_rect_0N` width and height, `R_rect_00` from camera 0 to the rectified
  one, `P_rect_0N` projection matrices (3, 4), row by row.
- `oxts`: `data/0000000000.txt` (latitude, longitude, altitude, roll, pitch, yaw and more that is
  not read) and `timestamps.txt`; the truth; needs `calib_imu_to_velo.txt` and
  `calib_velo_to_cam.txt` (`R`, `T`); optional.
- `odometry.tum`: dead reckoning of the robot; an extension of this package, optional.

The exporter writes the grey cameras 0 and 1, `odometry.tum` and `poses.txt` into the folder of the
sequence.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from mapfusion.datasets.camera_calibration import (
    R_ROBOT_OPTICAL,
    Lens,
    StereoCalibration,
    require_rigid,
)
from mapfusion.datasets.levelling import MountSettings, level_mount
from mapfusion.datasets.stereo_recording import (
    OnFrame,
    PictureFile,
    ReadYaml,
    Shot,
    StereoDrive,
    StereoRecording,
    pair_shots,
    write_dead_reckoning,
    write_picture,
    write_text,
)
from mapfusion.datasets.text_files import (
    NS,
    POSES,
    TimedPoses,
    parse_numbers,
    read_odometry_beside,
    read_rows,
    read_time_series,
    require_columns,
    require_increasing,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float

HEIGHT_M = 1.65  # of KITTI's cameras above the road, by its publication
_DIGITS = 6  # of the name of a picture of a sequence
_RAW_DIGITS = 10  # of a file name of a raw drive
_POSE_COLUMNS = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"
_OXTS_NUMBERS = 30  # columns; the first six are read
_RAW_CALIBRATION = "calibration of KITTI's raw data"  # for messages
_EARTH_M = 6_378_137.0  # equatorial radius, as in KITTI's own conversion


@dataclass(frozen=True)
class KittiSettings:
    """Settings of the importers of KITTI sequences and raw drives.

    Attributes:
        cameras: the grey pair (0 and 1) or the colour pair (2 and 3).
        mount: replaces the default mount: a left camera that looks level ahead 1.65 m above the
            road.
    """

    cameras: Literal["grey", "colour"] = "grey"
    mount: MountSettings = field(default_factory=MountSettings)


def numbered_shots(
    folder: Path, digits: int, camera: str, time_ns: np.ndarray, times: Path
) -> list[Shot]:
    """Return the pictures 000...0.png, ... of a folder, each with the time of its number.

    Args:
        folder: folder of the pictures.
        digits: number of digits of their names.
        camera: name of the camera, for messages.
        time_ns: times of the numbers 0 to T - 1, shape (T,), int64.
        times: file of the times, for messages.

    Raises:
        InputError: the folder does not exist, or a number has no time.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (pictures of a KITTI recording)")
    named = "[0-9]" * digits + ".png"
    pictures = {int(path.stem): path for path in sorted(folder.glob(named))}
    if not pictures:
        example = next(
            (path.name for path in sorted(folder.iterdir()) if path.is_file()), "no file"
        )
        named = f"{'0' * digits}.png, ..., expected of a KITTI recording; it holds {example}"
        raise InputError(f"{folder}: holds no picture named {named}")
    beyond_last = [number for number in pictures if number >= len(time_ns)]
    if beyond_last:
        raise InputError(f"{times}: has {len(time_ns)} times, none for {pictures[beyond_last[0]]}")
    return [
        Shot(int(time_ns[number]), f"{camera}/{path.name}", PictureFile(path))
        for number, path in pictures.items()
    ]


def read_kitti(folder: Path, settings: KittiSettings, _: ReadYaml) -> StereoRecording:
    """Read a sequence of the odometry benchmark; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or of another format; the message names file and
            line.
    """
    time_file = folder / "times.txt"
    taken_ns = read_time_series(time_file, "times of a KITTI sequence", "time", NS)[0]
    first = 0 if settings.cameras == "grey" else 2
    folders = [folder / f"image_{camera}" for camera in (first, first + 1)]
    left, right = (numbered_shots(f, _DIGITS, f.name, taken_ns, time_file) for f in folders)
    time_ns, pictures, dropped = pair_shots(folder, left, right)

    calibration_file = folder / "calib.txt"
    parsed = _read_calibration(calibration_file, "calibration of a KITTI sequence")
    P = [parse_matrix(calibration_file, parsed, f"P{first + k}", (3, 4)) for k in (0, 1)]
    height, width = pictures[0][0]().shape[:2]
    calibration = rectified_calibration(calibration_file, P, (width, height))
    baseline_m = float(calibration.T_left_right[0, 3])
    T_robot_left = settings.mount.applied(level_mount(baseline_m, 0.0, HEIGHT_M))

    sequence = folder.resolve()
    beside = sequence.parent.parent / "poses" / f"{sequence.name}.txt"
    truth = next((path for path in (sequence / "poses.txt", beside) if path.exists()), None)
    return StereoRecording(
        sequence.name,
        time_ns,
        pictures,
        calibration,
        T_robot_left,
        None if truth is None else _read_truth(truth, taken_ns, T_robot_left),
        read_odometry_beside(folder),
        dropped,
        calibrated_by=str(calibration_file),
    )


def _read_calibration(path: Path, what: str) -> dict[str, tuple[int, list[str]]]:
    """Return line number and words of each line of a calibration file, by its first word."""
    return {words[0].removesuffix(":"): (line, words[1:]) for line, words in read_rows(path, what)}


def parse_matrix(
    path: Path, parsed: dict[str, tuple[int, list[str]]], name: str, shape: tuple[int, ...]
) -> Float:
    """Return a matrix of a calibration file.

    Args:
        path: calibration file, for messages.
        parsed: line number and words of each line, by name.
        name: name of the matrix.
        shape: shape of the matrix; the numbers are row by row.

    Raises:
        InputError: the matrix is missing or damaged; the message names file and line.
    """
    n = int(np.prod(shape))
    if name not in parsed:
        raise InputError(f"{path}: has no line {name}: ({n} numbers)")
    line, words = parsed[name]
    if len(words) != n:
        found = f"{name}: has {len(words)} numbers, expected {n} ({' x '.join(map(str, shape))})"
        raise InputError(f"{path}, line {line}: {found}")
    return np.array(parse_numbers(path, line, words)).reshape(shape)


def rectified_calibration(
    path: Path, matrices: list[Float], size_px: tuple[int, int]
) -> StereoCalibration:
    """Return the pair of cameras of two projection matrices (3, 4) that were read from `path`."""
    lenses = []
    try:
        for P in matrices:
            focal, center = (P[0, 0], P[1, 1]), (P[0, 2], P[1, 2])
            lenses.append(Lens(size_px, focal, center))
        # All cameras are rectified to camera 0; only offsets along the rows matter.
        x_m = np.array([-P[0, 3] / P[0, 0] for P in matrices])
        T_left_right = se3.pose(np.eye(3), [x_m[1] - x_m[0], 0.0, 0.0])
        return StereoCalibration(lenses[0], lenses[1], T_left_right)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read_truth(path: Path, time_ns: np.ndarray, T_robot_left: Float) -> TimedPoses:
    """Return T_world_robot; the world is the robot's frame at the beginning."""
    rows = []
    for line, words in read_rows(path, "true poses"):
        require_columns(path, line, words, _POSE_COLUMNS, POSES)
        rows.append(parse_numbers(path, line, words))
    if len(rows) != len(time_ns):
        raise InputError(f"{path}: has {len(rows)} poses for {len(time_ns)} times")
    P = np.array(rows).reshape(-1, 3, 4)
    T = se3.pose(P[:, :, :3], P[:, :, 3])
    for number, each in enumerate(T, start=1):
        try:
            require_rigid("[R t]", each)
        except InputError as error:
            raise InputError(f"{path}, pose {number}: {error}") from error
    axes = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T_first_left = axes @ T @ se3.inverse(axes)
    return TimedPoses(time_ns, T_robot_left @ T_first_left @ se3.inverse(T_robot_left))


def read_kitti_raw(folder: Path, settings: KittiSettings, _: ReadYaml) -> StereoRecording:
    """Read a raw drive; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or of another format; the message names file and
            line.
    """
    first = 0 if settings.cameras == "grey" else 2
    drive = folder.resolve()
    cameras = [drive / f"image_{camera:02d}" for camera in (first, first + 1)]
    time_file = cameras[0] / "timestamps.txt"
    taken_ns = _read_timestamps(time_file)
    left, right = (
        numbered_shots(each / "data", _RAW_DIGITS, f"{each.name}/data", taken_ns, time_file)
        for each in cameras
    )
    time_ns, pictures, dropped = pair_shots(folder, left, right)

    calibration_file = _find_calibration(drive, "calib_cam_to_cam.txt")
    parsed = _read_calibration(calibration_file, _RAW_CALIBRATION)
    P = [parse_matrix(calibration_file, parsed, f"P_rect_{first + k:02d}", (3, 4)) for k in (0, 1)]
    stated_size = parse_matrix(calibration_file, parsed, f"S_rect_{first:02d}", (2,))
    width, height = stated_size.astype(int)
    size = pictures[0][0]().shape[1::-1]
    if size != (width, height):
        sizes_text = f"pictures are {size[0]}x{size[1]}, rectified ones {width}x{height}"
        raise InputError(f"{folder}: {sizes_text}; give the drive whose name ends in _sync")
    pair = rectified_calibration(calibration_file, P, size)
    baseline_m = float(pair.T_left_right[0, 3])
    T_robot_left = settings.mount.applied(level_mount(baseline_m, 0.0, HEIGHT_M))

    truth = None
    if (drive / "oxts").is_dir():
        # Transform of the inertial unit into the rectified camera 0.
        R_rect = parse_matrix(calibration_file, parsed, "R_rect_00", (3, 3))
        T_rect_imu = se3.pose(R_rect, np.zeros(3))
        for name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt"):
            path = _find_calibration(drive, name)
            step_parsed = _read_calibration(path, _RAW_CALIBRATION)
            R, t = (parse_matrix(path, step_parsed, *key) for key in (("R", (3, 3)), ("T", (3,))))
            step = se3.pose(R, t)
            require_rigid(f"{path}: R and T", step)
            T_rect_imu = T_rect_imu @ step
        # The left camera is displaced along the rows of the rectified camera 0.
        offset = [-P[0][0, 3] / P[0][0, 0], 0.0, 0.0]
        T_imu_left = se3.inverse(T_rect_imu) @ se3.pose(np.eye(3), offset)
        T_imu_ahead = T_imu_left @ se3.inverse(se3.pose(R_ROBOT_OPTICAL, np.zeros(3)))
        truth = _read_oxts(drive / "oxts").moved(T_imu_ahead @ se3.inverse(T_robot_left))
    return StereoRecording(
        drive.name,
        time_ns,
        pictures,
        pair,
        T_robot_left,
        truth,
        read_odometry_beside(folder),
        dropped,
        calibrated_by=str(calibration_file),
    )


def _read_timestamps(path: Path) -> np.ndarray:
    """Return the times of `timestamps.txt` in ns, shape (T,), int64."""
    lines, times = list[int](), list[int]()
    for line, words in read_rows(path, "times of a raw drive of KITTI"):
        try:
            when = np.datetime64("T".join(words), "ns")
        except ValueError:
            raise InputError(f"{path}, line {line}: {' '.join(words)!r} is no time") from None
        lines.append(line)
        times.append(int(when.astype(np.int64)))
    time_ns = np.array(times, dtype=np.int64)
    require_increasing(path, lines, time_ns)
    return time_ns


def _find_calibration(drive: Path, name: str) -> Path:
    """Return the path of a calibration file, which lies in the drive or in the folder above."""
    return next((p for p in (drive / name, drive.parent / name) if p.is_file()), drive / name)


def _read_oxts(oxts: Path) -> TimedPoses:
    """Return T_world_imu: east, north, up, in the Mercator projection of the first latitude."""
    stamps = oxts / "timestamps.txt"
    time_ns, used_rows, rows = _read_timestamps(stamps), list[int](), list[list[float]]()
    for k, stamp_ns in enumerate(time_ns.tolist()):
        path = oxts / "data" / f"{k:0{_RAW_DIGITS}d}.txt"
        if path.is_file():  # some drives lack a few
            state = next(read_rows(path, "a state"), None)
            if state is None:
                continue
            line, words = state
            if len(words) != _OXTS_NUMBERS:
                column_text = (
                    f"has {len(words)} columns, expected {_OXTS_NUMBERS} (of an OXTS unit)"
                )
                raise InputError(f"{path}, line {line}: {column_text}")
            used_rows.append(stamp_ns)
            rows.append(parse_numbers(path, line, words))
    if not rows:
        raise InputError(f"{oxts}: holds no data/{'0' * _RAW_DIGITS}.txt")
    latitude, longitude, up, roll, pitch, yaw = np.array(rows)[:, :6].T
    scale = np.cos(np.radians(latitude[0])) * _EARTH_M
    east = scale * np.radians(longitude)
    north = scale * np.arcsinh(np.tan(np.radians(latitude)))
    R = se3.from_planar(np.column_stack([east, north, yaw]))[:, :3, :3] @ se3.tilt(roll, pitch)
    position = np.column_stack([east, north, up])
    return TimedPoses(np.array(used_rows, dtype=np.int64), se3.pose(R, position - position[0]))


def write_kitti(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive into the folder `folder/ROBOT` and return its path."""
    sequence = folder / drive.robot
    for k in range(len(drive)):
        for camera, image in enumerate(drive.pair(k)):
            write_picture(sequence / f"image_{camera}" / f"{k:06d}.png", image)
        on_frame(k + 1, len(drive))
    f, (cu, cv) = drive.camera.focal_px, drive.camera.center_px
    lines = []
    for camera in (0, 1):
        P = np.array([[f, 0, cu, 0], [0, f, cv, 0], [0, 0, 1, 0]], dtype=np.float64)
        P[0, 3] = -camera * f * drive.camera.baseline_m
        lines.append(f"P{camera}: {_matrix_text(P)}")
    write_text(sequence / "calib.txt", lines)
    write_text(sequence / "times.txt", [str(t) for t in drive.time_s.tolist()])
    T_robot_left = drive.mount(0)
    T_world_left = drive.true_bodies @ T_robot_left
    poses = se3.between(T_world_left[0], T_world_left)
    write_text(sequence / "poses.txt", [_matrix_text(T[:3]) for T in poses])
    write_dead_reckoning(sequence, drive)
    return [sequence]


def kitti_text(T_frame_robot: Float) -> str:
    """Return poses (T, 3) of a robot in KITTI's trajectory format: one (3, 4) matrix a line.

    Frame and body have camera axes as in KITTI: x right, y down, z ahead.
    """
    axes = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T = se3.inverse(axes) @ se3.from_planar(T_frame_robot) @ axes
    return "\n".join([*(_matrix_text(each[:3]) for each in T), ""])


def _matrix_text(matrix: Float) -> str:
    """Return the numbers of a matrix, row by row, separated by spaces."""
    return " ".join(map(str, matrix.ravel().tolist()))
