"""Stereo recordings in the layout of EuRoC MAV (ASL), as read and as written.

Burri et al. (2016), "The EuRoC micro aerial vehicle datasets". A folder `mav0`, or the one above:

- `cam0` (left), `cam1` (right): `data.csv` (timestamp in ns, file name), the pictures in `data/`,
  and `sensor.yaml` with resolution, intrinsics, distortion and T_BS, which maps points of the
  camera into the body's frame.
- `state_groundtruth_estimate0/data.csv`: time in ns, position, quaternion (real part first) of the
  body and more that is not read; optional.
- `imu0`: `data.csv` (time in ns, angular velocity in rad/s, acceleration in m/s²) and
  `sensor.yaml` with T_BS; optional.
- `odometry.tum`: dead reckoning of the robot's axes, which EuRoC has not; ours, optional.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion import se3
from mapfusion.errors import InputError
from mapfusion.recordings.calibration_text import lens_of, motion_of
from mapfusion.recordings.inertial import Inertial
from mapfusion.recordings.lens import StereoCalibration
from mapfusion.recordings.mount import MountSettings, robot_in_body
from mapfusion.recordings.pictures import PictureFile
from mapfusion.recordings.stereo_recording import ReadYaml, Shot, StereoRecording, paired
from mapfusion.recordings.text_tables import (
    POSES,
    require_columns,
    require_increasing,
    rows_of,
    time_in_ns,
    timed_numbers,
)
from mapfusion.recordings.timed_poses import TimedPoses
from mapfusion.recordings.tum import ODOMETRY_FILE, read_odometry
from mapfusion.se2 import Float

STATES = "state_groundtruth_estimate0"
_FELT_COLUMNS = "time wx wy wz ax ay az"
_STATE_COLUMNS = "time x y z qw qx qy qz"  # speeds and biases follow
_LEAST_PICTURES = 2  # of a camera, to make two pairs of


@dataclass(frozen=True)
class EurocSettings:
    """How EuRoC recordings are read.

    Attributes:
        mount: what replaces the mount that T_BS tells.
    """

    mount: MountSettings = field(default_factory=MountSettings)


def read_euroc(folder: Path, settings: EurocSettings, read_yaml: ReadYaml) -> StereoRecording:
    """Read a recording; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or foreign; names file and field or line.
    """
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    cameras = [root / "cam0", root / "cam1"]
    if not all((camera / "data.csv").is_file() for camera in cameras):
        raise InputError(f"{folder}: no cam0/data.csv and cam1/data.csv (a EuRoC recording's mav0)")
    lenses, mounts = zip(
        *(_camera(camera / "sensor.yaml", read_yaml) for camera in cameras), strict=True
    )
    T_left_right = se3.between(mounts[0], mounts[1])
    try:
        calibration = StereoCalibration(lenses[0], lenses[1], T_left_right)
    except InputError as error:
        raise InputError(f"{root}: sensor.yaml of cam0 and cam1: {error}") from error
    (left, lost_left), (right, lost_right) = (_shots(camera) for camera in cameras)
    try:
        time_ns, pictures, dropped = paired(left, right)
    except InputError as error:
        raise InputError(f"{root}: {error}") from error
    T_body_robot, T_robot_left = robot_in_body(mounts[0])
    odometry = root / ODOMETRY_FILE
    states, imu = root / STATES / "data.csv", root / "imu0"
    felt = _felt(imu, T_body_robot, read_yaml) if (imu / "data.csv").exists() else None
    return StereoRecording(
        (root.resolve().parent if root.name == "mav0" else root.resolve()).name,
        time_ns,
        pictures,
        calibration,
        settings.mount.applied(T_robot_left),
        _states(states).moved(T_body_robot) if states.exists() else None,
        read_odometry(odometry) if odometry.exists() else None,
        (*lost_left, *lost_right, *dropped),
        felt,
        f"{root}: sensor.yaml of cam0 and cam1",
    )


def _camera(path: Path, read_yaml: ReadYaml) -> tuple[Any, Float]:
    """The lens, and T_BS (4, 4)."""
    found: Mapping[str, Any] = read_yaml(path)
    return lens_of(str(path), found), motion_of(str(path), "T_BS", found)


def _shots(camera: Path) -> tuple[list[Shot], list[str]]:
    """The pictures of one camera that are there, and what is said of those that are not."""
    path, shots, lines, missing = camera / "data.csv", list[Shot](), list[int](), list[str]()
    for line, words in rows_of(path, "times and names of pictures", ","):
        require_columns(path, line, words, "time file")
        time_ns, picture = time_in_ns(path, line, words[0], 1), camera / "data" / words[1]
        name = f"{camera.name}/data/{words[1]}"
        if picture.is_file():
            shots.append(Shot(time_ns, name, PictureFile(picture)))
            lines.append(line)
        else:
            missing.append(f"{name} (no such file)")
    if missing and len(shots) < _LEAST_PICTURES:
        lost = f"{missing[0]}; {len(missing)} of the {len(missing) + len(shots)} listed are missing"
        held = next(
            (each.name for each in sorted((camera / "data").glob("*")) if each.is_file()), "none"
        )
        folder = f"names are relative to {camera.name}/data, whose first file is {held}"
        raise InputError(f"{path}: {lost}; {folder}")
    require_increasing(path, lines, np.array([shot.time_ns for shot in shots], dtype=np.int64))
    return shots, missing


def _felt(imu: Path, T_body_robot: Float, read_yaml: ReadYaml) -> Inertial:
    """Accelerations and angular velocities in the robot's axes."""
    sensor, path = imu / "sensor.yaml", imu / "data.csv"
    T_body_imu = motion_of(str(sensor), "T_BS", read_yaml(sensor))
    time_ns, own = timed_numbers(path, "accelerations", _FELT_COLUMNS, 1, ",")
    turn = se3.between(T_body_robot, T_body_imu)[:3, :3].T
    try:
        return Inertial(time_ns, own[:, 3:] @ turn, own[:, :3] @ turn)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _states(path: Path) -> TimedPoses:
    """T_world_body of the true states."""
    time_ns, values = timed_numbers(path, "true states", _STATE_COLUMNS, 1, ",", POSES, more=True)
    if not np.all(np.linalg.norm(values[:, 3:], axis=1) > 0):
        raise InputError(f"{path}: holds a quaternion of length 0")
    return TimedPoses(time_ns, se3.from_quaternions(values[:, :3], values[:, [4, 5, 6, 3]]))
