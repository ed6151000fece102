"""Extracts of KITTI and EuRoC: observations suffice and maps of parts agree."""

import cv2
import numpy as np
import pytest

from mapfusion.align.aligners import make_aligner
from mapfusion.align.correspondences import match
from mapfusion.datasets.camera_calibration import Lens, StereoCalibration
from mapfusion.datasets.formats import read_recording
from mapfusion.datasets.stereo_import import Imported, RecordingPart, StereoImport
from mapfusion.datasets.stereo_recording import StereoRecording
from mapfusion.errors import InputError
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.mapping import build_map
from mapfusion.geometry import se2, se3
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.registration import Registration
from mapfusion.vision.front_end import FrontEnd
from tests.mapfusion.datasets.extracts import RECORDINGS, WHOLE, dead_reckoned, needs_recordings
from tests.mapfusion.datasets.written_layouts import read_yaml

pytestmark = needs_recordings


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
    pair = [work.log_of(RecordingPart(f"{k}", slice(first + k, None, 2))) for k in (0, 1)]
    T = se2.between(*[one.truth[0] for one in pair if one.truth is not None])
    for seed in range(5):
        assert_aligned(pair, T, seed)


def test_kitti_parts_of_a_drive_are_one_map(work: StereoImport, imported: Imported) -> None:
    """Frames 0 to 17 and 8 to 25: as far apart as the odometry between them says.

    The extract's truth there is no measured one (`test_real_paths.py`).
    """
    pair = [
        work.log_of(RecordingPart(name, slice(*rows)))
        for name, rows in (("A", (0, 18)), ("B", (8, 26)))
    ]
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
