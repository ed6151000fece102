"""Exported drives are read again without change: pictures, times, points."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.datasets.formats import EXPORTERS, export_drive, read_recording, settings_class
from mapfusion.datasets.levelling import MountSettings
from mapfusion.datasets.stereo_import import Imported, RecordingPart, StereoImport
from mapfusion.datasets.stereo_recording import StereoDrive, StereoRecording
from mapfusion.errors import InputError
from mapfusion.geometry import se2, se3
from mapfusion.vision.front_end import (
    FrontEnd,
    FrontEndParameters,
    Observer,
    concatenate_observations,
)
from tests.mapfusion.datasets.written_layouts import drive, read_yaml

CAMERA = StereoCamera(width_px=240, height_px=180, focal_px=216.0)  # ahead of the axles
WHEELS = np.array([[0, 0, 0], [0.051, 0.001, 0.02], [0.05, 0.002, 0.019]])
TIMES_S = np.array([0.0, 0.2, 0.7])
TRUTH = np.array([[1.5, -2.0, 3.0], [1.45, -2.0, 3.1], [1.4, -2.02, -3.1]])
OWN: dict[str, dict[str, Any]] = {
    "kitti": {"mount": MountSettings(x_m=0.15, z_m=0.45)},
    "euroc": {},
    "rosbag": {
        "left": "/left/image_rect",
        "right": "/right/image_rect",
        "odom": "/odom",
        "truth": "/truth",
    },
}
OWN["rosbag2"] = OWN["rosbag"]


def read_again(name: str, path: Path) -> StereoRecording:
    importer = name.removesuffix("2")  # bags of both kinds have one
    return read_recording(importer, path, settings_class(importer)(**OWN[name]), read_yaml)


@pytest.fixture(scope="module")
def written() -> StereoDrive:
    pictures = drive()[:3]
    return StereoDrive("R1", CAMERA, TIMES_S, TRUTH, WHEELS, lambda k: pictures[k])


def every_frame(_: FrontEndParameters) -> FrontEndParameters:
    """Return simulation settings in which new tracks count at once."""
    usual = FrontEndParameters()
    return replace(usual, tracks=replace(usual.tracks, min_length=1))


@pytest.fixture(scope="module", params=list(OWN))
def imported(
    request: pytest.FixtureRequest, written: StereoDrive, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Any, Imported, StereoImport]:
    name, folder = request.param, tmp_path_factory.mktemp(request.param)
    (path,) = export_drive(name, folder, written)
    recording = read_again(name, path)
    assert recording.name == "R1"
    work = StereoImport(recording, every_frame)
    return name, recording, work.log_of(RecordingPart("R1", slice(None))), work


def test_there_is_a_test_of_each_format() -> None:
    assert set(EXPORTERS) == {*OWN, "tum_rgbd"}  # depths in place of right pictures


def test_pictures_are_the_same_bit_for_bit(imported: tuple, written: StereoDrive) -> None:
    _, recording, _, work = imported
    assert work.camera.focal_px == CAMERA.focal_px
    assert work.camera.baseline_m == pytest.approx(CAMERA.baseline_m, abs=1e-15)
    for k in range(len(written)):
        for found, image in zip(recording.pair(k), written.pair(k), strict=True):
            np.testing.assert_array_equal(found, image)


def test_times_and_odometry_are_the_same(imported: tuple) -> None:
    log = imported[2].log
    np.testing.assert_allclose(log.time_s, TIMES_S, atol=1e-6)
    np.testing.assert_allclose(log.odometry, WHEELS, atol=1e-12)


def test_the_truth_is_the_same(imported: tuple) -> None:
    """Truth is in the world frame, or relative to the first pose for KITTI."""
    name, _, one, _ = imported
    assert one.truth is not None
    wanted = se2.between(TRUTH[0], TRUTH) if name == "kitti" else TRUTH
    np.testing.assert_allclose(one.truth, wanted, atol=1e-12)


def test_observations_are_those_of_the_pictures_themselves(
    imported: tuple, written: StereoDrive
) -> None:
    log = imported[2].log
    vision = every_frame(FrontEndParameters())
    observer, front_end = Observer.of(CAMERA, vision), FrontEnd(CAMERA, vision)
    frames = [observer.observe(front_end.extract(*written.pair(k))) for k in range(3)]
    iteration, wanted = concatenate_observations([frame.observations for frame in frames])
    np.testing.assert_array_equal(log.iteration, iteration)
    assert len(wanted) > 50
    for field in ("position_m", "covariance_m2"):
        np.testing.assert_allclose(
            getattr(log.observations, field), getattr(wanted, field), rtol=1e-9, atol=1e-12
        )
    for field in ("descriptor", "uvd_px", "track"):
        np.testing.assert_array_equal(getattr(log.observations, field), getattr(wanted, field))


@pytest.mark.parametrize("name", ["rosbag", "rosbag2"])
def test_half_a_bag_is_never_there(written: StereoDrive, name: str, tmp_path: Path) -> None:
    def lost(_: int) -> Any:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_drive(name, tmp_path, replace(written, pair=lost))
    assert list(tmp_path.iterdir()) == []


def test_a_bag_of_ros_2_takes_the_place_of_a_bag_alone(
    written: StereoDrive, tmp_path: Path
) -> None:
    export_drive("rosbag2", tmp_path, written)
    (path,) = export_drive("rosbag2", tmp_path, written)
    assert sorted(each.name for each in path.iterdir()) == ["R1.ros2.db3", "metadata.yaml"]
    (path / "metadata.yaml").rename(path / "notes.txt")
    with pytest.raises(InputError, match=r"R1\.ros2: is there, and no bag"):
        export_drive("rosbag2", tmp_path, written)
    assert (path / "notes.txt").is_file()


@pytest.mark.parametrize("name", list(OWN))
def test_a_body_that_tilts_is_written_and_read(
    written: StereoDrive, name: str, tmp_path: Path
) -> None:
    """The true tilt is part of the truth, the measured tilt part of the odometry."""
    tilt_rad = np.array([[0.05, -0.02], [0.01, 0.06], [-0.04, 0.03]])
    tilted = replace(written, tilt_rad=tilt_rad, measured_tilt_rad=tilt_rad + 0.004)
    (path,) = export_drive(name, tmp_path, tilted)
    recording = read_again(name, path)
    assert recording.truth is not None
    assert recording.odometry is not None
    true, told = recording.truth.T, recording.odometry.T
    np.testing.assert_allclose(
        se3.between(true[0], true), se3.between(tilted.true_bodies[0], tilted.true_bodies),
        atol=1e-9,
    )  # fmt: skip
    np.testing.assert_allclose(se3.roll_pitch(told[:, :3, :3]), tilt_rad + 0.004, atol=1e-12)
    made = StereoImport(recording, every_frame).log_of(RecordingPart("R1", slice(None)))
    np.testing.assert_allclose(made.log.odometry, WHEELS, atol=1e-12)
    assert made.attitude is not None
    np.testing.assert_allclose(made.attitude.value[0, :2], tilt_rad[0] + 0.004, atol=1e-4)
