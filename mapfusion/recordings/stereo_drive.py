"""One robot's drive with its pictures, on its way into the layouts of others."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapfusion import se2, se3
from mapfusion.arguments import require_shape
from mapfusion.camera import StereoCamera
from mapfusion.recordings.lens import R_ROBOT_OPTICAL
from mapfusion.recordings.text_tables import NS
from mapfusion.se2 import Float
from mapfusion.storage import write_whole

OnFrame = Callable[[int, int], None]  # told how many frames are written, and of how many


@dataclass(frozen=True)
class StereoDrive:
    """What one robot saw, counted and truly did.

    Attributes:
        robot: its name.
        camera: the rectified pair and how it is mounted.
        time_s: (T,) of each frame.
        T_world_robot: (T, 3) the truth.
        odometry: (T, 3) motion since the frame before; the first row is zero.
        pair: the left and right picture (H, W) uint8 of a frame.
        tilt_rad: (T, 2) true roll and pitch of the body; None: it is level.
        told_tilt_rad: (T, 2) the same as the robot measures it; None: it takes itself for level.
    """

    robot: str
    camera: StereoCamera
    time_s: Float
    T_world_robot: Float
    odometry: Float
    pair: Callable[[int], tuple[np.ndarray, np.ndarray]]
    tilt_rad: Float | None = None
    told_tilt_rad: Float | None = None

    def __post_init__(self) -> None:
        for name in ("tilt_rad", "told_tilt_rad"):
            if getattr(self, name) is not None:
                require_shape(name, getattr(self, name), (len(self.time_s), 2))
        require_shape("T_world_robot", self.T_world_robot, (len(self.time_s), 3))
        require_shape("odometry", self.odometry, (len(self.time_s), 3))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.time_s)

    @property
    def time_ns(self) -> np.ndarray:
        """(T,) int64."""
        return np.rint(self.time_s * NS).astype(np.int64)

    @property
    def dead_reckoned(self) -> Float:
        """(T, 3) poses in the frame of the first, by the odometry alone."""
        poses = np.zeros((len(self), 3))
        for k in range(1, len(self)):
            poses[k] = se2.compose(poses[k - 1], self.odometry[k])
        return poses

    @property
    def true_bodies(self) -> Float:
        """(T, 4, 4) the truth in space."""
        level, tilt_rad = se3.from_planar(self.T_world_robot), self.tilt_rad
        return level if tilt_rad is None else se3.in_space(self.T_world_robot, tilt_rad)

    @property
    def reckoned_bodies(self) -> Float:
        """`dead_reckoned`, (T, 4, 4) in space where the robot measures its roll and pitch."""
        told, reckoned = self.told_tilt_rad, self.dead_reckoned
        return reckoned if told is None else se3.in_space(reckoned, told)

    def mount(self, camera: int) -> Float:
        """T_robot_camera (4, 4) in optical axes: of the left camera (0) or the right one (1)."""
        half_m = self.camera.baseline_m / 2
        place = self.camera.p_robot_eye(-half_m if camera else half_m)
        return se3.pose(self.camera.camera_axes @ R_ROBOT_OPTICAL, place)


def write_text(path: Path, lines: list[str]) -> None:
    """Write lines of text whole."""
    text = "\n".join([*lines, ""])
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write a picture (H, W) uint8 as PNG, whole."""
    data = cv2.imencode(".png", image)[1].tobytes()
    write_whole(path, lambda temporary: temporary.write_bytes(data))
