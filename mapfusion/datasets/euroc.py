"""EuRoC MAV (ASL) layout of stereo recordings: importer and exporter.

Burri et al. (2016), "The EuRoC micro aerial vehicle datasets". A recording is a
folder `mav0`, or the folder above it:

- `cam0` (left), `cam1` (right): `data.csv` (timestamp in ns, file name), the pictures in `data/`,
  and `sensor.yaml` with resolution, intrinsics, distortion and T_BS, which maps points of the
  camera into the body frame.
- `state_groundtruth_estimate0/data.csv`: time in ns, position and quaternion (real part first) of
  the body; further columns are ignored; optional.
- `imu0`: `data.csv` (time in ns, angular velocity in rad/s, acceleration in m/s²) and
  `sensor.yaml` with T_BS; optional.
- `odometry.tum`: dead reckoning of the robot; an extension of this package, optional.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapfusion.datasets.camera_calibration import StereoCalibration, parse_lens, parse_transform
from mapfusion.datasets.imu import ImuData
from mapfusion.datasets.levelling import MountSettings, robot_in_body
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
    POSES,
    TimedPoses,
    parse_time_ns,
    read_odometry_beside,
    read_rows,
    read_time_series,
    require_columns,
    require_increasing,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se3

STATES = "state_groundtruth_estimate0"
_IMU_COLUMNS = "time wx wy wz ax ay az"
_STATE_COLUMNS = "time x y z qw qx qy qz"  # speeds and biases follow
_WRITTEN_STATE_COLUMNS = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
    "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
_MIN_PICTURES = 2  # of a camera, for two pairs


@dataclass(frozen=True)
class EurocSettings:
    """Settings of the EuRoC importer.

    Attributes:
        mount: replaces the mount of T_BS.
    """

    mount: MountSettings = field(default_factory=MountSettings)


def read_euroc(folder: Path, settings: EurocSettings, read_yaml: ReadYaml) -> StereoRecording:
    """Read a recording; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or of another format; the message names file and
            field or line.
    """
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    cameras = [root / "cam0", root / "cam1"]
    if not all((camera / "data.csv").is_file() for camera in cameras):
        raise InputError(f"{folder}: no cam0/data.csv and cam1/data.csv (a EuRoC recording's mav0)")
    sensors = [camera / "sensor.yaml" for camera in cameras]
    lenses, mounts = [], []
    for sensor in sensors:
        document = read_yaml(sensor)
        lenses.append(parse_lens(str(sensor), document))
        mounts.append(parse_transform(str(sensor), "T_BS", document))
    calibrated_by = f"{root}: sensor.yaml of cam0 and cam1"
    try:
        T_left_right = se3.between(mounts[0], mounts[1])
        calibration = StereoCalibration(lenses[0], lenses[1], T_left_right)
    except InputError as error:
        raise InputError(f"{calibrated_by}: {error}") from error
    (left, lost_left), (right, lost_right) = (_read_pictures(camera) for camera in cameras)
    time_ns, pictures, dropped = pair_shots(root, left, right)

    T_body_robot, T_robot_left = robot_in_body(mounts[0])
    imu, states = root / "imu0", root / STATES / "data.csv"
    inertial, truth = None, None
    if (imu / "data.csv").exists():
        sensor, path = imu / "sensor.yaml", imu / "data.csv"
        T_body_imu = parse_transform(str(sensor), "T_BS", read_yaml(sensor))
        imu_ns, values = read_time_series(path, "accelerations", _IMU_COLUMNS, 1, ",")
        R_imu_robot = se3.between(T_body_robot, T_body_imu)[:3, :3].T
        try:
            inertial = ImuData(imu_ns, values[:, 3:] @ R_imu_robot, values[:, :3] @ R_imu_robot)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    if states.exists():
        truth_ns, values = read_time_series(
            states, "true states", _STATE_COLUMNS, 1, ",", POSES, more=True
        )
        if not np.all(np.linalg.norm(values[:, 3:], axis=1) > 0):
            raise InputError(f"{states}: holds a quaternion of length 0")
        T_world_body = se3.from_quaternions(values[:, :3], values[:, [4, 5, 6, 3]])
        truth = TimedPoses(truth_ns, T_world_body).moved(T_body_robot)
    return StereoRecording(
        (root.resolve().parent if root.name == "mav0" else root.resolve()).name,
        time_ns,
        pictures,
        calibration,
        settings.mount.applied(T_robot_left),
        truth,
        read_odometry_beside(root),
        (*lost_left, *lost_right, *dropped),
        inertial,
        calibrated_by,
    )


def _read_pictures(camera: Path) -> tuple[list[Shot], list[str]]:
    """Return the pictures of one camera and a line for each missing picture."""
    path, shots, lines, missing = camera / "data.csv", list[Shot](), list[int](), list[str]()
    for line, words in read_rows(path, "times and names of pictures", ","):
        require_columns(path, line, words, "time file")
        time_ns, picture = parse_time_ns(path, line, words[0], 1), camera / "data" / words[1]
        name = f"{camera.name}/data/{words[1]}"
        if picture.is_file():
            shots.append(Shot(time_ns, name, PictureFile(picture)))
            lines.append(line)
        else:
            missing.append(f"{name} (no such file)")
    if missing and len(shots) < _MIN_PICTURES:
        missing_text = (
            f"{missing[0]}; {len(missing)} of the {len(missing) + len(shots)} listed are missing"
        )
        present = next(
            (each.name for each in sorted((camera / "data").glob("*")) if each.is_file()), "none"
        )
        folder = f"names are relative to {camera.name}/data, whose first file is {present}"
        raise InputError(f"{path}: {missing_text}; {folder}")
    require_increasing(path, lines, np.array([shot.time_ns for shot in shots], dtype=np.int64))
    return shots, missing


def write_euroc(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive into `folder/ROBOT/mav0` and return the path `folder/ROBOT`."""
    root, stamps = folder / drive.robot / "mav0", drive.time_ns.tolist()
    for k, stamp in enumerate(stamps):
        for camera, image in enumerate(drive.pair(k)):
            write_picture(root / f"cam{camera}" / "data" / f"{stamp}.png", image)
        on_frame(k + 1, len(drive))
    pair, (cu, cv) = drive.camera, drive.camera.center_px
    for camera in (0, 1):
        rows = [f"{stamp},{stamp}.png" for stamp in stamps]
        write_text(root / f"cam{camera}" / "data.csv", ["#timestamp [ns],filename", *rows])
        sensor = [
            "sensor_type: camera",
            f"comment: camera {camera} of {drive.robot}, rectified",
            "T_BS:",
            "  cols: 4",
            "  rows: 4",
            f"  data: {drive.mount(camera).ravel().tolist()}",
            f"resolution: [{pair.width_px}, {pair.height_px}]",
            "camera_model: pinhole",
            f"intrinsics: [{pair.focal_px}, {pair.focal_px}, {cu}, {cv}] # fu, fv, cu, cv",
            "distortion_model: radial-tangential",
            "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]",
        ]
        write_text(root / f"cam{camera}" / "sensor.yaml", sensor)
    T = drive.true_bodies
    values = np.column_stack([T[:, :3, 3], np.roll(se3.quaternions(T), 1, axis=1)]).tolist()
    rows = [",".join(map(str, [s, *v])) for s, v in zip(stamps, values, strict=True)]
    write_text(root / STATES / "data.csv", [_WRITTEN_STATE_COLUMNS, *rows])
    write_dead_reckoning(root, drive)
    return [folder / drive.robot]
