"""Recordings in the TUM RGB-D layout: times, truth, calibration, and what is refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.datasets.formats import export_drive, read_recording
from mapfusion.datasets.levelling import MountSettings
from mapfusion.datasets.stereo_import import RecordingPart, StereoImport
from mapfusion.datasets.stereo_recording import StereoDrive
from mapfusion.datasets.tum_rgbd import TumRgbdSettings
from mapfusion.errors import InputError
from mapfusion.vision.front_end import FrontEnd, FrontEndParameters
from tests.mapfusion.datasets.written_layouts import CAMERA, POSES, read_yaml
from tests.mapfusion.vision.rendered_scene import render, wall

TIMES_S = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
NUMBERS = TumRgbdSettings(intrinsics=(216.0, 216.0, 119.5, 89.5))


def room(camera: StereoCamera) -> StereoDrive:
    """A drive in a room whose end wall is 3 m ahead, with true depths."""
    rng = np.random.default_rng(0)
    planes = [
        wall(rng, (3, 2), (3, -2), 6.0, -2.0, texels_per_m=60),
        wall(rng, (-1, 1.5), (3, 1.5), 6.0, -2.0, texels_per_m=40),
        wall(rng, (-1, -1.5), (3, -1.5), 6.0, -2.0, texels_per_m=40),
    ]
    frames = [render(planes, camera, tuple(pose), 1.0, rng) for pose in POSES]
    wheels = np.zeros((len(POSES), 3))
    wheels[1:] = [0.05, 0.009, 0.02]
    given = (lambda k: frames[k][:2], None, None, lambda k: frames[k][2])
    return StereoDrive("R1", camera, TIMES_S, POSES, wheels, *given)


@pytest.fixture(scope="module")
def drive() -> StereoDrive:
    return room(CAMERA)


@pytest.fixture(scope="module")
def written(drive: StereoDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = export_drive("tum_rgbd", tmp_path_factory.mktemp("tum"), drive)
    return path


@pytest.fixture
def own(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "R1"))


def read(path: Path, settings: TumRgbdSettings | None = None):
    return read_recording("tum_rgbd", path, settings, read_yaml)


def test_pictures_depths_times_truth_and_mount_are_read(drive: StereoDrive, written: Path) -> None:
    recording = read(written)
    work = StereoImport(recording)
    made = work.log_of(RecordingPart("R1", slice(None)))
    assert work.vision.max_depth_m == FrontEndParameters().max_depth_m  # whatever the camera
    for k in range(len(drive)):
        grey, depth_m = recording.pair(k)
        true_m = drive.depth_m(k)  # type: ignore[misc]
        np.testing.assert_array_equal(grey, drive.pair(k)[0])
        known = (true_m > 0) & (true_m * 5000 <= 65535)
        assert known.mean() > 0.5
        np.testing.assert_array_equal(np.isnan(depth_m), ~known)
        np.testing.assert_allclose(depth_m[known], true_m[known], atol=1.1e-4)
    np.testing.assert_allclose(made.log.time_s, TIMES_S, atol=1e-9)
    np.testing.assert_allclose(made.truth, POSES, atol=1e-9)
    np.testing.assert_allclose(made.log.odometry, drive.odometry, atol=1e-12)
    np.testing.assert_allclose(work.T_robot_camera[:3, 3], CAMERA.p_robot_left, atol=1e-12)


def test_points_are_where_stereo_finds_them(drive: StereoDrive, written: Path) -> None:
    """Common corners of both front ends, against the stated noise."""
    work = StereoImport(read(written), lambda _: FrontEndParameters())
    by_depth = FrontEnd(work.camera, work.vision, work._recording.depth)
    by_stereo = FrontEnd(CAMERA, FrontEndParameters())
    squares = []
    for k in range(len(drive)):
        found, other = by_depth.extract(*work.rectified(k)), by_stereo.extract(*drive.pair(k))
        common = np.all(found.uv_px[:, None] == other.uv_px[None], axis=2)
        i, j = np.nonzero(common)
        assert len(i) > 20
        p, C = work.camera.triangulate(
            found.uv_px[i], found.disparity_px[i], 0.0, found.sigma_disparity_px[i]
        )
        q, D = CAMERA.triangulate(
            other.uv_px[j], other.disparity_px[j], 0.0, other.sigma_disparity_px[j]
        )
        off = p - q - (work.camera.p_robot_left - CAMERA.p_robot_left)
        squares += (off[:, 0] ** 2 / (C + D)[:, 0, 0]).tolist()
    # depths without noise: the stereo noise alone, and rounding
    assert np.mean(squares) < 1.5


def test_numbers_replace_the_calibration_file(own: Path) -> None:
    (own / "calibration.yaml").unlink()
    with pytest.raises(InputError, match=r"the layout has no calibration; give --calibration FILE"):
        read(own)
    recording = read(own, NUMBERS)
    assert recording.calibration.left.focal_px == (216.0, 216.0)
    np.testing.assert_allclose(recording.T_robot_left[:3, 3], [0, 0, 0.5])
    mounted = read(own, replace(NUMBERS, mount=MountSettings(x_m=0.1, pitch_rad=0.3)))
    assert mounted.T_robot_left[0, 3] == 0.1
    # the truth is that of the robot, whose camera looks down by 0.3 rad
    moved = recording.truth.T[0, :3, :3].T @ mounted.truth.T[0, :3, :3]  # type: ignore[union-attr]
    assert np.arccos((np.trace(moved) - 1) / 2) == pytest.approx(0.3)


def test_a_lens_that_distorts_is_straightened(drive: StereoDrive, own: Path) -> None:
    """Depths follow their pixels; those of the wall ahead stay those of a plane."""
    bent = replace(NUMBERS, distortion=(0.2, -0.3, 0.0, 0.0, 0.1))
    work = StereoImport(read(own, bent))
    _, depth_m = work.rectified(0)
    assert depth_m.dtype == np.float32
    middle = depth_m[depth_m.shape[0] // 2, depth_m.shape[1] // 2]
    assert middle == pytest.approx(drive.depth_m(0)[90, 120], abs=0.01)  # type: ignore[misc]
    assert set(np.unique(depth_m[~np.isnan(depth_m)])) <= set(np.unique(read(own).pair(0)[1]))


def shifted(path: Path, by_s: float) -> None:
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("".join(f"{float(t) + by_s:.6f} {name}\n" for t, name in rows))


def test_depths_belong_to_the_picture_within_half_an_interval(own: Path) -> None:
    shifted(own / "depth.txt", 0.09)
    assert len(read(own)) == 5
    lines = (own / "depth.txt").read_text().splitlines()
    (own / "depth.txt").write_text("\n".join([lines[0], *lines[2:], ""]))
    recording = read(own)
    assert len(recording) == 4
    assert recording.dropped == ("rgb/0.200000.png (no partner within 100 ms)",)
    shifted(own / "depth.txt", 10.0)
    with pytest.raises(InputError, match="colour camera and 4 of the depth sensor make 0 pairs"):
        read(own)


def test_associations_and_missing_files(own: Path) -> None:
    stamps = [line.split()[0] for line in (own / "rgb.txt").read_text().splitlines()[1:]]
    lines = [f"{t} rgb/{t}.png {t} depth/{t}.png" for t in stamps]
    (own / "associations.txt").write_text("\n".join([*lines, ""]))
    for name in ("rgb.txt", "depth.txt"):
        (own / name).unlink()
    assert len(read(own)) == 5
    (own / "depth" / f"{stamps[1]}.png").unlink()
    recording = read(own)
    assert len(recording) == 4
    assert recording.dropped[0] == "depth/0.200000.png (no such file)"
    (own / "associations.txt").write_text(lines[0].rpartition(" ")[0])
    with pytest.raises(InputError, match=r"associations.txt, line 1: has 3 columns, expected 4"):
        read(own)


def test_wrong_pictures_are_named(own: Path) -> None:
    first = own / "depth" / "0.000000.png"
    cv2.imwrite(str(first), np.zeros((180, 240), np.uint8))
    with pytest.raises(
        InputError, match=r"0\.000000\.png: has 8 bit, expected depths in one channel"
    ):
        read(own)
    cv2.imwrite(str(first), np.zeros((90, 120), np.uint16))
    with pytest.raises(InputError, match="have 240x180 px, depth pictures 120x90"):
        read(own)
    (own / "rgb.txt").unlink()
    with pytest.raises(InputError, match=r"rgb\.txt: no such file"):
        read(own)
    with pytest.raises(InputError, match="no such folder"):
        read(own / "none")


def test_a_drive_without_depths_is_refused(drive: StereoDrive, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="R1: has no depths"):
        export_drive("tum_rgbd", tmp_path, replace(drive, depth_m=None))
    assert not list(tmp_path.iterdir())
