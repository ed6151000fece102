"""Exports: stereo drives for dataset writers, g2o pose graphs, PLY point clouds.

Kuemmerle, Grisetti, Strasdat, Konolige, Burgard (2011), "g2o: A general framework for graph
optimization". The error of an EDGE_SE2 with measurement Z is Z^-1 (X_i^-1 X_j), whose position is
in the frame at the end of Z. Covariances of this package are in the frame at the start and are
therefore rotated.
"""

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
from mapfusion.geometry.se2 import rotation
from mapfusion.landmark_map import LandmarkMap

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
    """

    robot: str
    camera: StereoCamera
    time_s: Float
    T_world_robot: Float
    odometry: Float
    pair: Callable[[int], tuple[np.ndarray, np.ndarray]]
    tilt_rad: Float | None = None
    measured_tilt_rad: Float | None = None

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
    """Write a picture (H, W) uint8 as PNG atomically."""
    data = cv2.imencode(".png", image)[1].tobytes()
    write_whole(path, lambda temporary: temporary.write_bytes(data))


_UPPER_3, _UPPER_2 = np.triu_indices(3), np.triu_indices(2)


class G2oGraph:
    """Pose graph in the g2o format; vertices are numbered from 0 as they are added."""

    def __init__(self) -> None:
        self._vertices: list[str] = []
        self._edges: list[str] = []
        self._n = 0

    def add_comment(self, text: str) -> None:
        """Add a comment line before the following vertices."""
        self._vertices.append(f"# {text}")

    def add_poses(self, T: Float) -> np.ndarray:
        """Add poses (n, 3) in the frame of the graph and return their numbers (n,)."""
        require_shape("T", T, (len(T), 3))
        return self._add("VERTEX_SE2", T)

    def add_points(self, p: Float) -> np.ndarray:
        """Add landmarks (n, 2) in the frame of the graph and return their numbers (n,)."""
        require_shape("p", p, (len(p), 2))
        return self._add("VERTEX_XY", p)

    def _add(self, kind: str, values: Float) -> np.ndarray:
        numbers = np.arange(self._n, self._n + len(values))
        self._n += len(values)
        rows = zip(numbers.tolist(), values.tolist(), strict=True)
        self._vertices += [f"{kind} {number} {_text(row)}" for number, row in rows]
        return numbers

    def add_motion(self, i: int, j: int, T_i_j: Float, covariance: Float) -> None:
        """Add a measured motion (3,) from pose i to j with its covariance (3, 3) in frame i."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(T_i_j[2]).T
        information = turn @ np.linalg.inv(covariance) @ turn.T
        numbers = [*T_i_j.tolist(), *information[_UPPER_3].tolist()]
        self._edges.append(f"EDGE_SE2 {i} {j} {_text(numbers)}")

    def add_sighting(self, i: int, point: int, p_i: Float, covariance: Float) -> None:
        """Add a landmark (2,) observed from pose i with its covariance (2, 2) in frame i."""
        information = np.linalg.inv(covariance)
        numbers = [*p_i.tolist(), *information[_UPPER_2].tolist()]
        self._edges.append(f"EDGE_SE2_XY {i} {point} {_text(numbers)}")

    def text(self) -> str:
        """Return the text of the file; reading it restores every number exactly."""
        return "\n".join([*self._vertices, *self._edges, ""])


def _text(numbers: list[float]) -> str:
    """Return numbers separated by spaces."""
    return " ".join(map(str, numbers))


_PROPERTIES = (
    *(f"double {name}" for name in ("x", "y", "z")),
    *(f"uchar {name}" for name in ("red", "green", "blue")),
    *(f"double sigma_{axis}" for axis in "xyz"),
    "int count",
)


def ply_text(landmarks: LandmarkMap, rgb: np.ndarray) -> str:
    """Return a map as a PLY point cloud with a colour (N, 3), 0 to 255, for each landmark.

    Properties are x, y, z in metres in the frame of the map; red, green, blue; sigma_x, sigma_y,
    sigma_z, the standard deviations in metres along the axes (0 for the height of planar maps);
    count, the number of observations of the landmark. Reading the text restores every number
    exactly.
    """
    n = len(landmarks)
    require_shape("rgb", rgb, (n, 3))
    sigma_m = np.sqrt(np.diagonal(landmarks.covariance_m2, axis1=1, axis2=2))
    parts = (landmarks.position_m, rgb.astype(int), sigma_m, landmarks.count[:, None].astype(int))
    columns = [column for part in parts for column in part.T.tolist()]
    header = ["ply", "format ascii 1.0", f"comment map of {landmarks.name}, metres"]
    header += [f"element vertex {n}", *(f"property {each}" for each in _PROPERTIES), "end_header"]
    lines = (" ".join(map(str, row)) for row in zip(*columns, strict=True))
    return "\n".join([*header, *lines, ""])
