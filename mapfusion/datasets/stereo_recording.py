"""Stereo recording in memory: image pairs over time, with calibration and optional data."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mapfusion.datasets.camera_calibration import StereoCalibration
from mapfusion.datasets.imu import ImuData
from mapfusion.datasets.tum import TimedPoses
from mapfusion.errors import InputError
from mapfusion.geometry.numerics import Float

_BITS = 8
_SILENT = 0  # OpenCV's level of logging
_SAMPLED = 8  # pictures whose brightest level tells how many of 16 bits a camera uses

Load = Callable[[], np.ndarray]


@dataclass(frozen=True)
class PictureFile:
    """A picture on disk; calling it reads it as it is stored."""

    path: Path

    def __call__(self) -> np.ndarray:
        """(H, W) or (H, W, 3), uint8 or uint16; raises InputError."""
        try:
            data = np.frombuffer(self.path.read_bytes(), np.uint8)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{self.path}: cannot be read ({reason})") from error
        image = _decoded(data) if len(data) else None
        if image is None:
            raise InputError(f"{self.path}: damaged or no picture")
        if image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.path}: holds {image.dtype}, expected 8 or 16 bits a channel")
        return image


def _decoded(data: np.ndarray) -> np.ndarray | None:
    """None where it is no picture, of which OpenCV would say so on the terminal, too."""
    before = cv2.utils.logging.setLogLevel(_SILENT)
    try:
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(before)


def grey(image: np.ndarray) -> np.ndarray:
    """(H, W) of a picture in grey, or in colour in OpenCV's order (BGR, BGRA)."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return image[:, :, 0]
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)


def unused_bits(loads: Iterable[Load]) -> int:
    """By how much 16-bit levels are to be shifted right so that 8 bits hold the brightest seen."""
    brightest = max((int(grey(load()).max()) for load in loads), default=0)
    return max(brightest.bit_length() - _BITS, 0)


def sample_indices(n: int) -> list[int]:
    """Some of n pictures, evenly spread, the first and the last among them."""
    return sorted(set(np.linspace(0, n - 1, min(n, _SAMPLED)).astype(int).tolist()))


def to_eight_bits(image: np.ndarray, shift: int) -> np.ndarray:
    """Grey levels (H, W) uint8; 16-bit ones shifted, and what is brighter than 255 cut."""
    levels = grey(image)
    if levels.dtype == np.uint8:
        return levels
    return np.minimum(levels >> shift, 255).astype(np.uint8)


# The library reads no YAML itself: whoever calls hands in a function from a path to its mapping,
# which raises InputError.
ReadYaml = Callable[[Path], Mapping[str, Any]]
# Pictures of one pair: at 1 rad/s and a focal length of 500 px, 2 ms are a pixel.
MOST_APART_NS = 2_000_000
# Between two pictures of one camera (median): none takes a thousand a second, so a shorter time is
# one in another unit. With less than one in ten seconds a robot that moves sees nothing twice;
# milliseconds that are taken for seconds are 30 s apart and more.
_LEAST_STEP_NS, _MOST_STEP_NS = 1_000_000, 10_000_000_000


@dataclass(frozen=True)
class Shot:
    """One picture of one camera: when, what it is called in messages, and how to load it."""

    time_ns: int
    name: str
    load: Load


@dataclass(frozen=True)
class StereoRecording:
    """What an importer of stereo recordings reads.

    Attributes:
        name: of the recording.
        time_ns: (T,) int64, increasing, of each pair.
        pictures: T pairs, loaded when they are called for.
        calibration: of the pair as it is recorded.
        T_robot_left: (4, 4) mount of the left camera as recorded; axes x ahead, y left, z up.
        truth: T_world_robot, where it is known.
        odometry: T_start_robot by dead reckoning, where it was recorded.
        dropped: pictures without a partner, and why, for people.
        inertial: accelerations, where they were recorded.
        calibrated_by: what holds the calibration, for messages.
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
    _shift: list[int] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.pictures)

    def pair(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Raw pictures (H, W) uint8 of pair k; raises InputError that names the file."""
        if not self._shift:  # one for all, so that the same grey means the same light
            both = [load for n in sample_indices(len(self)) for load in self.pictures[n]]
            self._shift.append(unused_bits(both))
        left, right = (to_eight_bits(load(), self._shift[0]) for load in self.pictures[k])
        return left, right

    def __iter__(self) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """Seconds since the first pair, and the raw pictures, pair by pair."""
        for k in range(len(self)):
            yield (int(self.time_ns[k]) - int(self.time_ns[0])) / 1e9, *self.pair(k)


def pair_shots(
    left: Sequence[Shot], right: Sequence[Shot], most_apart_ns: int = MOST_APART_NS
) -> tuple[np.ndarray, list[tuple[Load, Load]], tuple[str, ...]]:
    """Pictures of two cameras that were taken together, each camera's in the order of time.

    Returns:
        Times (T,) of the left ones, the pairs, and what was dropped, and why.

    Raises:
        InputError: there are no two pairs, or the times are too near to be a camera's, or too far
            apart.
    """
    left_ns, right_ns = (np.array([shot.time_ns for shot in s], np.int64) for s in (left, right))
    step_ns = float(np.median(np.diff(left_ns))) if len(left) > 1 else _LEAST_STEP_NS
    if not _LEAST_STEP_NS <= step_ns <= _MOST_STEP_NS:
        raise InputError(
            f"pictures are {step_ns / 1e9:g} s apart (median); are times in another unit?"
        )
    partner, back = _nearest(left_ns, right_ns), _nearest(right_ns, left_ns)
    both = [
        (i, j)
        for i, j in enumerate(partner.tolist())
        if back[j] == i and abs(int(right_ns[j]) - int(left_ns[i])) <= most_apart_ns
    ]
    if len(both) < 2:
        found = f"{len(left)} pictures of the left camera and {len(right)} of the right one"
        made = f"{len(both)} pairs within {most_apart_ns / 1e6:g} ms; 2 are the least"
        if len(left) > 1 and len(right) > 1:
            apart_s = float(np.abs(right_ns[partner] - left_ns).min()) / 1e9
            made += f"; the nearest two are {apart_s:.9g} s apart: are they of one clock?"
        raise InputError(f"{found} make {made}")
    alone = f"no partner within {most_apart_ns / 1e6:g} ms"
    paired_left, paired_right = (set(rows) for rows in zip(*both, strict=True))
    dropped = [f"{s.name} ({alone})" for i, s in enumerate(left) if i not in paired_left]
    dropped += [f"{s.name} ({alone})" for j, s in enumerate(right) if j not in paired_right]
    pictures = [(left[i].load, right[j].load) for i, j in both]
    return left_ns[[i for i, _ in both]], pictures, tuple(dropped)


def _nearest(these: np.ndarray, those: np.ndarray) -> np.ndarray:
    """For each of these times (N,) the row of the nearest of those (M,), both increasing."""
    if not len(those):
        return np.empty(0, dtype=np.int64)
    after = np.clip(np.searchsorted(those, these), 0, len(those) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(those[before] - these) <= np.abs(those[after] - these), before, after)
