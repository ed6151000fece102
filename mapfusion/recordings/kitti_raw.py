"""Stereo recordings in the layout of KITTI's raw data, rectified and synchronised.

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
"""

from pathlib import Path

import numpy as np

from mapfusion import se3
from mapfusion.errors import InputError
from mapfusion.recordings.kitti import HEIGHT_M, KittiSettings, named_matrix, rectified_pair
from mapfusion.recordings.lens import R_ROBOT_OPTICAL, require_rigid
from mapfusion.recordings.mount import level_mount
from mapfusion.recordings.numbered import numbered_shots
from mapfusion.recordings.stereo_recording import ReadYaml, StereoRecording, paired
from mapfusion.recordings.text_tables import numbers, require_increasing, rows_of
from mapfusion.recordings.timed_poses import TimedPoses
from mapfusion.recordings.tum import ODOMETRY_FILE, read_odometry
from mapfusion.se2 import Float

_DIGITS = 10  # of a file's name
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
        numbered_shots(each / "data", _DIGITS, f"{each.name}/data", taken_ns, times)
        for each in cameras
    )
    try:
        time_ns, pictures, dropped = paired(left, right)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    calibration = _day_file(drive, "calib_cam_to_cam.txt")
    told = _named(calibration)
    P = [named_matrix(calibration, told, f"P_rect_{first + k:02d}", (3, 4)) for k in (0, 1)]
    width, height = named_matrix(calibration, told, f"S_rect_{first:02d}", (2,)).astype(int)
    size = pictures[0][0]().shape[1::-1]
    if size != (width, height):
        found = f"pictures are {size[0]}x{size[1]}, rectified ones {width}x{height}"
        raise InputError(f"{folder}: {found}; give the drive whose name ends in _sync")
    pair = rectified_pair(calibration, P, size)
    baseline_m = float(pair.T_left_right[0, 3])
    T_robot_left = settings.mount.applied(level_mount(baseline_m, 0.0, HEIGHT_M))
    truth = None
    if (drive / "oxts").is_dir():
        R_rect = named_matrix(calibration, told, "R_rect_00", (3, 3))
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
    for line, words in rows_of(path, "times of a raw drive of KITTI"):
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
    rows = rows_of(path, "calibration of KITTI's raw data")
    return {words[0].removesuffix(":"): (line, words[1:]) for line, words in rows}


def _rectified_from_imu(drive: Path, R_rect: Float) -> Float:
    """(4, 4) that maps points of the inertial unit into the rectified camera 0."""
    T = se3.pose(R_rect, np.zeros(3))
    for name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt"):
        path = _day_file(drive, name)
        told = _named(path)
        step = se3.pose(named_matrix(path, told, "R", (3, 3)), named_matrix(path, told, "T", (3,)))
        require_rigid(f"{path}: R and T", step)
        T = T @ step
    return T


def _driven(oxts: Path) -> TimedPoses:
    """T_world_imu: east, north, up, by Mercator's projection at the first latitude."""
    stamps = oxts / "timestamps.txt"
    time_ns, known, rows = _stamps(stamps), list[int](), list[list[float]]()
    for k, stamp_ns in enumerate(time_ns.tolist()):
        path = oxts / "data" / f"{k:0{_DIGITS}d}.txt"
        if path.is_file():  # some drives lack a few
            state = next(rows_of(path, "a state"), None)
            if state is None:
                continue
            line, words = state
            if len(words) != _OXTS_NUMBERS:
                found = f"has {len(words)} columns, expected {_OXTS_NUMBERS} (of an OXTS unit)"
                raise InputError(f"{path}, line {line}: {found}")
            known.append(stamp_ns)
            rows.append(numbers(path, line, words))
    if not rows:
        raise InputError(f"{oxts}: holds no data/{'0' * _DIGITS}.txt")
    latitude, longitude, up, roll, pitch, yaw = np.array(rows)[:, :6].T
    scale = np.cos(np.radians(latitude[0])) * _EARTH_M
    east = scale * np.radians(longitude)
    north = scale * np.arcsinh(np.tan(np.radians(latitude)))
    R = se3.from_planar(np.column_stack([east, north, yaw]))[:, :3, :3] @ se3.tilt(roll, pitch)
    place = np.column_stack([east, north, up])
    return TimedPoses(np.array(known, dtype=np.int64), se3.pose(R, place - place[0]))
