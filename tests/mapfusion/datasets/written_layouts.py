"""Short rendered drive, written in the published layouts without the exporters."""

from pathlib import Path

import cv2
import numpy as np
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from mapfusion.camera import StereoCamera
from mapfusion.geometry import se3
from tests.mapfusion.vision.rendered_scene import render, wall

CAMERA = StereoCamera(width_px=240, height_px=180, focal_px=216.0, mount_x_m=0.0)
POSES = np.array([[0.05 * k, 0.01 * k, 0.02 * k] for k in range(5)])  # T_world_robot
TIMES_S = np.array([0.0, 0.2, 0.4, 0.6, 1.0])  # the last after a pause
START_NS = 1_403_715_273_262_142_976
# x right, y down, z ahead, as columns: x ahead, y left, z up
OPTICAL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])

Pair = tuple[np.ndarray, np.ndarray]


def read_yaml(path: Path) -> dict:
    text = path.read_text().removeprefix("%YAML:1.0")
    return YAML(typ="safe", pure=True).load(text)


def drive() -> list[Pair]:
    """Render pictures of a room whose end wall is 3 m ahead."""
    rng = np.random.default_rng(0)
    planes = [
        wall(rng, (3, 2), (3, -2), 6.0, -2.0, texels_per_m=60),
        wall(rng, (-1, 1.5), (3, 1.5), 6.0, -2.0, texels_per_m=40),
        wall(rng, (-1, -1.5), (3, -1.5), 6.0, -2.0, texels_per_m=40),
    ]
    return [render(planes, CAMERA, tuple(pose), 1.0, rng)[:2] for pose in POSES]


def matrix_of(pose: np.ndarray) -> np.ndarray:
    x, y, theta = pose
    cos, sin = np.cos(theta), np.sin(theta)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def robot_from_left() -> np.ndarray:
    """Return T_robot_left in optical axes."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = OPTICAL.T, CAMERA.p_robot_left
    return T


def tum_lines(start_ns: int, poses: np.ndarray) -> str:
    """Return a trajectory of the robot in the TUM format."""
    lines = ["# a comment"]
    for t, (x, y, theta) in zip(TIMES_S, poses.tolist(), strict=False):
        ns = start_ns + round(1e9 * t)
        sin, cos = float(np.sin(theta / 2)), float(np.cos(theta / 2))
        lines.append(f"{ns // 10**9}.{ns % 10**9:09d} {x} {y} 0 0 0 {sin} {cos}")
    return "\n".join([*lines, ""])


def write_kitti(root: Path, pairs: list[Pair]) -> Path:
    """Write `root/sequences/07` and `root/poses/07.txt`; return the sequence."""
    sequence = root / "sequences" / "07"
    for camera in (0, 1):
        (sequence / f"image_{camera}").mkdir(parents=True)
        for k, pair in enumerate(pairs):
            cv2.imwrite(str(sequence / f"image_{camera}" / f"{k:06d}.png"), pair[camera])
    f, (cu, cv) = CAMERA.focal_px, CAMERA.center_px
    rows = [f"P{k}: {f} 0 {cu} {-k * f * CAMERA.baseline_m!r} 0 {f} {cv} 0 0 0 1 0" for k in (0, 1)]
    (sequence / "calib.txt").write_text("\n".join([*rows, ""]))
    (sequence / "times.txt").write_text("".join(f"{t:e}\n" for t in TIMES_S[: len(pairs)]))
    first = np.linalg.inv(robot_from_left())
    poses = [first @ matrix_of(pose) @ robot_from_left() for pose in POSES[: len(pairs)]]
    lines = [" ".join(map(repr, T[:3].ravel().tolist())) for T in poses]
    (root / "poses").mkdir()
    (root / "poses" / "07.txt").write_text("\n".join([*lines, ""]))
    (sequence / "odometry.tum").write_text(tum_lines(0, POSES))
    return sequence


RECTIFIED, VELO_CAMERA, IMU_VELO = (
    se3.pose(Rotation.from_euler("ZYX", angles).as_matrix(), shift)
    for angles, shift in (
        ((0.01, -0.005, 0.004), (0, 0, 0)),
        ((1.5, 0.02, -1.6), (-0.004, -0.076, -0.27)),
        ((0.015, 0.002, -0.001), (-0.81, 0.32, -0.80)),
    )
)


def write_kitti_raw(root: Path, pairs: list[Pair]) -> Path:
    """Write a raw drive in the folder of its day and return its path."""
    day = root / "2011_09_26"
    drive = day / "2011_09_26_drive_0007_sync"
    start = np.datetime64("2011-09-26T13:02:25.964389445", "ns")
    stamps = [start + np.timedelta64(round(1e9 * t), "ns") for t in TIMES_S[: len(pairs)]]
    stamped = "".join(str(stamp).replace("T", " ") + "\n" for stamp in stamps)
    for camera in (0, 1):
        (drive / f"image_0{camera}" / "data").mkdir(parents=True)
        (drive / f"image_0{camera}" / "timestamps.txt").write_text(stamped)
        for k, pair in enumerate(pairs):
            path = drive / f"image_0{camera}" / "data" / f"{k:010d}.png"
            cv2.imwrite(str(path), pair[camera])
    f, (cu, cv) = CAMERA.focal_px, CAMERA.center_px
    rows = ["calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {spaced(RECTIFIED[:3, :3])}"]
    for k in (0, 1):
        rows.append(f"S_rect_0{k}: {CAMERA.width_px:e} {CAMERA.height_px:e}")
        P = [[f, 0, cu, -k * f * CAMERA.baseline_m], [0, f, cv, 0], [0, 0, 1, 0]]
        rows.append(f"P_rect_0{k}: {spaced(np.array(P))}")
    (day / "calib_cam_to_cam.txt").write_text("\n".join([*rows, ""]))
    for name, T in (("velo_to_cam", VELO_CAMERA), ("imu_to_velo", IMU_VELO)):
        text = f"calib_time: 25-May-2012\nR: {spaced(T[:3, :3])}\nT: {spaced(T[:3, 3])}\n"
        (day / f"calib_{name}.txt").write_text(text)
    write_oxts(drive / "oxts", stamped, POSES[: len(pairs)])
    (drive / "odometry.tum").write_text(tum_lines(int(start.astype(np.int64)), POSES))
    return drive


def write_oxts(oxts: Path, stamped: str, poses: np.ndarray) -> None:
    """Write states of an inertial unit 2 degrees north of the equator (0.06 % scale error)."""
    (oxts / "data").mkdir(parents=True)
    (oxts / "timestamps.txt").write_text(stamped)
    first = np.radians(2.0)
    scale = 6378137.0 * np.cos(first)
    for k, pose in enumerate(poses):
        T = matrix_of(pose) @ robot_from_left() @ RECTIFIED @ VELO_CAMERA @ IMU_VELO
        T[:3, 3] -= (robot_from_left() @ RECTIFIED @ VELO_CAMERA @ IMU_VELO)[:3, 3]
        latitude = np.arctan(np.sinh(T[1, 3] / scale + np.arcsinh(np.tan(first))))
        yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
        state = [*np.degrees([latitude, T[0, 3] / scale]), 100 + T[2, 3], roll, pitch, yaw]
        text = spaced(np.array([*state, *np.zeros(24)]))
        (oxts / "data" / f"{k:010d}.txt").write_text(text + "\n")


def spaced(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))


def write_euroc(root: Path, pairs: list[Pair]) -> Path:
    """Write `root/mav0` for a body with x up, y left and z back, as on MAVs."""
    T_body_robot = np.eye(4)
    T_body_robot[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]])
    stamps = [START_NS + round(1e9 * t) for t in TIMES_S[: len(pairs)]]
    for camera in (0, 1):
        folder = root / "mav0" / f"cam{camera}"
        (folder / "data").mkdir(parents=True)
        for stamp, pair in zip(stamps, pairs, strict=True):
            cv2.imwrite(str(folder / "data" / f"{stamp}.png"), pair[camera])
        lines = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)]
        (folder / "data.csv").write_text("\n".join([*lines, ""]))
        T = T_body_robot @ robot_from_left()
        T[:3, 3] += T[:3, 0] * CAMERA.baseline_m * camera
        (folder / "sensor.yaml").write_text(sensor_yaml(T))
    states = root / "mav0" / "state_groundtruth_estimate0"
    states.mkdir()
    lines = ["#timestamp,p_RS_R_x [m],..."]
    for stamp, pose in zip(stamps, POSES, strict=False):
        T = matrix_of(pose) @ np.linalg.inv(T_body_robot)
        w = np.sqrt(1 + np.trace(T[:3, :3])) / 2
        xyz = np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]]) / (4 * w)
        values = [*T[:3, 3], w, *xyz, *np.zeros(9)]
        lines.append(",".join([str(stamp), *(repr(float(v)) for v in values)]))
    (states / "data.csv").write_text("\n".join([*lines, ""]))
    (root / "mav0" / "odometry.tum").write_text(tum_lines(START_NS, POSES))
    return root


def sensor_yaml(T_body_camera: np.ndarray) -> str:
    f, (cu, cv) = CAMERA.focal_px, CAMERA.center_px
    return f"""%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: {T_body_camera.ravel().tolist()}
rate_hz: 5
resolution: [{CAMERA.width_px}, {CAMERA.height_px}]
camera_model: pinhole
intrinsics: [{f}, {f}, {cu}, {cv}] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [0, 0, 0, 0]
"""


def write_images(root: Path, pairs: list[Pair]) -> Path:
    """Two folders of pictures that are named by nanoseconds, and Kalibr's calibration."""
    for name, camera in (("left", 0), ("right", 1)):
        (root / name).mkdir(parents=True)
        for t, pair in zip(TIMES_S, pairs, strict=False):
            cv2.imwrite(str(root / name / f"{START_NS + round(1e9 * t)}.png"), pair[camera])
    write_calibration(root / "calibration.yaml")
    for name in ("odometry.tum", "truth.tum"):
        (root / name).write_text(tum_lines(START_NS, POSES))
    return root


def write_calibration(path: Path, **changed: object) -> None:
    """Kalibr's `camchain.yaml` of the pair, with values of either camera replaced."""
    f, center = CAMERA.focal_px, list(CAMERA.center_px)
    own = {
        "camera_model": "pinhole",
        "intrinsics": [f, f, *center],
        "distortion_model": "none",
        "distortion_coeffs": [],
        "resolution": [CAMERA.width_px, CAMERA.height_px],
    }
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -CAMERA.baseline_m
    chain = {
        "cam0": {**own, **changed},
        "cam1": {**own, "T_cn_cnm1": T_right_left.tolist(), **changed},
    }
    with path.open("w") as file:
        YAML(typ="safe", pure=True).dump(chain, file)


WRITERS = {
    "kitti": write_kitti,
    "kitti_raw": write_kitti_raw,
    "euroc": write_euroc,
    "images": write_images,
}
