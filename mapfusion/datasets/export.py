"""Stereo drives for the writers of datasets."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL
from mapfusion.datasets.text_files import NS, ODOMETRY_FILE, tum_text
from mapfusion.files import write_whole
from mapfusion.geometry import se2, se3
from mapfusion.geometry.numerics import Float, require_shape

OnFrame = Callable[[int, int], None]  # called with the numbers of written and of all frames


@dataclass(frozen=True)
class StereoDrive:
    """Pictures, odometry and true path of one robot.

    Attributes:
        robot: name of the robot.
        camera: the rectified pair and its mount.
        time_s: times of the frames, shape (T,).
        T_world_robot: true poses, shape (T, 3).
        odometry: motions since the frame before, shape (T, 3); the first row is zero.
        pair: function that returns the left and right picture (H, W) uint8 of a frame.
        tilt_rad: true roll and pitch of the body, shape (T, 2); None for a level body.
        measured_tilt_rad: measured roll and pitch, shape (T, 2); None if the robot assumes that it
            is level.
        depth_m: function that returns the depths (H, W) of a frame's left picture, NaN where
            unknown; None without a depth sensor.
    """

    robot: str
    camera: StereoCamera
    time_s: Float
    T_world_robot: Float
    odometry: Float
    pair: Callable[[int], tuple[np.ndarray, np.ndarray]]
    tilt_rad: Float | None = None
    measured_tilt_rad: Float | None = None
    depth_m: Callable[[int], np.ndarray] | None = None

    def __post_init__(self) -> None:
        for name in ("tilt_rad", "measured_tilt_rad"):
            if getattr(self, name) is not None:
                require_shape(name, getattr(self, name), (len(self.time_s), 2))
        require_shape("T_world_robot", self.T_world_robot, (len(self.time_s), 3))
        require_shape("odometry", self.odometry, (len(self.time_s), 3))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    @property
    def time_ns(self) -> np.ndarray:
        """Times of the frames in ns, shape (T,), int64."""
        return np.rint(self.time_s * NS).astype(np.int64)

    @property
    def dead_reckoned(self) -> Float:
        """Dead-reckoned poses in the first frame, shape (T, 3)."""
        poses = np.zeros((len(self), 3))
        for k in range(1, len(self)):
            poses[k] = se2.compose(poses[k - 1], self.odometry[k])
        return poses

    @property
    def true_bodies(self) -> Float:
        """True poses in space, shape (T, 4, 4)."""
        level, tilt_rad = se3.from_planar(self.T_world_robot), self.tilt_rad
        return level if tilt_rad is None else se3.in_space(self.T_world_robot, tilt_rad)

    @property
    def reckoned_bodies(self) -> Float:
        """Dead-reckoned poses (T, 3); in space, (T, 4, 4), if roll and pitch are measured."""
        tilt_rad, reckoned = self.measured_tilt_rad, self.dead_reckoned
        return reckoned if tilt_rad is None else se3.in_space(reckoned, tilt_rad)

    def mount(self, camera: int) -> Float:
        """Return T_robot_camera (4, 4) in optical axes of the left (0) or the right camera (1)."""
        half_m = self.camera.baseline_m / 2
        place = self.camera.p_robot_eye(-half_m if camera else half_m)
        return se3.pose(self.camera.camera_axes @ R_ROBOT_OPTICAL, place)


def write_dead_reckoning(folder: Path, drive: StereoDrive) -> None:
    """Write the dead-reckoned trajectory of a drive to `odometry.tum` in a folder."""
    about = f"{drive.robot}: dead reckoning by the wheels, in the frame of the first pose"
    text = tum_text(drive.time_s, drive.reckoned_bodies, about)
    write_text(folder / ODOMETRY_FILE, text.splitlines())


def write_text(path: Path, lines: list[str]) -> None:
    """Write lines of text atomically."""
    text = "\n".join([*lines, ""])
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write a picture (H, W) uint8 or uint16 as PNG atomically."""
    data = cv2.imencode(".png", image)[1].tobytes()
    write_whole(path, lambda temporary: temporary.write_bytes(data))
