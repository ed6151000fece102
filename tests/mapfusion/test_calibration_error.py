"""What a camera's calibration leaves open: on disk, and what it does to points of a map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from mapfusion.errors import InputError
from mapfusion.geometry import se2
from mapfusion.geometry.camera import (
    EXACT,
    CalibrationError,
    StereoCamera,
    calibration_from,
    usual_calibration,
)
from mapfusion.landmark_map import read_map, write_map
from mapfusion.robot_log import Observations, RobotLog, read_log, write_log
from tests.mapfusion.align.map_pairs import landmarks

LEFT_OPEN = CalibrationError(0.00123456789, 0.003)
OF_ONE_CAMERA = CalibrationError(0.0, 0.01, camera="left and right of June")
POINTS = np.random.default_rng(0).uniform(-20, 20, (9, 3))


def test_points_turn_about_the_maps_beginning_and_spread() -> None:
    small = CalibrationError(1e-6, 1e-6)
    turned = se2.transform_points(np.array([0.0, 0.0, 1e-6]), POINTS)
    np.testing.assert_allclose(small.moves_m(POINTS)[:, 0], turned - POINTS, atol=1e-10)
    larger = POINTS * [1 + 1e-6, 1 + 1e-6, 1.0]
    np.testing.assert_allclose(small.moves_m(POINTS)[:, 1], larger - POINTS, atol=1e-13)


def a_log(calibration: CalibrationError) -> RobotLog:
    seen = Observations(POINTS, np.tile(np.eye(3), (9, 1, 1)))
    return RobotLog("R1", False, np.zeros(1), np.zeros((1, 3)), np.zeros(9, int), seen, calibration)


@pytest.mark.parametrize("calibration", [EXACT, LEFT_OPEN, OF_ONE_CAMERA])
def test_logs_and_maps_keep_it(tmp_path: Path, calibration: CalibrationError) -> None:
    write_log(tmp_path / "R1", a_log(calibration))
    assert read_log(tmp_path / "R1").calibration == calibration
    write_map(tmp_path / "a.parquet", replace(landmarks(POINTS), calibration=calibration))
    assert read_map(tmp_path / "a.parquet").calibration == calibration


def test_files_of_exact_cameras_are_as_they_were(tmp_path: Path) -> None:
    write_log(tmp_path / "R1", a_log(EXACT))
    stored = pq.read_schema(tmp_path / "R1" / "frames.parquet").metadata
    assert not any(b"calibration" in key for key in stored)


@pytest.mark.parametrize("text", ["much", "-1", "nan"])
def test_what_is_no_deviation_is_one_line(text: str) -> None:
    with pytest.raises(InputError, match=r"R1: calibration_heading_rad .*metadata"):
        calibration_from({"calibration_heading_rad": text}, "R1")


def test_a_pixel_is_less_in_a_longer_lens() -> None:
    short, long = (usual_calibration(StereoCamera(focal_px=f)) for f in (300.0, 3000.0))
    assert short.heading_rad > long.heading_rad > 0.002
    assert short.scale == long.scale
