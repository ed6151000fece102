"""KITTI layouts of stereo recordings: odometry benchmark and raw data.

Geiger, Lenz, Urtasun (2012), "Are we ready for autonomous driving? The KITTI vision benchmark
suite". A sequence is a folder:

- `image_0`, `image_1` (grey) or `image_2`, `image_3` (colour): rectified pictures 000000.png, ...
- `calib.txt`: `P0:` to `P3:`, projection matrices (3, 4), row by row, of the cameras 0 to 3.
- `times.txt`: seconds since the beginning, one a line.
- the true poses of the left camera (3, 4), one a line: `poses/NN.txt` beside the folder `sequences`
  that holds sequence NN, or `poses.txt` in the sequence; optional.
- `odometry.tum`: dead reckoning of the robot's axes, which KITTI has not; ours, optional.

Geiger, Lenz, Stiller, Urtasun (2013), "Vision meets robotics: the KITTI dataset". A drive is a
folder `DATE_drive_NNNN_sync`, and lies in the folder of its day with the calibration:

- `image_00`, `image_01` (grey) or `image_02`, `image_03` (colour): `data/0000000000.png`, ... and
  `timestamps.txt`, one date and time a line. Pictures of one number were taken together.
- `calib_cam_to_cam.txt`: `S_rect_0N` width and height, `R_rect_00` from camera 0 to the rectified
  one, `P_rect_0N` projection matrices (3, 4), row by row.
- `oxts`: `data/0000000000.txt` (latitude, longitude, altitude, roll, pitch, yaw and more that is
  not read) and `timestamps.txt`; the truth, with `calib_imu_to_velo.txt` and
  `calib_velo_to_cam.txt` (`R`, `T`); optional.
- `odometry.tum`: dead reckoning of the robot's axes, which KITTI has not; ours, optional.

Written are the grey cameras 0 and 1, `odometry.tum` and `poses.txt` in the sequence's folder.
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
from mapfusion.datasets.export import OnFrame, StereoDrive, write_picture, write_text
from mapfusion.datasets.levelling import MountSettings, level_mount
from mapfusion.datasets.stereo_recording import (
    PictureFile,
    ReadYaml,
    Shot,
    StereoRecording,
    pair_shots,
)
from mapfusion.datasets.text_files import (
    NS,
    POSES,
    parse_numbers,
    parse_time_ns,
    read_rows,
    require_columns,
    require_increasing,
)
from mapfusion.datasets.tum import ODOMETRY_FILE, TimedPoses, read_odometry, tum_text
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float


def numbered_shots(
    folder: Path, digits: int, camera: str, time_ns: np.ndarray, times: Path
) -> list[Shot]:
    """The pictures 000...0.png, ... of a folder, each with the time that its number has.

    Args:
        folder: of the pictures.
        digits: of their names.
        camera: what it is called in messages.
        time_ns: (T,) int64 of the numbers 0 to T - 1.
        times: where these were read, for messages.

    Raises:
        InputError: there is no such folder, or a number has no time.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (pictures of a KITTI recording)")
    named = "[0-9]" * digits + ".png"
    pictures = {int(path.stem): path for path in sorted(folder.glob(named))}
    if not pictures:
        there = next((path.name for path in sorted(folder.iterdir()) if path.is_file()), "no file")
        named = f"{'0' * digits}.png, ..., expected of a KITTI recording; it holds {there}"
        raise InputError(f"{folder}: holds no picture named {named}")
    late = [number for number in pictures if number >= len(time_ns)]
    if late:
        raise InputError(f"{times}: has {len(time_ns)} times, none for {pictures[late[0]]}")
    return [
        Shot(int(time_ns[number]), f"{camera}/{path.name}", PictureFile(path))
        for number, path in pictures.items()
    ]


HEIGHT_M = 1.65  # of KITTI's cameras above the road, by its publication
_DIGITS = 6  # of a picture's name
_POSE_COLUMNS = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"


@dataclass(frozen=True)
class KittiSettings:
    """How KITTI sequences and raw drives are read.

    Attributes:
        cameras: the grey pair (0 and 1) or that in colour (2 and 3).
        mount: what replaces a left camera that looks level ahead 1.65 m above the road.
    """

    cameras: Literal["grey", "colour"] = "grey"
    mount: MountSettings = field(default_factory=MountSettings)


def read_kitti(folder: Path, settings: KittiSettings, _: ReadYaml) -> StereoRecording:
    """Read a sequence; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or foreign; names file and line.
    """
    first = 0 if settings.cameras == "grey" else 2
    folders = [folder / f"image_{camera}" for camera in (first, first + 1)]
    timed = folder / "times.txt"
    times = _times(timed)
    left, right = (numbered_shots(each, _DIGITS, each.name, times, timed) for each in folders)
    try:
        time_ns, pictures, dropped = pair_shots(left, right)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    calibration = _calibration(folder / "calib.txt", first, pictures[0][0]().shape[:2])
    baseline_m = float(calibration.T_left_right[0, 3])
    T_robot_left = settings.mount.applied(level_mount(baseline_m, 0.0, HEIGHT_M))
    sequence = folder.resolve()
    beside = sequence.parent.parent / "poses" / f"{sequence.name}.txt"
    truth = next((path for path in (sequence / "poses.txt", beside) if path.exists()), None)
    odometry = folder / ODOMETRY_FILE
    return StereoRecording(
        sequence.name,
        time_ns,
        pictures,
        calibration,
        T_robot_left,
        None if truth is None else _truth(truth, times, T_robot_left),
        read_odometry(odometry) if odometry.exists() else None,
        dropped,
        calibrated_by=str(folder / "calib.txt"),
    )


def _times(path: Path) -> np.ndarray:
    lines, times = list[int](), list[int]()
    for line, words in read_rows(path, "times of a KITTI sequence"):
        require_columns(path, line, words, "time")
        lines.append(line)
        times.append(parse_time_ns(path, line, words[0], NS))
    time_ns = np.array(times, dtype=np.int64)
    require_increasing(path, lines, time_ns)
    return time_ns


def _calibration(path: Path, first: int, shape: tuple[int, int]) -> StereoCalibration:
    matrices = {
        words[0].removesuffix(":"): (line, words[1:])
        for line, words in read_rows(path, "calibration of a KITTI sequence")
    }
    found = []
    for name in (f"P{first}", f"P{first + 1}"):
        found.append(parse_matrix(path, matrices, name, (3, 4)))
    return rectified_calibration(path, found, (shape[1], shape[0]))


def parse_matrix(
    path: Path, told: dict[str, tuple[int, list[str]]], name: str, shape: tuple[int, ...]
) -> Float:
    """A matrix of a calibration file, by the name that its line begins with.

    Args:
        path: of the file, for messages.
        told: line number and words behind the name, by name.
        name: of the matrix.
        shape: of the matrix, row by row.

    Raises:
        InputError: names file and line.
    """
    n = int(np.prod(shape))
    if name not in told:
        raise InputError(f"{path}: has no line {name}: ({n} numbers)")
    line, words = told[name]
    if len(words) != n:
        found = f"{name}: has {len(words)} numbers, expected {n} ({' x '.join(map(str, shape))})"
        raise InputError(f"{path}, line {line}: {found}")
    return np.array(parse_numbers(path, line, words)).reshape(shape)


def rectified_calibration(
    path: Path, found: list[Float], size_px: tuple[int, int]
) -> StereoCalibration:
    """Two cameras of projection matrices (3, 4) that were read at `path`; raises InputError."""
    lenses = []
    try:
        for P in found:
            focal, center = (P[0, 0], P[1, 1]), (P[0, 2], P[1, 2])
            lenses.append(Lens(size_px, focal, center))
        # Rectified to camera 0; of where the others stand only what lies along the rows counts.
        ahead = np.array([-P[0, 3] / P[0, 0] for P in found])
        T_left_right = se3.pose(np.eye(3), [ahead[1] - ahead[0], 0.0, 0.0])
        return StereoCalibration(lenses[0], lenses[1], T_left_right)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _truth(path: Path, time_ns: np.ndarray, T_robot_left: Float) -> TimedPoses:
    """T_world_robot; the world is the robot's frame at the beginning."""
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


_RAW_DIGITS = 10  # of a file's name
_OXTS_NUMBERS = 30  # a line; the first six are read
_EARTH_M = 6_378_137.0  # equatorial radius, as KITTI's own conversion takes it


def read_kitti_raw(folder: Path, settings: KittiSettings, _: ReadYaml) -> StereoRecording:
    """Read a drive; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or foreign; names file and line.
    """
    first = 0 if settings.cameras == "grey" else 2
    drive = folder.resolve()
    cameras = [drive / f"image_{camera:02d}" for camera in (first, first + 1)]
    times = cameras[0] / "timestamps.txt"
    taken_ns = _stamps(times)
    left, right = (
        numbered_shots(each / "data", _RAW_DIGITS, f"{each.name}/data", taken_ns, times)
        for each in cameras
    )
    try:
        time_ns, pictures, dropped = pair_shots(left, right)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    calibration = _day_file(drive, "calib_cam_to_cam.txt")
    told = _named(calibration)
    P = [parse_matrix(calibration, told, f"P_rect_{first + k:02d}", (3, 4)) for k in (0, 1)]
    width, height = parse_matrix(calibration, told, f"S_rect_{first:02d}", (2,)).astype(int)
    size = pictures[0][0]().shape[1::-1]
    if size != (width, height):
        found = f"pictures are {size[0]}x{size[1]}, rectified ones {width}x{height}"
        raise InputError(f"{folder}: {found}; give the drive whose name ends in _sync")
    pair = rectified_calibration(calibration, P, size)
    baseline_m = float(pair.T_left_right[0, 3])
    T_robot_left = settings.mount.applied(level_mount(baseline_m, 0.0, HEIGHT_M))
    truth = None
    if (drive / "oxts").is_dir():
        R_rect = parse_matrix(calibration, told, "R_rect_00", (3, 3))
        beside = [-P[0][0, 3] / P[0][0, 0], 0.0, 0.0]  # of the left camera, from the rectified 0
        T_imu_left = se3.inverse(_rectified_from_imu(drive, R_rect)) @ se3.pose(np.eye(3), beside)
        T_imu_ahead = T_imu_left @ se3.inverse(se3.pose(R_ROBOT_OPTICAL, np.zeros(3)))
        truth = _driven(drive / "oxts").moved(T_imu_ahead @ se3.inverse(T_robot_left))
    odometry = folder / ODOMETRY_FILE
    reckoned = read_odometry(odometry) if odometry.exists() else None
    return StereoRecording(
        drive.name,
        time_ns,
        pictures,
        pair,
        T_robot_left,
        truth,
        reckoned,
        dropped,
        calibrated_by=str(calibration),
    )


def _stamps(path: Path) -> np.ndarray:
    """Times (T,) int64 in ns of the lines of `timestamps.txt`."""
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


def _day_file(drive: Path, name: str) -> Path:
    """A calibration of the day, which may also lie beside the drive's own pictures."""
    return next((p for p in (drive / name, drive.parent / name) if p.is_file()), drive / name)


def _named(path: Path) -> dict[str, tuple[int, list[str]]]:
    """Line number and words by the name that each line begins with."""
    rows = read_rows(path, "calibration of KITTI's raw data")
    return {words[0].removesuffix(":"): (line, words[1:]) for line, words in rows}


def _rectified_from_imu(drive: Path, R_rect: Float) -> Float:
    """(4, 4) that maps points of the inertial unit into the rectified camera 0."""
    T = se3.pose(R_rect, np.zeros(3))
    for name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt"):
        path = _day_file(drive, name)
        told = _named(path)
        step = se3.pose(
            parse_matrix(path, told, "R", (3, 3)),
            parse_matrix(path, told, "T", (3,)),
        )
        require_rigid(f"{path}: R and T", step)
        T = T @ step
    return T


def _driven(oxts: Path) -> TimedPoses:
    """T_world_imu: east, north, up, by Mercator's projection at the first latitude."""
    stamps = oxts / "timestamps.txt"
    time_ns, known, rows = _stamps(stamps), list[int](), list[list[float]]()
    for k, stamp_ns in enumerate(time_ns.tolist()):
        path = oxts / "data" / f"{k:0{_RAW_DIGITS}d}.txt"
        if path.is_file():  # some drives lack a few
            state = next(read_rows(path, "a state"), None)
            if state is None:
                continue
            line, words = state
            if len(words) != _OXTS_NUMBERS:
                found = f"has {len(words)} columns, expected {_OXTS_NUMBERS} (of an OXTS unit)"
                raise InputError(f"{path}, line {line}: {found}")
            known.append(stamp_ns)
            rows.append(parse_numbers(path, line, words))
    if not rows:
        raise InputError(f"{oxts}: holds no data/{'0' * _RAW_DIGITS}.txt")
    latitude, longitude, up, roll, pitch, yaw = np.array(rows)[:, :6].T
    scale = np.cos(np.radians(latitude[0])) * _EARTH_M
    east = scale * np.radians(longitude)
    north = scale * np.arcsinh(np.tan(np.radians(latitude)))
    R = se3.from_planar(np.column_stack([east, north, yaw]))[:, :3, :3] @ se3.tilt(roll, pitch)
    place = np.column_stack([east, north, up])
    return TimedPoses(np.array(known, dtype=np.int64), se3.pose(R, place - place[0]))


def write_kitti(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive into `folder/ROBOT`; returns that."""
    sequence = folder / drive.robot
    for k in range(len(drive)):
        for camera, image in enumerate(drive.pair(k)):
            write_picture(sequence / f"image_{camera}" / f"{k:06d}.png", image)
        on_frame(k + 1, len(drive))
    write_text(sequence / "calib.txt", [_projection(drive, camera) for camera in (0, 1)])
    write_text(sequence / "times.txt", [str(t) for t in drive.time_s.tolist()])
    T_robot_left = drive.mount(0)
    T_world_left = drive.true_bodies @ T_robot_left
    poses = se3.between(T_world_left[0], T_world_left)
    write_text(sequence / "poses.txt", [_numbers(T[:3]) for T in poses])
    about = f"{drive.robot}: dead reckoning by the wheels, in the frame of the first pose"
    text = tum_text(drive.time_s, drive.reckoned_bodies, about)
    write_text(sequence / ODOMETRY_FILE, text.splitlines())
    return [sequence]


def kitti_text(T_frame_robot: Float) -> str:
    """Poses (T, 3) of a robot as KITTI's trajectories have them: (3, 4) matrices, one a line.

    As there, axes are a camera's: x right, y down, z ahead, in the frame and of the body.
    """
    axes = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T = se3.inverse(axes) @ se3.from_planar(T_frame_robot) @ axes
    return "\n".join([*(_numbers(each[:3]) for each in T), ""])


def _projection(drive: StereoDrive, camera: int) -> str:
    f, (cu, cv) = drive.camera.focal_px, drive.camera.center_px
    P = np.array([[f, 0, cu, 0], [0, f, cv, 0], [0, 0, 1, 0]], dtype=np.float64)
    P[0, 3] = -camera * f * drive.camera.baseline_m
    return f"P{camera}: {_numbers(P)}"


def _numbers(matrix: Float) -> str:
    return " ".join(map(str, matrix.ravel().tolist()))
