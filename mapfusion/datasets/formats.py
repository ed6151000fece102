"""Formats of recordings by name: importers and exporters."""

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from mapfusion.errors import InputError

if TYPE_CHECKING:
    from mapfusion.datasets.stereo_recording import ReadYaml, StereoDrive, StereoRecording


AttitudeSource = Literal["auto", "mount", "pictures", "floor", "imu", "odometry"]
_MAX_NAME_LENGTH = 40  # of a robot: names are parts of file names


@dataclass(frozen=True)
class Importer:
    """Importer of recordings of one format.

    Attributes:
        target: `module:function` of the importer, which is imported when it is called. The function
            raises an InputError that names file and line. A function for logs takes the folder of
            the recording, the destination and the settings. It writes a log for each robot, with
            the truth if it is recorded, and returns the folders of the logs; it writes nothing if
            it raises an error. A function for stereo pictures takes the folder of the recording,
            the settings and a `ReadYaml`, and returns a `StereoRecording`.
        settings: name of the dataclass of the settings in the same module.
        what: short description of the recordings.
        example: example of the name of such a recording.
        stereo: True if the recordings hold stereo pictures instead of observations.
        options: settings that are options of the command, with their help texts.
    """

    target: str
    settings: str
    what: str
    example: str
    stereo: bool = False
    options: Mapping[str, str] = field(default_factory=dict)


IMPORTERS = {
    "mrclam": Importer(
        "mapfusion.datasets.mrclam:import_mrclam",
        "MrclamSettings",
        "UTIAS MRCLAM recordings",
        "MRCLAM_Dataset7",
    ),
    "points": Importer(
        "mapfusion.datasets.point_logs:import_points",
        "PointsSettings",
        "Odometry and points over time, in CSV or Parquet",
        "survey --param sigma_m=0.05",
    ),
    "ranges": Importer(
        "mapfusion.datasets.point_logs:import_ranges",
        "RangesSettings",
        "Odometry, ranges and bearings over time, in CSV or Parquet",
        "park --param range_sigma_m=0.3 --param bearing_sigma_rad=0.03",
    ),
    "euroc": Importer(
        "mapfusion.datasets.euroc:read_euroc",
        "EurocSettings",
        "Stereo pictures in EuRoC's layout (mav0)",
        "MH_01_easy",
        stereo=True,
    ),
    "kitti": Importer(
        "mapfusion.datasets.kitti:read_kitti",
        "KittiSettings",
        "Sequences of KITTI's odometry benchmark",
        "dataset/sequences/00",
        stereo=True,
    ),
    "kitti_raw": Importer(
        "mapfusion.datasets.kitti:read_kitti_raw",
        "KittiSettings",
        "Drives of KITTI's raw data, rectified and synchronised",
        "2011_09_26/2011_09_26_drive_0001_sync",
        stereo=True,
    ),
    "images": Importer(
        "mapfusion.datasets.image_folders:read_images",
        "ImagesSettings",
        "Two folders of pictures, or a list, with a calibration",
        "drive1",
        stereo=True,
    ),
    "tum_rgbd": Importer(
        "mapfusion.datasets.tum_rgbd:read_tum_rgbd",
        "TumRgbdSettings",
        "Pictures with depths in the TUM RGB-D benchmark's layout",
        "rgbd_dataset_freiburg3_long_office_household",
        stereo=True,
    ),
    "rosbag": Importer(
        "mapfusion.datasets.rosbag:read_rosbag",
        "RosbagSettings",
        "Bags of ROS 1 (.bag) and ROS 2 (folder)",
        "drive.bag",
        stereo=True,
        options={
            "left": "Topic of the left camera's pictures.",
            "right": "Topic of the right camera's pictures.",
            "odom": "Topic of the robot's odometry; without it visual odometry is used.",
            "imu": "Topic of an IMU: its accelerations level the camera and each frame.",
            "repeated": "Pictures that repeat a time: refuse them, or keep the first.",
        },
    ),
}


# Functions that write a `StereoDrive` into a folder and return the paths to import, by format.
EXPORTERS = {
    "euroc": "mapfusion.datasets.euroc:write_euroc",
    "kitti": "mapfusion.datasets.kitti:write_kitti",
    "tum_rgbd": "mapfusion.datasets.tum_rgbd:write_tum_rgbd",
    "rosbag": "mapfusion.datasets.rosbag:write_rosbag",
    "rosbag2": "mapfusion.datasets.rosbag:write_rosbag2",
}


def settings_class(format_name: str) -> type[Any]:
    """Return the dataclass of an importer's settings; raise InputError for an unknown name."""
    importer, _ = _find_importer(format_name)
    module, _, _ = importer.target.partition(":")
    return getattr(importlib.import_module(module), importer.settings)


def read_recording(
    format_name: str, folder: str | Path, settings: Any = None, read_yaml: "ReadYaml | None" = None
) -> "StereoRecording":
    """Read a stereo recording: pairs of pictures with calibration, and truth if it is recorded.

    Args:
        format_name: name of a stereo format of `IMPORTERS`.
        folder: folder of the recording.
        settings: instance of the format's `settings_class`; None for the defaults.
        read_yaml: function that returns the mapping of a YAML file or raises InputError, for
            formats with a YAML calibration.

    Raises:
        InputError: the format is unknown, or the recording is incomplete or damaged.
    """
    importer, function = _find_importer(format_name)
    if not importer.stereo:
        raise InputError(f"recordings of {format_name!r}: hold no pictures")
    chosen = settings_class(format_name)() if settings is None else settings

    def no_yaml(path: Path) -> Any:
        raise InputError(f"{path}: give `read_yaml`, a function that reads YAML, to read it")

    return function(Path(folder), chosen, read_yaml or no_yaml)


def import_recording(
    format_name: str,
    folder: str | Path,
    destination: str | Path,
    settings: Any = None,
    read_yaml: "ReadYaml | None" = None,
) -> list[Path]:
    """Write one log for each robot of a recording and return the folders of the logs.

    A stereo recording is one robot. Settings and `read_yaml` are those of `read_recording`.

    Raises:
        InputError: the format is unknown, or the recording is incomplete or damaged.
    """
    importer, function = _find_importer(format_name)
    if not importer.stereo:
        return function(Path(folder), Path(destination), settings)
    from mapfusion.datasets.stereo_import import RecordingPart, StereoImport, write_imported

    recording = read_recording(format_name, folder, settings, read_yaml)
    whole_recording = RecordingPart(robot_name(recording.name), slice(None))
    return write_imported(Path(destination), [StereoImport(recording).log_of(whole_recording)])


def export_drive(
    format_name: str,
    folder: Path,
    drive: "StereoDrive",
    on_frame: Callable[[int, int], None] = lambda *_: None,
) -> list[Path]:
    """Write a drive in a format of `EXPORTERS` and return the paths to import.

    Raises:
        InputError: the format is unknown.
    """
    if format_name not in EXPORTERS:
        raise InputError(f"--format {format_name}: unknown; known: {', '.join(EXPORTERS)}")
    module, _, function = EXPORTERS[format_name].partition(":")
    return getattr(importlib.import_module(module), function)(folder, drive, on_frame)


def robot_name(recording: str) -> str:
    """Return a valid robot name made of the name of a recording."""
    return re.sub("[^A-Za-z0-9_-]+", "-", recording).strip("-_")[:_MAX_NAME_LENGTH] or "robot"


def _find_importer(format_name: str) -> tuple[Importer, Callable[..., Any]]:
    """Return an importer and its function; raise InputError for an unknown name."""
    if format_name not in IMPORTERS:
        raise InputError(f"recordings of {format_name!r}: unknown; known: {', '.join(IMPORTERS)}")
    importer = IMPORTERS[format_name]
    module, _, function = importer.target.partition(":")
    return importer, cast(Callable[..., Any], getattr(importlib.import_module(module), function))
