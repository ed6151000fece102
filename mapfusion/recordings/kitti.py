"""Stereo recordings in the layout of KITTI's odometry benchmark, as read and as written.

Geiger, Lenz, Urtasun (2012), "Are we ready for autonomous driving? The KITTI vision benchmark
suite". A sequence is a folder:

- `image_0`, `image_1` (grey) or `image_2`, `image_3` (colour): rectified pictures 000000.png, ...
- `calib.txt`: `P0:` to `P3:`, projection matrices (3, 4), row by row, of the cameras 0 to 3.
- `times.txt`: seconds since the beginning, one a line.
- the true poses of the left camera (3, 4), one a line: `poses/NN.txt` beside the folder `sequences`
  that holds sequence NN, or `poses.txt` in the sequence; optional.
- `odometry.tum`: dead reckoning of the robot's axes, which KITTI has not; ours, optional.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from mapfusion import se3
from mapfusion.errors import InputError
from mapfusion.recordings.lens import R_ROBOT_OPTICAL, Lens, StereoCalibration, require_rigid
from mapfusion.recordings.mount import MountSettings, level_mount
from mapfusion.recordings.numbered import numbered_shots
from mapfusion.recordings.stereo_recording import ReadYaml, StereoRecording, paired
from mapfusion.recordings.text_tables import (
    NS,
    POSES,
    numbers,
    require_columns,
    require_increasing,
    rows_of,
    time_in_ns,
)
from mapfusion.recordings.timed_poses import TimedPoses
from mapfusion.recordings.tum import ODOMETRY_FILE, read_odometry
from mapfusion.se2 import Float

HEIGHT_M = 1.65  # of KITTI's cameras above the road, by its publication
_DIGITS = 6  # of a picture's name
_POSE_COLUMNS = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"


@dataclass(frozen=True)
class KittiSettings:
    """How KITTI sequences and raw drives are read.

    Attributes:
        cameras: the grey pair (0 and 1) or that in colour (2 and 3).
        mount: what replaces a left camera that looks level ahead 1.65 m above the road.
    """

    cameras: Literal["grey", "colour"] = "grey"
    mount: MountSettings = field(default_factory=MountSettings)


def read_kitti(folder: Path, settings: KittiSettings, _: ReadYaml) -> StereoRecording:
    """Read a sequence; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or foreign; names file and line.
    """
    first = 0 if settings.cameras == "grey" else 2
    folders = [folder / f"image_{camera}" for camera in (first, first + 1)]
    timed = folder / "times.txt"
    times = _times(timed)
    left, right = (numbered_shots(each, _DIGITS, each.name, times, timed) for each in folders)
    try:
        time_ns, pictures, dropped = paired(left, right)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    calibration = _calibration(folder / "calib.txt", first, pictures[0][0]().shape[:2])
    baseline_m = float(calibration.T_left_right[0, 3])
    T_robot_left = settings.mount.applied(level_mount(baseline_m, 0.0, HEIGHT_M))
    sequence = folder.resolve()
    beside = sequence.parent.parent / "poses" / f"{sequence.name}.txt"
    truth = next((path for path in (sequence / "poses.txt", beside) if path.exists()), None)
    odometry = folder / ODOMETRY_FILE
    return StereoRecording(
        sequence.name,
        time_ns,
        pictures,
        calibration,
        T_robot_left,
        None if truth is None else _truth(truth, times, T_robot_left),
        read_odometry(odometry) if odometry.exists() else None,
        dropped,
        calibrated_by=str(folder / "calib.txt"),
    )


def _times(path: Path) -> np.ndarray:
    lines, times = list[int](), list[int]()
    for line, words in rows_of(path, "times of a KITTI sequence"):
        require_columns(path, line, words, "time")
        lines.append(line)
        times.append(time_in_ns(path, line, words[0], NS))
    time_ns = np.array(times, dtype=np.int64)
    require_increasing(path, lines, time_ns)
    return time_ns


def _calibration(path: Path, first: int, shape: tuple[int, int]) -> StereoCalibration:
    matrices = {
        words[0].removesuffix(":"): (line, words[1:])
        for line, words in rows_of(path, "calibration of a KITTI sequence")
    }
    found = []
    for name in (f"P{first}", f"P{first + 1}"):
        found.append(named_matrix(path, matrices, name, (3, 4)))
    return rectified_pair(path, found, (shape[1], shape[0]))


def named_matrix(
    path: Path, told: dict[str, tuple[int, list[str]]], name: str, shape: tuple[int, ...]
) -> Float:
    """A matrix of a calibration file, by the name that its line begins with.

    Args:
        path: of the file, for messages.
        told: line number and words behind the name, by name.
        name: of the matrix.
        shape: of the matrix, row by row.

    Raises:
        InputError: names file and line.
    """
    n = int(np.prod(shape))
    if name not in told:
        raise InputError(f"{path}: has no line {name}: ({n} numbers)")
    line, words = told[name]
    if len(words) != n:
        found = f"{name}: has {len(words)} numbers, expected {n} ({' x '.join(map(str, shape))})"
        raise InputError(f"{path}, line {line}: {found}")
    return np.array(numbers(path, line, words)).reshape(shape)


def rectified_pair(path: Path, found: list[Float], size_px: tuple[int, int]) -> StereoCalibration:
    """Two cameras of projection matrices (3, 4) that were read at `path`; raises InputError."""
    lenses = []
    try:
        for P in found:
            focal, center = (P[0, 0], P[1, 1]), (P[0, 2], P[1, 2])
            lenses.append(Lens(size_px, focal, center))
        # Rectified to camera 0; of where the others stand only what lies along the rows counts.
        ahead = np.array([-P[0, 3] / P[0, 0] for P in found])
        T_left_right = se3.pose(np.eye(3), [ahead[1] - ahead[0], 0.0, 0.0])
        return StereoCalibration(lenses[0], lenses[1], T_left_right)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _truth(path: Path, time_ns: np.ndarray, T_robot_left: Float) -> TimedPoses:
    """T_world_robot; the world is the robot's frame at the beginning."""
    rows = []
    for line, words in rows_of(path, "true poses"):
        require_columns(path, line, words, _POSE_COLUMNS, POSES)
        rows.append(numbers(path, line, words))
    if len(rows) != len(time_ns):
        raise InputError(f"{path}: has {len(rows)} poses for {len(time_ns)} times")
    P = np.array(rows).reshape(-1, 3, 4)
    T = se3.pose(P[:, :, :3], P[:, :, 3])
    for number, each in enumerate(T, start=1):
        try:
            require_rigid("[R t]", each)
        except InputError as error:
            raise InputError(f"{path}, pose {number}: {error}") from error
    axes = se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    T_first_left = axes @ T @ se3.inverse(axes)
    return TimedPoses(time_ns, T_robot_left @ T_first_left @ se3.inverse(T_robot_left))
