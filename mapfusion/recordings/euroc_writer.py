"""A drive in EuRoC's layout, which is told in `euroc.py`; the body's frame is the robot's."""

from pathlib import Path

import numpy as np

from mapfusion import se3
from mapfusion.recordings.euroc import STATES
from mapfusion.recordings.stereo_drive import OnFrame, StereoDrive, write_picture, write_text
from mapfusion.recordings.tum import ODOMETRY_FILE, tum_text

_STATE_COLUMNS = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
    "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)


def write_euroc(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write a drive into `folder/ROBOT/mav0`; returns `folder/ROBOT`."""
    root, stamps = folder / drive.robot / "mav0", drive.time_ns.tolist()
    for k, stamp in enumerate(stamps):
        for camera, image in enumerate(drive.pair(k)):
            write_picture(root / f"cam{camera}" / "data" / f"{stamp}.png", image)
        on_frame(k + 1, len(drive))
    for camera in (0, 1):
        rows = [f"{stamp},{stamp}.png" for stamp in stamps]
        write_text(root / f"cam{camera}" / "data.csv", ["#timestamp [ns],filename", *rows])
        write_text(root / f"cam{camera}" / "sensor.yaml", _sensor(drive, camera))
    T = drive.true_bodies
    values = np.column_stack([T[:, :3, 3], np.roll(se3.quaternions(T), 1, axis=1)]).tolist()
    rows = [",".join(map(str, [s, *v])) for s, v in zip(stamps, values, strict=True)]
    write_text(root / STATES / "data.csv", [_STATE_COLUMNS, *rows])
    about = f"{drive.robot}: dead reckoning by the wheels, in the frame of the first pose"
    text = tum_text(drive.time_s, drive.reckoned_bodies, about)
    write_text(root / ODOMETRY_FILE, text.splitlines())
    return [folder / drive.robot]


def _sensor(drive: StereoDrive, camera: int) -> list[str]:
    pair, (cu, cv) = drive.camera, drive.camera.center_px
    return [
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
