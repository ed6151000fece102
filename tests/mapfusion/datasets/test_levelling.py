"""Attitude from the floor plane, a tilted trajectory or the pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapfusion.attitude import read_attitude
from mapfusion.camera import StereoCamera
from mapfusion.datasets.formats import read_recording
from mapfusion.datasets.imu import ImuData
from mapfusion.datasets.levelling import (
    AttitudeMeasurements,
    Floor,
    choose_attitude_source,
    fit_floor,
)
from mapfusion.datasets.stereo_import import RecordingPart, StereoImport, write_imported
from mapfusion.datasets.stereo_recording import StereoRecording
from mapfusion.datasets.text_files import TimedPoses
from mapfusion.errors import InputError
from mapfusion.geometry import se3
from mapfusion.robot_log import Observations
from mapfusion.vision.front_end import FrontEndParameters
from mapfusion.vision.tracking import Features
from tests.mapfusion.datasets.written_layouts import POSES, drive, write_kitti

HEIGHT_M = 1.65
SIGMA_M = 0.02
WHOLE = RecordingPart("R1", slice(None))


def usual(_: FrontEndParameters) -> FrontEndParameters:
    return FrontEndParameters()


def road(rng: np.random.Generator, value: np.ndarray, n: int, clutter: int) -> Observations:
    """Return floor points and objects in the frame of a body at roll, pitch and height (3,)."""
    floor = np.c_[rng.uniform([3, -4], [20, 4], (n, 2)), np.zeros(n)]
    things = rng.uniform([3, -6, 0.1], [25, 6, 3], (clutter, 3))
    p = np.concatenate([floor, things]) - [0, 0, value[2]]
    p = p @ se3.tilt(*value[:2]) + SIGMA_M * rng.standard_normal((n + clutter, 3))
    return Observations(p, np.tile(SIGMA_M**2 * np.eye(3), (len(p), 1, 1)))


def test_a_floor_alone_is_found_as_well_as_stated() -> None:
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(200):
        value = rng.normal(0, [0.03, 0.03, 0.05])
        floor = fit_floor(road(rng, value, 60, 0), HEIGHT_M, 0.99)
        assert floor is not None
        found, sigma = floor.attitude
        squares.append(((found - value) / sigma) ** 2)
    assert np.mean(squares, axis=0) == pytest.approx([1, 1, 1], abs=0.4)


@pytest.mark.parametrize(("rougher", "excess"), [(2.0, 2.43), (0.5, 1.0)])
def test_a_floor_is_no_surer_than_its_points_lie(rougher: float, excess: float) -> None:
    """The covariance grows with the median square of the points inside the gate.

    For points with twice the stated deviation: P(|z| < 2.576 / 2) = 0.802 for normal z, and half of
    these have |z| < 0.526, so the median square is (2 * 0.526)^2 = 1.106. A chi-square with one
    degree of freedom has the median 0.455, and 1.106 / 0.455 = 2.43. Smaller residuals do not
    shrink the covariance.
    """
    rng, n = np.random.default_rng(3), 4000
    p = np.c_[rng.uniform([3, -4], [20, 4], (n, 2)), np.zeros(n)]
    p[:, 2] = rougher * SIGMA_M * rng.standard_normal(n)
    stated = np.zeros((n, 3, 3))
    stated[:, 2, 2] = SIGMA_M**2
    floor = fit_floor(Observations(p, stated), HEIGHT_M, 0.99)
    assert floor is not None
    design = np.c_[p[:, :2], np.ones(n)]
    alone = np.linalg.inv(design.T @ design) * SIGMA_M**2 * n / floor.n_points
    np.testing.assert_allclose(floor.covariance[1, 1], excess * alone[1, 1], rtol=0.1)
    np.testing.assert_allclose(floor.covariance[2, 2], excess * alone[2, 2], rtol=0.1)


def test_attitude_above_a_floor_is_that_of_its_plane() -> None:
    slope_x, slope_y, height = 0.3, -0.2, -1.5
    floor = Floor(np.array([slope_x, slope_y, height]), np.diag([1e-4, 4e-4, 9e-4]), 60)
    (roll, pitch, above), sigma = floor.attitude
    normal = np.array([-slope_x, -slope_y, 1.0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(se3.tilt(roll, pitch) @ normal, [0, 0, 1], atol=1e-12)
    assert above == pytest.approx(-normal[2] * height)  # of the origin, along the normal
    assert sigma == pytest.approx([0.02, 0.01, 0.03])  # roll by the slope in y


def test_what_stands_on_it_does_not_tilt_it() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        value = rng.normal(0, [0.03, 0.03, 0.05])
        floor = fit_floor(road(rng, value, 60, 60), HEIGHT_M, 0.99)
        assert floor is not None
        found, _ = floor.attitude
        assert np.all(np.abs(found - value) < [0.012, 0.012, 0.05])


def test_where_no_floor_shows_there_is_none() -> None:
    rng = np.random.default_rng(2)
    assert fit_floor(road(rng, np.zeros(3), 5, 0), HEIGHT_M, 0.99) is None
    wall = road(rng, np.array([0.0, 0.9, 0.0]), 60, 0)
    assert fit_floor(wall, HEIGHT_M, 0.99) is None
    line = road(rng, np.zeros(3), 60, 0)
    on_a_line = line.position_m * [1.0, 0.0, 0.0]
    assert fit_floor(replace(line, position_m=on_a_line), HEIGHT_M, 0.99) is None


def test_heights_of_a_trajectory_are_above_its_beginning() -> None:
    """The height of a map is relative to the first frame of the trajectory."""
    odometry = se3.in_space(np.zeros((2, 3)), [[0.0, 0.0], [0.1, -0.2]])
    odometry[:, 2, 3] = [5.0, 5.25]
    levels = AttitudeMeasurements("odometry", StereoCamera(), np.eye(4), odometry)
    nothing = Features(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty((0, 64)))
    assert levels.measured(0, nothing, 0.3).value == pytest.approx([0.0, 0.0, 0.0])
    assert levels.measured(1, nothing, 0.3).value == pytest.approx([0.1, -0.2, 0.25])


def test_by_default_the_odometry_says_whether_the_body_is_level() -> None:
    upright = se3.from_planar(np.array([[0, 0, 0.3], [1, 0, 0.4]]))
    tilted = se3.in_space(np.array([[0, 0, 0.3], [1, 0, 0.4]]), [[0, 0], [0, 0.01]])
    found = [choose_attitude_source("auto", odometry) for odometry in (None, upright, tilted)]
    assert found == ["pictures", "mount", "odometry"]
    assert choose_attitude_source("floor", upright) == "floor"
    felt = ImuData(np.zeros(1, np.int64), np.array([[0.0, 0.0, 9.8]]))
    assert [choose_attitude_source("auto", each, felt) for each in (None, upright)] == [
        "imu",
        "mount",
    ]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> StereoRecording:
    return read_recording("kitti", write_kitti(tmp_path_factory.mktemp("kitti"), drive()))


def test_a_trajectory_that_tilts_levels_what_is_seen(
    recording: StereoRecording, tmp_path: Path
) -> None:
    """A stated downward pitch lowers the observed points and keeps the path."""
    roll_pitch = [0.02, 0.05]
    T = se3.in_space(POSES, np.tile(roll_pitch, (len(POSES), 1)))
    tilted = replace(recording, odometry=TimedPoses(recording.time_ns, T))
    made = StereoImport(tilted, usual).log_of(WHOLE)
    level = StereoImport(recording, usual).log_of(WHOLE)
    assert level.attitude is None
    assert made.attitude is not None
    np.testing.assert_allclose(made.attitude.value[:, :2], [roll_pitch] * len(POSES), atol=0.003)
    np.testing.assert_allclose(made.log.odometry, level.log.odometry, atol=1e-12)
    np.testing.assert_array_equal(made.log.iteration, level.log.iteration)
    R = se3.tilt(*made.attitude.value[made.log.iteration, :2].T)
    turned = np.einsum("nij,nj->ni", R, level.log.observations.position_m)
    turned[:, 2] += made.attitude.value[made.log.iteration, 2]
    np.testing.assert_allclose(made.log.observations.position_m, turned, atol=1e-9)
    write_imported(tmp_path, [made])
    assert read_attitude(tmp_path / "R1") is not None
    write_imported(tmp_path, [level])
    assert read_attitude(tmp_path / "R1") is None


def test_odometry_that_is_not_there_tilts_nothing(recording: StereoRecording) -> None:
    work = StereoImport(replace(recording, odometry=None), usual)
    with pytest.raises(InputError, match=r"--level odometry: .* has no odometry"):
        work.log_of(WHOLE, level="odometry")


def test_pictures_carry_a_level_beginning_on(recording: StereoRecording) -> None:
    made = StereoImport(replace(recording, odometry=None), usual).log_of(WHOLE)
    assert made.attitude is not None
    assert np.all(made.attitude.value[0] == 0)
    # the scene is level, so the attitude stays at what the pictures' turns err by
    assert np.abs(made.attitude.value[:, :2]).max() < 0.01
    assert np.abs(made.attitude.value[:, 2]).max() < 0.02
