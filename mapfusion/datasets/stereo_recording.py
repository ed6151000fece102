"""Stereo recordings in memory, as read and as written: image pairs over time, and other data."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mapfusion.camera import StereoCamera
from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL, StereoCalibration
from mapfusion.datasets.imu import ImuData
from mapfusion.datasets.text_files import NS, ODOMETRY_FILE, TimedPoses, tum_text
from mapfusion.errors import InputError, TellingWarning
from mapfusion.files import write_atomically
from mapfusion.geometry import se2, se3
from mapfusion.geometry.numerics import Float, require_shape
from mapfusion.vision.depth import DepthParameters

_BITS = 8
_SILENT = 0  # log level of OpenCV
# Pictures without a partner at opposite ends of two cameras from which on clocks may differ. A
# camera may start one picture late.
_SHIFTED_PICTURES = 2
_SAMPLES = 8  # pictures that determine how many of 16 bits a camera uses

Load = Callable[[], np.ndarray]
OnFrame = Callable[[int, int], None]  # called with the numbers of written and of all frames


@dataclass(frozen=True)
class PictureFile:
    """Picture on disk, which is read without conversion when it is called."""

    path: Path

    def __call__(self) -> np.ndarray:
        """Return the picture, shape (H, W) or (H, W, 3), uint8 or uint16; raise InputError."""
        try:
            data = np.frombuffer(self.path.read_bytes(), np.uint8)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{self.path}: cannot be read ({reason})") from error
        image = None
        if len(data):  # OpenCV would report damaged pictures on the terminal
            level = cv2.utils.logging.setLogLevel(_SILENT)
            try:
                image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            finally:
                cv2.utils.logging.setLogLevel(level)
        if image is None:
            raise InputError(f"{self.path}: damaged or no picture")
        if image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.path}: holds {image.dtype}, expected 8 or 16 bits a channel")
        return image


def grey(image: np.ndarray) -> np.ndarray:
    """Return grey levels (H, W) of a picture in grey or in OpenCV's colour order (BGR, BGRA)."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return image[:, :, 0]
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)


def sample_indices(n: int) -> list[int]:
    """Return evenly spaced indices of n pictures, including the first and the last."""
    return sorted(set(np.linspace(0, n - 1, min(n, _SAMPLES)).astype(int).tolist()))


def to_eight_bits(image: np.ndarray, shift: int) -> np.ndarray:
    """Return grey levels (H, W) uint8; 16-bit levels are shifted right and clipped to 255."""
    levels = grey(image)
    if levels.dtype == np.uint8:
        return levels
    return np.minimum(levels >> shift, 255).astype(np.uint8)


# Reads the mapping of a YAML file and raises InputError. The library itself reads no YAML.
ReadYaml = Callable[[Path], Mapping[str, Any]]
# Largest time difference within a pair: at 1 rad/s and 500 px focal length, 2 ms are a pixel.
MAX_OFFSET_NS = 2_000_000
# Limits of the median time between two pictures of one camera. Times outside are in a wrong unit:
# no camera takes a thousand pictures a second, and milliseconds read as seconds are at least 30 s
# apart.
_MIN_STEP_NS, _MAX_STEP_NS = 1_000_000, 10_000_000_000


@dataclass(frozen=True)
class Shot:
    """One picture of one camera: its time, its name in messages, and a function that loads it."""

    time_ns: int
    name: str
    load: Load


@dataclass(frozen=True)
class StereoRecording:
    """Stereo recording as read by an importer.

    Attributes:
        name: name of the recording.
        time_ns: increasing times of the pairs, shape (T,), int64.
        pictures: T pairs of functions that load the pictures.
        calibration: calibration of the raw pictures.
        T_robot_left: recorded mount of the left camera, shape (4, 4); axes x ahead, y left, z up.
        truth: T_world_robot, or None.
        odometry: dead-reckoned T_start_robot, or None.
        dropped: one line for each picture without a partner.
        inertial: IMU measurements, or None.
        calibrated_by: source of the calibration, for messages.
        depth: noise and tests of depth images; None for stereo pairs. Depth images are loaded in
            the place of right pictures, as metres, shape (H, W) float32. They are registered to the
            left pictures, and the calibration is that of a virtual pair.
    """

    name: str
    time_ns: np.ndarray
    pictures: Sequence[tuple[Load, Load]]
    calibration: StereoCalibration
    T_robot_left: Float
    truth: TimedPoses | None = None
    odometry: TimedPoses | None = None
    dropped: tuple[str, ...] = ()
    inertial: ImuData | None = None
    calibrated_by: str = ""
    depth: DepthParameters | None = None
    _shift: list[int] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.pictures)

    def pair(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the raw pictures (H, W) uint8 of pair k; an InputError names the file.

        A depth image in the place of the right picture is float32.
        """
        of_light = slice(None) if self.depth is None else slice(1)
        if not self._shift:  # one shift for all pictures keeps brightness comparable
            loads = [load for n in sample_indices(len(self)) for load in self.pictures[n][of_light]]
            # the right shift after which the brightest 16-bit level fits into 8 bits
            brightest = max((int(grey(load()).max()) for load in loads), default=0)
            self._shift.append(max(brightest.bit_length() - _BITS, 0))
        pictures = [to_eight_bits(load(), self._shift[0]) for load in self.pictures[k][of_light]]
        left, right = pictures if self.depth is None else (*pictures, self.pictures[k][1]())
        return left, right

    def __iter__(self) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """Yield seconds since the first pair and the raw pictures of each pair."""
        for k in range(len(self)):
            yield (int(self.time_ns[k]) - int(self.time_ns[0])) / 1e9, *self.pair(k)


def pair_shots(
    source: Path,
    left: Sequence[Shot],
    right: Sequence[Shot],
    max_offset_ns: int = MAX_OFFSET_NS,
    cameras: tuple[str, str] = ("the left camera", "the right one"),
) -> tuple[np.ndarray, list[tuple[Load, Load]], tuple[str, ...]]:
    """Pair the pictures of two cameras that were taken at the same time.

    Args:
        source: path of the recording, for messages.
        left: pictures of the left camera in the order of time.
        right: pictures of the right camera in the order of time.
        max_offset_ns: largest time difference of a pair.
        cameras: names of both cameras, for messages.

    Returns:
        Times of the left pictures, shape (T,), the pairs, and a line for each dropped picture.

    Raises:
        InputError: there are fewer than two pairs, or consecutive pictures are too close or too far
            apart in time.
    """
    left_ns, right_ns = (np.array([shot.time_ns for shot in s], np.int64) for s in (left, right))
    step_ns = float(np.median(np.diff(left_ns))) if len(left) > 1 else _MIN_STEP_NS
    if not _MIN_STEP_NS <= step_ns <= _MAX_STEP_NS:
        found = f"pictures are {step_ns / 1e9:g} s apart (median)"
        raise InputError(f"{source}: {found}; are times in another unit?")
    partner, back = _nearest(left_ns, right_ns), _nearest(right_ns, left_ns)
    both = [
        (i, j)
        for i, j in enumerate(partner.tolist())
        if back[j] == i and abs(int(right_ns[j]) - int(left_ns[i])) <= max_offset_ns
    ]
    if len(both) < 2:
        found = f"{len(left)} pictures of {cameras[0]} and {len(right)} of {cameras[1]}"
        made = f"{len(both)} pairs within {max_offset_ns / 1e6:g} ms; 2 are the least"
        if len(left) > 1 and len(right) > 1:
            apart_s = float(np.abs(right_ns[partner] - left_ns).min()) / 1e9
            made += f"; the nearest two are {apart_s:.9g} s apart: are they of one clock?"
        raise InputError(f"{source}: {found} make {made}")
    reason = f"no partner within {max_offset_ns / 1e6:g} ms"
    paired_left, paired_right = (set(rows) for rows in zip(*both, strict=True))
    _warn_of_shifted_times(source, both, (len(left), len(right)), cameras)
    dropped = [f"{s.name} ({reason})" for i, s in enumerate(left) if i not in paired_left]
    dropped += [f"{s.name} ({reason})" for j, s in enumerate(right) if j not in paired_right]
    pictures = [(left[i].load, right[j].load) for i, j in both]
    return left_ns[[i for i, _ in both]], pictures, tuple(dropped)


def _warn_of_shifted_times(
    source: Path,
    pairs: Sequence[tuple[int, int]],
    lengths: tuple[int, int],
    cameras: tuple[str, str],
) -> None:
    """Warn if one camera lacks partners at its start and the other as many at its end.

    So do two cameras whose clocks differ by a constant. One picture may be a late start.
    """
    n_unpaired_first = pairs[0]
    n_unpaired_last = tuple(n - 1 - last for n, last in zip(lengths, pairs[-1], strict=True))
    for first, last in ((0, 1), (1, 0)):
        n = min(n_unpaired_first[first], n_unpaired_last[last])
        if n >= _SHIFTED_PICTURES and not n_unpaired_first[last] and not n_unpaired_last[first]:
            message = (
                f"the first {n_unpaired_first[first]} pictures of {cameras[first]} and the last "
            )
            message += f"{n_unpaired_last[last]} of {cameras[last]} have no partner"
            question = "are both timed by one clock?"
            warnings.warn(f"{source}: {message}: {question}", TellingWarning, stacklevel=3)


def _nearest(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the index of the nearest of other times (M,) for each time (N,); both increase."""
    if not len(others):
        return np.empty(0, dtype=np.int64)
    after = np.clip(np.searchsorted(others, times), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(others[before] - times) <= np.abs(others[after] - times), before, after)


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
        p_robot_eye = self.camera.p_robot_eye(-half_m if camera else half_m)
        return se3.pose(self.camera.camera_axes @ R_ROBOT_OPTICAL, p_robot_eye)


def write_dead_reckoning(folder: Path, drive: StereoDrive) -> None:
    """Write the dead-reckoned trajectory of a drive to `odometry.tum` in a folder."""
    comment = f"{drive.robot}: dead reckoning by the wheels, in the frame of the first pose"
    text = tum_text(drive.time_s, drive.reckoned_bodies, comment)
    write_text(folder / ODOMETRY_FILE, text.splitlines())


def write_text(path: Path, lines: list[str]) -> None:
    """Write lines of text atomically."""
    text = "\n".join([*lines, ""])
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write a picture (H, W) uint8 or uint16 as PNG atomically."""
    data = cv2.imencode(".png", image)[1].tobytes()
    write_atomically(path, lambda temporary: temporary.write_bytes(data))
