"""Pictures with depths in the layout of the TUM RGB-D benchmark.

Sturm et al. (2012), "A benchmark for the evaluation of RGB-D SLAM systems".

- `rgb.txt` and `depth.txt` hold a time in seconds and the name of a picture a line. Alternatively,
  `associations.txt` holds both of each pair: time, colour picture, time, depth picture.
- Depths are PNG pictures of 16 bit, 5000 levels a metre, 0 where unknown. They are registered to
  the colour pictures: a pixel of both shows the same point.
- `groundtruth.txt` holds poses of the colour camera in optical axes (x right, y down, z ahead).
- The layout has no calibration. It is given by a file or as numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from mapfusion.datasets.camera_calibration import (
    R_ROBOT_OPTICAL,
    Lens,
    StereoCalibration,
    parse_lens,
    parse_transform,
)
from mapfusion.datasets.levelling import MountSettings, robot_in_body
from mapfusion.datasets.stereo_recording import (
    OnFrame,
    PictureFile,
    ReadYaml,
    Shot,
    StereoDrive,
    StereoRecording,
    pair_shots,
    write_dead_reckoning,
    write_picture,
    write_text,
)
from mapfusion.datasets.text_files import (
    NS,
    parse_time_ns,
    read_odometry_beside,
    read_rows,
    read_tum,
    require_columns,
    require_increasing,
    tum_text,
)
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from mapfusion.vision.depth import DepthParameters

_LEVELS_PER_M = 5000.0
_MOST_LEVELS = 65_535
_HEIGHT_M = 0.5  # of a camera without a stated mount; an error shifts all heights equally
_COLOUR, _DEPTH, _BOTH, _TRUTH = "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt"


@dataclass(frozen=True)
class TumRgbdSettings:
    """Calibration of the colour camera, and noise of the depths.

    Attributes:
        calibration: YAML file, relative to the folder, with a camera in Kalibr's layout (`cam0`, or
            its keys alone); `T_BS` is the mount. `resolution` may be missing.
        intrinsics: fu, fv, cu and cv in pixels, in place of the file.
        distortion: k1, k2, p1, p2 and optionally k3 or k3 to k6 of the lens, beside `intrinsics`.
        levels_per_m: levels of the depth pictures per metre.
        depth: noise and tests of the depths.
        mount: replaces the mount of the calibration, or the default, a level camera.
    """

    calibration: str = "calibration.yaml"
    intrinsics: tuple[float, ...] = ()
    distortion: tuple[float, ...] = ()
    levels_per_m: Annotated[float, Range(1, 1e6, "1/m")] = _LEVELS_PER_M
    depth: DepthParameters = field(default_factory=DepthParameters)
    mount: MountSettings = field(default_factory=MountSettings)

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class _DepthFile:
    """Depth picture on disk, which is read when it is called."""

    path: Path
    levels_per_m: float

    def __call__(self) -> np.ndarray:
        """Return depths in metres, shape (H, W) float32, NaN where unknown; raise InputError."""
        levels = PictureFile(self.path)()
        if levels.ndim != 2 or levels.dtype != np.uint16:
            bits, channels = 8 * levels.itemsize, levels.shape[2] if levels.ndim == 3 else 1
            found = f"has {channels} channels of {bits} bit" if channels > 1 else f"has {bits} bit"
            raise InputError(f"{self.path}: {found}, expected depths in one channel of 16 bit")
        depth_m = (levels / self.levels_per_m).astype(np.float32)
        depth_m[levels == 0] = np.nan
        return depth_m


def read_tum_rgbd(folder: Path, settings: TumRgbdSettings, read_yaml: ReadYaml) -> StereoRecording:
    """Read a recording with its `groundtruth.txt` and `odometry.tum`; pictures are loaded later.

    A colour picture is paired with the depth picture nearest in time, within half the interval of
    two pictures.

    Raises:
        InputError: a file is missing, damaged or of another format; the message names file and
            field or line.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder (a recording in the TUM RGB-D layout)")
    lost = list[str]()
    if (folder / _BOTH).is_file():
        path, columns = folder / _BOTH, "time rgb_file time depth_file"
        colour, depth = (_read_list(path, columns, at, settings, lost) for at in (0, 2))
    else:
        colour, depth = (
            _read_list(folder / name, "time file", 0, settings, lost) for name in (_COLOUR, _DEPTH)
        )
    lengths = [np.diff([shot.time_ns for shot in shots]) for shots in (colour, depth)]
    interval_ns = min((float(np.median(each)) for each in lengths if len(each)), default=0.0)
    cameras = "the colour camera", "the depth sensor"
    time_ns, pictures, dropped = pair_shots(folder, colour, depth, int(interval_ns / 2), cameras)
    sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (load() for load in pictures[0])]
    if sizes[0] != sizes[1]:
        found = f"colour pictures have {sizes[0]} px, depth pictures {sizes[1]}"
        raise InputError(f"{folder}: {found}; depths must be registered to the colour pictures")

    size = tuple(map(int, sizes[0].split("x")))
    calibrated_by, lens, T_robot_camera = _calibration(folder, settings, size, read_yaml)
    T_robot_camera = settings.mount.applied(T_robot_camera)
    T_left_right = se3.pose(np.eye(3), np.array([settings.depth.baseline_m, 0.0, 0.0]))
    truth = folder / _TRUTH
    optical = T_robot_camera @ se3.pose(R_ROBOT_OPTICAL, np.zeros(3))
    return StereoRecording(
        folder.resolve().name,
        time_ns,
        pictures,
        StereoCalibration(lens, lens, T_left_right),
        T_robot_camera,
        truth=read_tum(truth).moved(se3.inverse(optical)) if truth.exists() else None,
        odometry=read_odometry_beside(folder),
        dropped=(*lost, *dropped),
        calibrated_by=calibrated_by,
        depth=settings.depth,
    )


def _read_list(
    path: Path, columns: str, at: int, settings: TumRgbdSettings, lost: list[str]
) -> list[Shot]:
    """Return the pictures timed by column `at` of a list; add missing ones to `lost`."""
    is_depth = at > 0 or path.name == _DEPTH
    shots, lines, named = list[Shot](), list[int](), list[str]()
    for line, words in read_rows(path, "times and names of pictures"):
        require_columns(path, line, words, columns)
        time_ns, picture = parse_time_ns(path, line, words[at], NS), path.parent / words[at + 1]
        named.append(words[at + 1])
        if picture.is_file():
            load = _DepthFile(picture, settings.levels_per_m) if is_depth else PictureFile(picture)
            shots.append(Shot(time_ns, words[at + 1], load))
            lines.append(line)
        else:
            lost.append(f"{words[at + 1]} (no such file)")
    if named and not shots:
        raise InputError(f"{path}: {named[0]}: no such file; names are relative to {path.parent}")
    require_increasing(path, lines, np.array([shot.time_ns for shot in shots], np.int64))
    return shots


def _calibration(
    folder: Path, settings: TumRgbdSettings, size_px: tuple[int, ...], read_yaml: ReadYaml
) -> tuple[str, Lens, Float]:
    """Return the source of the calibration, the lens, and the recorded mount (4, 4)."""
    T_robot_camera = se3.pose(np.eye(3), np.array([0.0, 0.0, _HEIGHT_M]))
    path = folder / settings.calibration
    if not settings.intrinsics and not path.is_file():
        remedy = "give --calibration FILE or --param intrinsics=[fu,fv,cu,cv]"
        raise InputError(f"{path}: no such file, and the layout has no calibration; {remedy}")
    camera: Mapping[str, Any]
    if settings.intrinsics:
        where, named = "intrinsics", "radial-tangential" if any(settings.distortion) else "none"
        camera = {"intrinsics": list(settings.intrinsics), "distortion_model": named}
        camera["distortion_coefficients"] = list(settings.distortion)
    else:
        document = read_yaml(path)
        nested = document.get("cam0")
        where = f"{path}: cam0" if isinstance(nested, Mapping) else str(path)
        camera = dict(nested if isinstance(nested, Mapping) else document)
        if "T_BS" in camera:
            T_robot_camera = robot_in_body(parse_transform(where, "T_BS", camera))[1]
    lens = parse_lens(where, {"resolution": list(size_px), **camera})
    return where, lens, T_robot_camera


def write_tum_rgbd(folder: Path, drive: StereoDrive, on_frame: OnFrame) -> list[Path]:
    """Write the left pictures and depths of a drive to `folder/ROBOT` and return this path.

    Raises:
        InputError: the drive has no depths.
    """
    if drive.depth_m is None:
        raise InputError(f"{drive.robot}: has no depths to write")
    root, (cu, cv) = folder / drive.robot, drive.camera.center_px
    stamps = [f"{ns // NS}.{ns % NS // 1000:06d}" for ns in drive.time_ns.tolist()]
    for k, stamp in enumerate(stamps):
        write_picture(root / "rgb" / f"{stamp}.png", drive.pair(k)[0])
        levels = np.rint(np.nan_to_num(drive.depth_m(k)) * _LEVELS_PER_M)
        levels[levels > _MOST_LEVELS] = 0
        write_picture(root / "depth" / f"{stamp}.png", levels.astype(np.uint16))
        on_frame(k + 1, len(drive))
    for name, kind in ((_COLOUR, "rgb"), (_DEPTH, "depth")):
        lines = [f"{stamp} {kind}/{stamp}.png" for stamp in stamps]
        write_text(root / name, ["# timestamp filename", *lines])
    comment = f"{drive.robot}: true poses of the colour camera, x right, y down, z ahead"
    poses = drive.true_bodies @ drive.mount(0)
    write_text(root / _TRUTH, tum_text(drive.time_s, poses, comment).splitlines())
    camera = [
        f"intrinsics: [{drive.camera.focal_px}, {drive.camera.focal_px}, {cu}, {cv}]",
        f"resolution: [{drive.camera.width_px}, {drive.camera.height_px}]",
        "distortion_model: none",
        f"T_BS: {drive.mount(0).tolist()}",
    ]
    write_text(root / "calibration.yaml", ["cam0:", *(f"  {line}" for line in camera)])
    write_dead_reckoning(root, drive)
    return [root]
