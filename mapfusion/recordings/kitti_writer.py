"""A drive as a sequence of KITTI's odometry benchmark; the layout is told in `kitti.py`.

Written are the grey cameras 0 and 1, `odometry.tum` and `poses.txt` in the sequence's folder.
"""

from pathlib import Path

import numpy as np

from mapfusion import se3
from mapfusion.recordings.lens import R_ROBOT_OPTICAL
from mapfusion.recordings.stereo_drive import OnFrame, StereoDrive, write_picture, write_text
from mapfusion.recordings.tum import ODOMETRY_FILE, tum_text
from mapfusion.se2 import Float


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
