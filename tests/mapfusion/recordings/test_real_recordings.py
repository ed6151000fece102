"""Extracts of KITTI and EuRoC, where MAPFUSION_RECORDINGS names the folder that holds them.

`kitti_extract` is laid out anew, as KITTI publishes its sequences; `euroc_extract` is so already.
"""

import itertools
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion import se2, se3
from mapfusion.align.correspondences import match
from mapfusion.align.registration import Registration
from mapfusion.align.registry import make_aligner
from mapfusion.errors import InputError
from mapfusion.fastslam.parameters import FastSlamParameters
from mapfusion.fastslam.run import build_map, run_log
from mapfusion.landmark_map import LandmarkMap
from mapfusion.recordings.lens import Lens, StereoCalibration
from mapfusion.recordings.registry import read_recording
from mapfusion.recordings.stereo_import import Cut, Imported, StereoImport
from mapfusion.recordings.stereo_recording import StereoRecording
from mapfusion.vision.frontend import FrontEnd
from tests.mapfusion.recordings.written_layouts import read_yaml

RECORDINGS = Path(os.environ.get("MAPFUSION_RECORDINGS", "none"))
pytestmark = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="MAPFUSION_RECORDINGS is not set")
WHOLE = Cut("R1", slice(None))


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> StereoRecording:
    root, extract = tmp_path_factory.mktemp("kitti"), RECORDINGS / "kitti_extract"
    sequence = root / "sequences" / "06"
    sequence.mkdir(parents=True)
    for camera, name in enumerate(("image_l", "image_r")):
        (sequence / f"image_{camera}").symlink_to((extract / name).resolve())
    numbers = (extract / "calib.txt").read_text().split()
    lines = [f"P{k}: {' '.join(numbers[12 * k : 12 * k + 12])}" for k in (0, 1)]
    (sequence / "calib.txt").write_text("\n".join(lines))
    (sequence / "times.txt").write_text("\n".join(f"{0.1 * k:e}" for k in range(26)))
    (sequence / "poses.txt").write_text((extract / "poses.txt").read_text())
    return read_recording("kitti", sequence)


@pytest.fixture(scope="module")
def work(kitti: StereoRecording) -> StereoImport:
    return StereoImport(kitti)


@pytest.fixture(scope="module")
def imported(work: StereoImport) -> Imported:
    return work.log_of(WHOLE)


def sgbm(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    matcher = cv2.StereoSGBM_create(
        0, 192, 5, 8 * 25, 32 * 25, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2,
    )  # fmt: skip
    disparity = matcher.compute(left, right).astype(float) / 16
    return np.where(disparity > 0, disparity, np.nan)


def test_kitti_matches_are_many_and_right(work: StereoImport) -> None:
    front_end, counts, right = FrontEnd(work.camera, work.vision), [], []
    for k in range(0, 26, 5):
        pair = work.rectified(k)
        found = front_end.extract(*pair)
        u, v = np.rint(found.uv_px).astype(int).T
        off = np.abs(sgbm(*pair)[v, u] - found.disparity_px)
        counts.append(len(found))
        right.append(np.mean(off[np.isfinite(off)] < 1))
    assert min(counts) >= 300
    assert np.mean(right) >= 0.97


def test_kitti_is_seen_well_enough_to_map(imported: Imported) -> None:
    assert np.median(imported.observations[2:]) >= 80
    assert imported.observations[2:].min() >= 20
    assert imported.too_little == ""


def test_kitti_odometry_from_the_pictures(kitti: StereoRecording, imported: Imported) -> None:
    assert kitti.truth is not None
    true = se3.planar(se3.between(kitti.truth.T[:-1], kitti.truth.T[1:]))
    error = imported.log.odometry[1:] - true
    assert np.median(np.hypot(*error[:, :2].T)) <= 0.02
    assert np.degrees(np.median(np.abs(error[:, 2]))) <= 0.04


def dead_reckoned(odometry: np.ndarray) -> np.ndarray:
    return np.array(list(itertools.accumulate(odometry, se2.compose)))


def path_rmse_m(path: np.ndarray, true: np.ndarray) -> float:
    off = path - se2.between(true[0], true)
    return float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))


def measured_from(truth: np.ndarray) -> int:
    """The first frame whose true heading was measured.

    In those before it the truth of the extract turns at one rate, to a hundredth of a milliradian,
    where a car steers, and the pictures by two programs say that this one does, by up to 2.4
    milliradians a frame: its headings were interpolated.
    """
    turns = np.diff(np.unwrap(truth[:, 2]))
    return int(np.argmax(np.abs(np.diff(turns)) > 1e-4)) + 1


def path_over_odometry(one: Imported) -> float:
    """Median over filter seeds of FastSLAM's error over that of the odometry."""
    assert one.truth is not None
    errors = []
    for seed in range(5):
        rng, told = np.random.default_rng(seed), one.odometry_covariance
        *_, last = run_log(one.log, FastSlamParameters(), rng, odometry_covariance=told)
        errors.append(path_rmse_m(last.slam.best_path(), one.truth))
    return float(np.median(errors)) / path_rmse_m(dead_reckoned(one.log.odometry), one.truth)


def test_kitti_paths_are_no_worse_than_their_odometry(
    work: StereoImport, imported: Imported
) -> None:
    """Where the truth was measured; of the whole extract but for a tenth."""
    assert imported.truth is not None
    first = measured_from(imported.truth)
    assert 8 <= first <= 14
    assert path_over_odometry(work.log_of(Cut("M", slice(first, None)))) <= 1.0
    assert path_over_odometry(imported) <= 1.1


def maps_of(pair: list[Imported], seed: int) -> list[LandmarkMap]:
    return [
        build_map(
            one.log, FastSlamParameters(), np.random.default_rng(seed),
            odometry_covariance=one.odometry_covariance, attitude=one.attitude,
        )
        for one in pair
    ]  # fmt: skip


def assert_aligned(pair: list[Imported], T: np.ndarray, seed: int) -> None:
    maps = maps_of(pair, seed)
    registration = Registration(make_aligner("ransac")).on(*maps, match(*maps))
    found = registration.register(np.random.default_rng(0)).applied
    off = found.T_a_b - T
    assert found.ok
    assert np.hypot(*off[:2]) <= 0.30
    assert np.degrees(abs(off[2])) <= 1.1
    assert off @ np.linalg.solve(found.covariance, off) <= 14.2
    assert np.sqrt(np.trace(found.covariance[:2, :2])) <= 0.15


@pytest.mark.parametrize("first", [0, 12])
def test_kitti_seen_by_two_robots_is_one_map(work: StereoImport, first: int) -> None:
    """Even and odd frames: all, and those from the thirteenth on, whose truth was measured."""
    pair = [work.log_of(Cut(f"{k}", slice(first + k, None, 2))) for k in (0, 1)]
    T = se2.between(*[one.truth[0] for one in pair if one.truth is not None])
    for seed in range(5):
        assert_aligned(pair, T, seed)


def test_kitti_parts_of_a_drive_are_one_map(work: StereoImport, imported: Imported) -> None:
    """Frames 0 to 17 and 8 to 25: as far apart as the odometry between them says.

    Against the extract's truth, whose headings until frame 12 were not measured (`measured_from`),
    they are 13 milliradians off, and so is the odometry.
    """
    pair = [work.log_of(Cut(name, slice(*rows))) for name, rows in (("A", (0, 18)), ("B", (8, 26)))]
    for seed in range(5):
        assert_aligned(pair, dead_reckoned(imported.log.odometry)[8], seed)


def test_euroc_is_rectified_and_raw_it_is_refused() -> None:
    recording = read_recording("euroc", RECORDINGS / "euroc_extract", None, read_yaml)
    log = StereoImport(recording).log_of(WHOLE)
    assert np.median(log.observations[2:]) >= 60
    size, f, center = (752, 480), (457.0, 457.0), (375.5, 239.5)
    lens, T = Lens(size, f, center), se3.pose(np.eye(3), [0.11, 0.0, 0.0])
    raw = StereoRecording(
        "raw", recording.time_ns, recording.pictures, StereoCalibration(lens, lens, T),
        recording.T_robot_left,
    )  # fmt: skip
    with pytest.raises(InputError, match="rows apart"):
        StereoImport(raw)
