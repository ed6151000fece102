"""Stereo recordings in two image folders, or an image list, with a calibration file.

- Two folders, `left` and `right` by default. Pictures are named by their time, in nanoseconds (15
  digits or more) or in seconds (with a decimal point). Alternatively, a file `times.txt` holds a
  time in seconds for each picture of either folder, in the order of their names.
- A list in place of the folders: a CSV file with one pair a line: time in seconds, left file, right
  file. File names are relative to the list.
- The calibration is a YAML file in OpenCV's layout (see `read_stereo_calibration`) or in Kalibr's:
  `cam0` (left) and `cam1` (right) with `camera_model: pinhole`, `intrinsics`, `distortion_model`
  (`radtan`, `equidistant`, `none`), `distortion_coeffs`, `resolution`, and `T_cn_cnm1` of `cam1`,
  which maps points of the left camera into the frame of the right camera, or `T_cam_imu` of both.
  The optional `T_BS` of `cam0` maps points of the left camera into the robot frame.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from mapfusion.datasets.camera_calibration import read_stereo_calibration
from mapfusion.datasets.levelling import MountSettings, level_mount, robot_in_body
from mapfusion.datasets.stereo_recording import (
    MAX_OFFSET_NS,
    PictureFile,
    ReadYaml,
    Shot,
    StereoRecording,
    pair_shots,
)
from mapfusion.datasets.text_files import (
    NS,
    TRUTH_FILE,
    parse_time_ns,
    read_odometry_beside,
    read_rows,
    read_time_series,
    read_tum,
    require_columns,
    require_increasing,
)
from mapfusion.errors import InputError
from mapfusion.parameters import Range, require_in_range

_KINDS = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp"}
_IN_NS = re.compile(r"\d{15,19}")
_IN_S = re.compile(r"\d+\.\d+")
_HEIGHT_M = 0.5  # of a camera without a stated mount; an error shifts all heights equally


@dataclass(frozen=True)
class ImagesSettings:
    """Files of a recording, relative to its folder.

    Attributes:
        left: folder of the left camera's pictures.
        right: folder of the right camera's pictures.
        times: file of their times, read if it exists.
        list: list of pairs in place of the folders, read if it exists.
        calibration: calibration file of the pair.
        most_apart_s: largest time difference of the pictures of a pair.
        mount: replaces the mount of the calibration file, or the default, a level camera.
    """

    left: str = "left"
    right: str = "right"
    times: str = "times.txt"
    list: str = "pairs.csv"
    calibration: str = "calibration.yaml"
    most_apart_s: Annotated[float, Range(0, 1, "s")] = MAX_OFFSET_NS / NS
    mount: MountSettings = field(default_factory=MountSettings)

    def __post_init__(self) -> None:
        require_in_range(self)


def read_images(folder: Path, settings: ImagesSettings, read_yaml: ReadYaml) -> StereoRecording:
    """Read a recording with its `odometry.tum` and `truth.tum`; pictures are loaded later.

    Raises:
        InputError: a file is missing, damaged or of another format; the message names file and
            field or line.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (a recording of images)")
    calibration_file = folder / settings.calibration
    document = read_yaml(calibration_file)
    calibration, T_body_left = read_stereo_calibration(calibration_file, document)
    T_robot_left = level_mount(float(calibration.T_left_right[0, 3]), 0.0, _HEIGHT_M)
    if T_body_left is not None:
        T_robot_left = robot_in_body(T_body_left)[1]

    pair_list = folder / settings.list
    if pair_list.is_file():
        left, right, lines = list[Shot](), list[Shot](), list[int]()
        for line, words in read_rows(pair_list, "pairs of pictures", ","):
            require_columns(pair_list, line, words, "time left_file right_file")
            taken_ns = parse_time_ns(pair_list, line, words[0], NS)
            for file, shots in zip(words[1:], (left, right), strict=True):
                picture = pair_list.parent / file
                if not picture.is_file():
                    raise InputError(f"{pair_list}, line {line}: {file}: no such file")
                shots.append(Shot(taken_ns, file, PictureFile(picture)))
            lines.append(line)
        require_increasing(
            pair_list, lines, np.array([shot.time_ns for shot in left], dtype=np.int64)
        )
    else:
        left, right = (
            _read_folder(folder / name, folder / settings.times)
            for name in (settings.left, settings.right)
        )
    max_offset_ns = round(settings.most_apart_s * NS)
    time_ns, pictures, dropped = pair_shots(folder, left, right, max_offset_ns)
    truth = folder / TRUTH_FILE
    return StereoRecording(
        folder.resolve().name,
        time_ns,
        pictures,
        calibration,
        settings.mount.applied(T_robot_left),
        truth=read_tum(truth) if truth.exists() else None,
        odometry=read_odometry_beside(folder),
        dropped=dropped,
        calibrated_by=str(calibration_file),
    )


def _read_folder(folder: Path, times: Path) -> list[Shot]:
    """Return the pictures of a folder with the times of the file `times`, or of their names."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (pictures of one camera)")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _KINDS)
    if not paths:
        kinds = ", ".join(sorted(_KINDS))
        raise InputError(f"{folder}: holds no picture of one camera ({kinds})")
    if times.is_file():
        taken_ns, _ = read_time_series(times, "times of pictures", "time", NS, more=True)
        if len(taken_ns) != len(paths):
            found = f"has {len(taken_ns)} times for {len(paths)} pictures of {folder}"
            raise InputError(f"{times}: {found}")
        time_ns = taken_ns.tolist()
    else:
        time_ns = list[int]()
        for path in paths:
            if _IN_NS.fullmatch(path.stem):
                time_ns.append(parse_time_ns(path, 1, path.stem, 1))
            elif _IN_S.fullmatch(path.stem):
                time_ns.append(parse_time_ns(path, 1, path.stem, NS))
            else:
                reason = "is named by no time (nanoseconds of 15 digits or more, or seconds with a "
                reason += "decimal point)"
                raise InputError(f"{path}: {reason}; give the times in {times.name}")
        order = np.argsort(time_ns, kind="stable").tolist()  # 9.5.png precedes 10.0.png
        paths, time_ns = [paths[k] for k in order], [time_ns[k] for k in order]
        require_increasing(folder, list(range(1, len(paths) + 1)), np.array(time_ns, np.int64))
    return [
        Shot(time, f"{folder.name}/{path.name}", PictureFile(path))
        for time, path in zip(time_ns, paths, strict=True)
    ]
