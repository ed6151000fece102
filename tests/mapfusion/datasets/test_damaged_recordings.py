"""Damaged or contradictory recordings raise a one-line error and write nothing."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapfusion.datasets.formats import import_recording
from mapfusion.errors import InputError
from tests.mapfusion.datasets.written_layouts import (
    WRITERS,
    Pair,
    drive,
    read_yaml,
    write_calibration,
)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return drive()


ONE_POSE = "1 0 0 0 0 1 0 0 0 0 1 0\n"
SENSOR = "mav0/cam0/sensor.yaml"
STATES = "mav0/state_groundtruth_estimate0/data.csv"


def _draw(path: Path, side: int) -> None:
    cv2.imwrite(str(path), np.zeros((side, side), np.uint8))


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def _rows(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the words of each row behind the header."""
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *(",".join(change(row.split(","))) for row in rows), ""]))


def _edit_motion(path: Path) -> None:
    """Remove the last row of the motion."""
    document = read_yaml(path)
    document["cam1"]["T_cn_cnm1"] = document["cam1"]["T_cn_cnm1"][:3]
    path.write_text(json.dumps(document))  # JSON is YAML


def _mistype_baseline(root: Path) -> None:
    for camera in ("cam0", "cam1"):
        _edit(root / camera / "sensor.yaml", "216.0, 216.0", "577.0, 577.0")
    _edit(root / "cam1/sensor.yaml", "-0.045", "-8.955")


def _seconds(words: list[str]) -> list[str]:
    return [f"{int(words[0]) / 1e9:.3f}", *words[1:]]


def _swap(folder: Path) -> None:
    for old, new in (("left", "other"), ("right", "left"), ("other", "right")):
        (folder / old).rename(folder / new)


# Layout, what is done to its folder, and what must be said of it.
DAMAGE: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "no times": ("kitti", lambda f: (f / "times.txt").unlink(), "times.txt: no such file"),
    "back": (
        "kitti",
        lambda f: (f / "times.txt").write_text("0\n.2\n.1\n.6\n1\n"),
        "line 3: runs back",
    ),
    "few times": ("kitti", lambda f: (f / "times.txt").write_text("0\n"), "has 1 times, none for"),
    "no number": ("kitti", lambda f: (f / "times.txt").write_text("0\nsoon\n"), "line 2: 'soon'"),
    "no matrix": ("kitti", lambda f: (f / "calib.txt").write_text("P0: 1\n"), "no line P1:|12"),
    "no folder": (
        "kitti",
        lambda f: (f / "image_1").rename(f / "other"),
        "image_1: no such folder",
    ),
    "few poses": (
        "kitti",
        lambda f: (f.parents[1] / "poses/07.txt").write_text(ONE_POSE),
        "has 1 poses for 5",
    ),
    "no rotations": (
        "kitti",
        lambda f: (f.parents[1] / "poses/07.txt").write_text(ONE_POSE * 4 + "0 " * 12),
        r"07.txt, pose 5: \[R t\]: is no rotation",
    ),
    "the other way round": ("images", lambda f: _swap(f), "other way round"),
    "microseconds": (
        "kitti",
        lambda f: (f / "times.txt").write_text("0\n.0001\n.0002\n.0004\n.0005\n"),
        "0.0001 s apart .*another unit",
    ),
    "milliseconds": (
        "kitti",
        lambda f: (f / "times.txt").write_text("0\n100\n200\n301\n400\n"),
        "100 s apart .*another unit",
    ),
    "truncated": (
        "kitti",
        lambda f: (f / "image_0/000002.png").write_bytes(b"\x89PNG"),
        "000002.png: damaged",
    ),
    "mixed sizes": (
        "kitti",
        lambda f: _draw(f / "image_1/000004.png", 99),
        "pair 4: right image: is 99x99 px",
    ),
    "no day": (
        "kitti_raw",
        lambda f: (f.parent / "calib_cam_to_cam.txt").unlink(),
        "calib_cam_to_cam.txt: no such file",
    ),
    "no raw matrix": (
        "kitti_raw",
        lambda f: _edit(f.parent / "calib_cam_to_cam.txt", "P_rect_01", "P_rect_09"),
        r"has no line P_rect_01: \(12 numbers\)",
    ),
    "not rectified": (
        "kitti_raw",
        lambda f: _edit(f.parent / "calib_cam_to_cam.txt", "S_rect_00: 2.4", "S_rect_00: 2.3"),
        "rectified ones 230x180; give the drive whose name ends in _sync",
    ),
    "raw time": (
        "kitti_raw",
        lambda f: (f / "image_00/timestamps.txt").write_text("2011-09-26 noon\n"),
        "timestamps.txt, line 1: '2011-09-26 noon' is no time",
    ),
    "raw picture without a time": (
        "kitti_raw",
        lambda f: (f / "image_00/timestamps.txt").write_text("2011-09-26 13:02:25.9\n"),
        "has 1 times, none for",
    ),
    "half a state": (
        "kitti_raw",
        lambda f: (f / "oxts/data/0000000003.txt").write_text("49.0 8.4\n"),
        "0000000003.txt, line 1: has 2 columns, expected 30",
    ),
    "turned inside out": (
        "kitti_raw",
        lambda f: (f.parent / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0"),
        "calib_imu_to_velo.txt: R and T: is no rotation",
    ),
    "no calibration": ("euroc", lambda f: (f / "mav0/cam1/sensor.yaml").unlink(), "sensor.yaml"),
    "no mount": (
        "euroc",
        lambda f: _edit(f / SENSOR, "T_BS:", "T_B:"),
        "T_BS: is missing, expected 4 rows",
    ),
    "model": (
        "euroc",
        lambda f: _edit(f / SENSOR, "model: pinhole", "model: omni"),
        "only pinhole",
    ),
    "lens": ("euroc", lambda f: _edit(f / SENSOR, "radial-tangential", "fov"), "'fov' is unknown"),
    "no cameras": ("euroc", lambda f: (f / "mav0").rename(f / "other"), "no cam0/data.csv"),
    "states": ("euroc", lambda f: (f / STATES).write_text("1,2,3\n"), "has 3 columns"),
    "no names": (
        "images",
        lambda f: next((f / "left").iterdir()).rename(f / "left/a.png"),
        "named by no time",
    ),
    "other size": (
        "images",
        lambda f: write_calibration(f / "calibration.yaml", resolution=[300, 200]),
        "calibration's 300x200",
    ),
    "no focal": (
        "images",
        lambda f: write_calibration(f / "calibration.yaml", intrinsics=[1, 2]),
        "intrinsics: is ",
    ),
    "text": (
        "images",
        lambda f: write_calibration(f / "calibration.yaml", resolution="big"),
        "resolution",
    ),
    "tum": ("images", lambda f: (f / "odometry.tum").write_text("1 2 3\n"), "odometry.tum, line 1"),
    "tum of KITTI": (
        "images",
        lambda f: (f / "odometry.tum").write_text(ONE_POSE),
        r"odometry.tum, line 1: has 12 columns, expected 8 \(time x y z qx qy qz qw\); KITTI's",
    ),
    "tum with a number in front": (
        "images",
        lambda f: (f / "odometry.tum").write_text("1 1 0 0 0 0 0 0 1\n"),
        r"has 9 columns, expected 8 \(time x y z",
    ),
    "tum with commas": (
        "images",
        lambda f: (f / "odometry.tum").write_text("1,0,0,0,0,0,0,1\n"),
        "has 1 columns, expected 8 .* separated by commas",
    ),
    "KITTI's poses with times": (
        "kitti",
        lambda f: (f.parents[1] / "poses/07.txt").write_text("1 0 0 0 0 0 0 1\n"),
        "07.txt, line 1: has 8 columns, expected 12 .*; TUM's poses have 8",
    ),
    "eleven numbers": (
        "kitti",
        lambda f: (f / "calib.txt").write_text("P0: 1 2 3\n"),
        r"calib.txt, line 1: P0: has 3 numbers, expected 12 \(3 x 4\)",
    ),
    "other pictures": (
        "kitti",
        lambda f: [each.rename(each.with_suffix(".jpg")) for each in (f / "image_1").iterdir()],
        "image_1: holds no picture named 000000.png.*; it holds 000000.jpg",
    ),
    "empty folder": (
        "images",
        lambda f: [each.unlink() for each in (f / "right").iterdir()],
        "right: holds no picture of one camera",
    ),
    "seconds in a list of nanoseconds": (
        "euroc",
        lambda f: _rows(f / "mav0/cam0/data.csv", _seconds),
        "cam0/data.csv, line 2: time .* whole number of nanoseconds; is it in seconds",
    ),
    "names with a folder": (
        "euroc",
        lambda f: _rows(f / "mav0/cam1/data.csv", lambda w: [w[0], f"cam1/data/{w[1]}"]),
        r"cam1/data.csv: cam1/data/cam1/data/.*png \(no such file\); 5 of the 5 listed",
    ),
    "clocks apart": (
        "euroc",
        lambda f: _rows(f / "mav0/cam1/data.csv", lambda w: [f"{int(w[0]) + 10**10}", w[1]]),
        "make 0 pairs within 2 ms; .* nearest two are 9 s apart: are they of one clock",
    ),
    "mistyped baseline": (
        "euroc",
        lambda f: _mistype_baseline(f / "mav0"),
        "sensor.yaml of cam0 and cam1: the baseline is 9 m and the focal length 577 px",
    ),
    "no data": (
        "euroc",
        lambda f: _edit(f / SENSOR, "data:", "date:"),
        "cam0/sensor.yaml: T_BS.data: is missing, expected 4 rows of 4 numbers",
    ),
    "missing motion": (
        "images",
        lambda f: _edit(f / "calibration.yaml", "T_cn_cnm1", "T_cn"),
        "cam1: T_cn_cnm1: is missing, expected 4 rows",
    ),
    "short motion": (
        "images",
        lambda f: _edit_motion(f / "calibration.yaml"),
        "cam1: T_cn_cnm1: is 12 numbers, expected 4 rows of 4 numbers",
    ),
    "camera that is a list": (
        "images",
        lambda f: (f / "calibration.yaml").write_text("cam0: [1, 2]\n"),
        "calibration.yaml: cam0: is 2 numbers, expected a mapping",
    ),
    "short tum": (
        "images",
        lambda f: (f / "odometry.tum").write_text("1 0 0 0 0 0 0 1\n"),
        "the odometry is of 1.000 to 1.000 s, the pictures are of",
    ),
}


@pytest.mark.parametrize("what", list(DAMAGE))
def test_what_is_wrong_is_one_line(what: str, pairs: list[Pair], tmp_path: Path) -> None:
    name, harm, words = DAMAGE[what]
    folder = WRITERS[name](tmp_path / "recording", pairs)
    harm(folder)
    with pytest.raises((InputError, FileNotFoundError), match=words) as told:
        import_recording(name, folder, tmp_path / "logs", None, read_yaml)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "logs").exists()
