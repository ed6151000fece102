"""Formats of recordings by name: importers and exporters."""

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from mapfusion.errors import InputError

if TYPE_CHECKING:
    from mapfusion.datasets.export import StereoDrive
    from mapfusion.datasets.stereo_recording import ReadYaml, StereoRecording


AttitudeSource = Literal["auto", "mount", "pictures", "floor", "imu", "odometry"]


_LONGEST_NAME = 40  # of a robot: names become parts of file names


@dataclass(frozen=True)
class Importer:
    """What reads recordings of one format.

    Attributes:
        target: `module:function` of it, imported when it is called. The function raises InputError
            that names file and line. Of logs, it takes a recording's folder, where the logs go and
            its settings, writes a log (with the truth, if there is any) for each robot, and returns
            the logs' folders; it writes nothing where it raises. Of stereo pictures, it takes a
            recording's folder, its settings and a `ReadYaml`, and returns a `StereoRecording`.
        settings: name of the dataclass of its settings, in the same module.
        what: the recordings, in a few words.
        example: how such a recording's folder may be called.
        stereo: whether pictures are recorded, of which observations are yet to be made.
        options: settings that the command takes by their own names, and what they are.
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
    "rosbag": Importer(
        "mapfusion.datasets.rosbag:read_rosbag",
        "RosbagSettings",
        "Bags of ROS 1 (.bag) and ROS 2 (folder)",
        "drive.bag",
        stereo=True,
        options={
            "left": "Topic of the left camera's pictures.",
            "right": "Topic of the right camera's.",
            "odom": "Topic of the robot's odometry; without it the pictures tell.",
            "imu": "Topic of an IMU: its accelerations level the camera, and each frame.",
        },
    ),
}


# By name what writes a `StereoDrive` into a folder and returns the paths to import it from.
EXPORTERS = {
    "euroc": "mapfusion.datasets.euroc:write_euroc",
    "kitti": "mapfusion.datasets.kitti:write_kitti",
    "rosbag": "mapfusion.datasets.rosbag_writer:write_rosbag",
    "rosbag2": "mapfusion.datasets.rosbag_writer:write_rosbag2",
}


def settings_class(format_name: str) -> type[Any]:
    """The dataclass of an importer's settings; raises InputError for an unknown name."""
    importer, _ = _found(format_name)
    module, _, _ = importer.target.partition(":")
    return getattr(importlib.import_module(module), importer.settings)


def read_recording(
    format_name: str, folder: Path, settings: Any = None, read_yaml: "ReadYaml | None" = None
) -> "StereoRecording":
    """A stereo recording: a stream of pairs, with calibration, and truth where there is any.

    Args:
        format_name: of a stereo format of `IMPORTERS`.
        folder: of the recording.
        settings: of the format's `settings_class`, by default with all its defaults.
        read_yaml: from a path to the mapping that a YAML file holds, for formats whose calibration
            is one; raises InputError.

    Raises:
        InputError: no such format, or what it has to say against the recording.
    """
    importer, function = _found(format_name)
    if not importer.stereo:
        raise InputError(f"recordings of {format_name!r}: hold no pictures")
    chosen = settings_class(format_name)() if settings is None else settings
    return function(folder, chosen, read_yaml or _no_yaml)


def import_recording(
    format_name: str,
    folder: Path,
    destination: Path,
    settings: Any = None,
    read_yaml: "ReadYaml | None" = None,
) -> list[Path]:
    """Write one log for each robot of a recording; returns the logs' folders.

    Settings and `read_yaml` as `read_recording` has them. A stereo recording is one robot.

    Raises:
        InputError: no importer has that name, or what it has to say against the recording.
    """
    importer, function = _found(format_name)
    if not importer.stereo:
        return function(folder, destination, settings)
    from mapfusion.datasets.stereo_import import RecordingPart, StereoImport, write_imported

    recording = read_recording(format_name, folder, settings, read_yaml)
    whole = RecordingPart(robot_name(recording.name), slice(None))
    return write_imported(destination, [StereoImport(recording).log_of(whole)])


def export_drive(
    format_name: str,
    folder: Path,
    drive: "StereoDrive",
    on_frame: Callable[[int, int], None] = lambda *_: None,
) -> list[Path]:
    """Write a drive in a format of `EXPORTERS`; returns the paths to import it from.

    Raises:
        InputError: no exporter has that name.
    """
    if format_name not in EXPORTERS:
        raise InputError(f"--format {format_name}: unknown; known: {', '.join(EXPORTERS)}")
    module, _, function = EXPORTERS[format_name].partition(":")
    return getattr(importlib.import_module(module), function)(folder, drive, on_frame)


def robot_name(recording: str) -> str:
    """The name of a recording as a robot may be called."""
    return re.sub("[^A-Za-z0-9_-]+", "-", recording).strip("-_")[:_LONGEST_NAME] or "robot"


def _no_yaml(path: Path) -> Any:
    raise InputError(f"{path}: give `read_yaml`, a function that reads YAML, to read it")


def _found(format_name: str) -> tuple[Importer, Callable[..., Any]]:
    if format_name not in IMPORTERS:
        raise InputError(f"recordings of {format_name!r}: unknown; known: {', '.join(IMPORTERS)}")
    importer = IMPORTERS[format_name]
    module, _, function = importer.target.partition(":")
    return importer, cast(Callable[..., Any], getattr(importlib.import_module(module), function))
